"""One sweep over the machines of a Ray cluster: the same table as `realo sweep` gives on one machine.

    python3 -m pip install ray
    python3 sweep.py --shards 16 --isa avx2 late_fusion --log a.mcap --vary link.delay_ms=0,50,100,200 -o out/delay

Start it on a machine of the cluster, or set RAY_ADDRESS; elsewhere Ray starts a cluster of this machine alone. Everything but `--shards` and
`-o` is for `realo sweep`. Each machine needs `realo` (REALO_BIN, else PATH), and the current folder, the graphs and the logs at the same
absolute paths, as in a folder that all share. A part that fails ends the sweep. `--isa` makes machines with other instructions compute the same digits.
"""

import argparse
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import ray


def realo():
    """The program on this machine."""
    program = os.environ.get("REALO_BIN") or shutil.which("realo")
    if program is None:
        raise FileNotFoundError("no `realo` on PATH of this machine: put it there, or name it by REALO_BIN")
    return program


@ray.remote(num_cpus=1, max_retries=2)
def part(words, number, count, folder):
    """Runs a part of the sweep in a folder of this machine; returns that folder as a tar file."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "part"
        command = [realo(), "sweep", *words, "--jobs", "1", "--shard", f"{number}/{count}", "-o", str(out)]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        if not out.is_dir() or done.returncode != 0:
            raise RuntimeError(f"part {number} of {count} ended with {done.returncode}:\n{done.stderr[-4000:]}")
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w:gz") as archive:
            archive.add(out, arcname="part")
        return packed.getvalue()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0], allow_abbrev=False)
    parser.add_argument("--shards", type=int, required=True, help="parts; a few for each core of the cluster")
    parser.add_argument("-o", "--out", required=True, help="folder of the results")
    ours, words = parser.parse_known_args()
    if ours.shards < 1:
        parser.error(f"--shards: expected at least 1, found {ours.shards}")
    ray.init(ignore_reinit_error=True, log_to_driver=False)
    folder = os.getcwd()
    numbers = {part.remote(words, number, ours.shards, folder): number for number in range(1, ours.shards + 1)}
    with tempfile.TemporaryDirectory() as scratch:
        parts, waiting = [], list(numbers)
        while waiting:
            done, waiting = ray.wait(waiting)
            for reference in done:
                number = numbers[reference]
                with tarfile.open(fileobj=io.BytesIO(ray.get(reference))) as archive:
                    archive.extractall(f"{scratch}/{number}", filter="data")
                parts.append(f"{scratch}/{number}/part")
                print(f"sweep.py: {len(parts)} of {ours.shards} parts", file=sys.stderr)
        merged = subprocess.run([realo(), "sweep", *words, "--merge", *sorted(parts), "-o", ours.out])
    return merged.returncode


if __name__ == "__main__":
    sys.exit(main())

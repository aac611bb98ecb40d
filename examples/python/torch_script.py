"""The network of `torch_network.py` by a plain script, without a graph: what the three stages must come to.

    python3 torch_script.py WEIGHTS CLOUDS EGO OUT

CLOUDS: a folder that `keep_messages.py` filled with clouds before the encoders. For each sweep of EGO it takes the sweep of each
other agent that is nearest in time, up to 50 ms off, and writes boxes to `OUT/EGO-SEQ.npz`.
"""

import sys
from pathlib import Path

import numpy as np
import realo_geometry as geometry
import torch

import torch_network as network

#: Sweeps of one frame are at most so far apart, ns.
REACH = 50_000_000


def sweeps(folder):
    """All sweeps by agent, in order."""
    found = {}
    for path in sorted(Path(folder).glob("*.npz")):
        with np.load(path) as file:
            sweep = {name: file[name] for name in ("agent", "seq", "stamp", "pose", "x", "y", "z")}
        found.setdefault(str(sweep["agent"]), []).append(sweep)
    return found


def main(weights, folder, ego, out):
    encoder, head = network.loaded(network.Encoder(), weights), network.loaded(network.Head(), weights)
    fusion, agents = network.Fusion().eval(), sweeps(folder)
    if ego not in agents:
        found = f"those of {', '.join(sorted(agents))}" if agents else "none"
        raise SystemExit(
            f"{folder}: expected sweeps of `{ego}`, which keep_messages.py keeps while the graph runs, found {found}; run the graph with it "
            "before the encoders (docs/guide/your-model.md), and name the same EGO"
        )
    device = next(encoder.parameters()).device
    Path(out).mkdir(parents=True, exist_ok=True)
    for own in agents.pop(ego):
        points = lambda sweep: torch.from_numpy(np.stack([sweep[axis] for axis in "xyz"], axis=1)).to(device)
        maps = [encoder(points(own))[0]]
        covered = [torch.ones(maps[0].shape[1:], dtype=torch.bool, device=device)]
        for _, theirs in sorted(agents.items()):
            other = min(theirs, key=lambda sweep: abs(sweep["stamp"] - own["stamp"]))
            if abs(other["stamp"] - own["stamp"]) > REACH:
                continue
            ego_from_other = geometry.relative(*(geometry.matrix(sweep["pose"]) for sweep in (own, other)))
            moved, inside = network.in_frame_of(ego_from_other, encoder(points(other))[0])
            maps.append(moved)
            covered.append(inside)
        scores, boxes = head(fusion(torch.stack(maps), torch.stack(covered)))
        score, label, boxes = network.detections(scores, boxes, 0.1)
        names = np.array([network.CLASSES[index][0] for index in label.tolist()], str)
        np.savez(Path(out) / f"{ego}-{int(own['seq']):06}.npz", score=score.cpu(), boxes=boxes.cpu(), names=names, agents=len(maps))


if __name__ == "__main__":
    main(*sys.argv[1:])

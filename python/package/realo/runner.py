"""Runs graphs by the program `realo`, in virtual time."""

import os
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from . import _check
from .log import Path
from .results import Run, read_run

#: How `realo run` ends if all was done, and if what was reported is missing.
COMPLETE, PARTIAL = 0, 3
#: Options of `realo run` that have no place in virtual time, or that `run` gives itself.
OWN = {"mode", "rate", "log", "out", "format", "json", "full", "verbose", "view", "view_exit"}


class RunError(RuntimeError):
    """`realo run` failed. `code` is its exit code, `said` what it wrote to standard error."""

    def __init__(self, code: int, command: Sequence[str], said: str) -> None:
        super().__init__(f"`{' '.join(command)}` ended with {code}: {said.strip()[-2000:] or 'it said nothing'}")
        self.code, self.said = code, said


def program() -> str:
    """The program `realo`: what REALO_BIN names, else the first on PATH."""
    named = os.environ.get("REALO_BIN")
    if named:
        found = shutil.which(named)
        if found is None:
            raise FileNotFoundError(f"REALO_BIN: expected the program `realo`, found no program at `{named}`")
        return found
    found = shutil.which("realo")
    if found is None:
        raise FileNotFoundError(
            "the program `realo` is not on PATH, and REALO_BIN is not set: build it in a checkout of realo by "
            "`cargo build --release`, then set REALO_BIN=CHECKOUT/target/release/realo"
        )
    return found


def run(
    graph: Path | Sequence[Path],
    log: Path | Sequence[Path] | None = None,
    *,
    out: Path | None = None,
    timeout: float | None = None,
    **settings: Any,
) -> Run:
    """Runs a graph over a log in virtual time: `realo run GRAPH --log LOG --mode virtual`, and gives its results.

    graph: a file, or the name of a shipped one. log: one or several; None: the demo log. out: the folder of results; None: one that is
    removed after reading. settings: options of `realo run` with `_` for `-`: ego="car", offline=True, agents=["car", "mast"],
    link="delay_ms=90", seed=1, set={"fusion.nms.threshold": 0.2}, replace={"fusion.fusion": "program mine.py"}.

    Several logs or egos are pooled. What realo reports of a log's faults becomes a warning.
    Raises FileNotFoundError where the program is missing, and RunError if it fails.
    """
    if not isinstance(graph, (str, os.PathLike)):
        _check.refuse("run", "graph", "a path or a name", f"{graph!r}"[:80], "call run once for each graph")
    logs = [] if log is None else [log] if isinstance(log, (str, os.PathLike)) else list(log)
    options = [f"--log={os.fspath(one)}" for one in logs] + _options(settings)
    with tempfile.TemporaryDirectory(prefix="realo-") as folder:
        target = os.fspath(out) if out is not None else os.path.join(folder, "run")
        command = [program(), "run", os.fspath(graph), "--mode=virtual", *options, f"--out={target}"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
        if done.returncode not in (COMPLETE, PARTIAL):
            raise RunError(done.returncode, command, done.stderr)
        found = read_run(target)
        # All is read before the folder goes.
        found.name = os.path.splitext(os.path.basename(os.fspath(graph)))[0]
        if done.returncode == PARTIAL:
            warnings.warn(f"realo run: {done.stderr.strip()[-2000:]}", stacklevel=2)
        return found


def _options(settings: Mapping[str, Any]) -> list[str]:
    options = []
    for name, value in settings.items():
        if name in OWN:
            why = "an argument of `run` or what virtual time needs"
            _check.refuse("run", name, "another option of `realo run`", name, f"it is {why}")
        option = "--" + name.replace("_", "-")
        if value is None or value is False:
            continue
        if value is True:
            options.append(option)
        elif isinstance(value, Mapping):
            options += [f"{option}={key}={_text(one)}" for key, one in value.items()]
        elif name == "agents" and not isinstance(value, str):
            options.append(f"{option}={','.join(value)}")
        elif isinstance(value, (list, tuple)):
            options += [f"{option}={_text(one)}" for one in value]
        else:
            options.append(f"{option}={_text(value)}")
    return options


def _text(value: Any) -> str:
    """A value as the command line takes it: true and false in small letters."""
    return str(value).lower() if isinstance(value, bool) else str(os.fspath(value) if isinstance(value, os.PathLike) else value)

"""Frames of cooperative perception for training and analysis, by their number."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _check
from ._check import Floats
from .boxes import Boxes
from .log import Log, Path, Sweep, Truth

#: Sweeps of others belong to a frame if their stamps differ from the ego's by at most this, ns; as offline runs pair them.
REACH = 50_000_000


@dataclass(frozen=True, eq=False)
class Frame:
    """A sweep of the ego, the sweep of each other agent that is nearest in time, and the objects around the ego.

    sweeps: by agent, the ego first; others without a sweep within reach are missing. poses: by agent, the 4×4 matrix map from body at
    the stamp of its sweep. truth: None without truth.
    """

    ego: str
    seq: int
    stamp: int
    sweeps: dict[str, Sweep]
    poses: dict[str, Floats]
    truth: Truth | None

    def ego_from(self, agent: str) -> Floats:
        """The 4×4 matrix that brings what an agent saw to the ego's body frame."""
        ego, other = self.poses[self.ego], self.poses[agent]
        out = np.eye(4)
        # The difference first: it keeps its digits far from the map's origin.
        out[:3, :3] = ego[:3, :3].T @ other[:3, :3]
        out[:3, 3] = ego[:3, :3].T @ (other[:3, 3] - ego[:3, 3])
        return out

    @property
    def boxes(self) -> Boxes:
        """The objects around the ego, in its body frame."""
        return Boxes.empty() if self.truth is None else self.truth.boxes


@dataclass(eq=False)
class _Index:
    """Where the sweeps of an agent are."""

    seq: NDArray[np.uint64]
    stamp: NDArray[np.int64]
    ready: NDArray[np.int64]
    poses: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def nearest(self, stamp: int) -> int | None:
        """The sweep of the nearest stamp, the earlier of two; None if none is within reach."""
        after = int(np.searchsorted(self.stamp, stamp))
        around = [at for at in (after - 1, after) if 0 <= at < len(self.stamp)]
        best = min(around, key=lambda at: abs(int(self.stamp[at]) - stamp), default=None)
        return best if best is not None and abs(int(self.stamp[best]) - stamp) <= REACH else None


class Frames(Sequence[Frame]):
    """The frames of an ego in a log: `frames[3]`, `len(frames)`.

    agents: who takes part beside the ego, all by default. truth: whether objects are read. exact: poses as they were, not as agents
    believed. scored: only the frames that are scored.

    Index, poses and truth are read once; points are read when a frame is asked for. Each process opens the file itself, so frames may
    be shared with workers, forked or spawned.
    """

    def __init__(
        self,
        log: Path | Log,
        ego: str,
        agents: Sequence[str] | None = None,
        *,
        truth: bool = True,
        exact: bool = False,
        scored: bool = False,
    ) -> None:
        opened = log if isinstance(log, Log) else Log(log)
        if isinstance(agents, str):
            _check.refuse("Frames", "agents", "a list of names", f"the text {agents!r}", f"pass [{agents!r}]")
        others = [name for name in (opened.agents if agents is None else agents) if name != ego]
        for name in [ego, *others]:
            _check.one_of("Frames", "ego" if name == ego else "agents", name, list(opened.agents))
        self.path, self.ego, self.agents = opened.path, ego, [ego, *others]
        self._log, self._pid = opened, os.getpid()
        self._index = {name: self._read_index(opened, name, exact) for name in self.agents if _has_sweeps(opened, name)}
        if ego not in self._index:
            _check.refuse("Frames", "ego", "an agent with sweeps", f"{ego}, which has none", "take another ego")
        if scored and not truth:
            _check.refuse("Frames", "scored", "truth=True beside it", "truth=False", "truth says what is scored")
        found = list(opened.truth(ego, others)) if truth else []
        self._truth = {one.seq: one for one in found}
        numbers = [int(seq) for seq in self._index[ego].seq]
        if scored:
            numbers = [seq for seq in numbers if seq in self._truth and self._truth[seq].key]
        self._at = {seq: at for at, seq in enumerate(int(seq) for seq in self._index[ego].seq)}
        self._numbers = numbers

    @staticmethod
    def _read_index(log: Log, agent: str, exact: bool) -> _Index:
        times = log.sweep_times(agent)
        index = _Index(*(times[name].to_numpy() for name in ("seq", "stamp", "ready")))
        order = np.argsort(index.stamp, kind="stable")
        index = _Index(index.seq[order], index.stamp[order], index.ready[order])
        stream = "pose_truth" if exact else "pose"
        if stream not in log.about["streams"][agent]:
            expected = f"the topic /{agent}/{stream}"
            _check.refuse("Frames", "exact" if exact else "log", expected, "none in the log", "take exact=False, or a log with poses")
        index.poses = log.poses_at(agent, index.stamp, truth=exact)
        return index

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, number: Any) -> Any:
        """The frame of a number, or the frames of a slice."""
        if isinstance(number, slice):
            return [self[at] for at in range(*number.indices(len(self)))]
        # A number out of range raises IndexError, which ends loops.
        return self._frame(self._numbers[number])

    def _frame(self, seq: int) -> Frame:
        ego = self._index[self.ego]
        at = self._at[seq]
        stamp = int(ego.stamp[at])
        sweeps: dict[str, Sweep] = {}
        poses: dict[str, Floats] = {}
        for name, index in self._index.items():
            place = at if name == self.ego else index.nearest(stamp)
            if place is None or np.isnan(index.poses[place]).any():
                continue
            sweeps[name] = self._opened().sweep(name, int(index.stamp[place]), int(index.ready[place]))
            poses[name] = index.poses[place]
        if self.ego not in sweeps:
            raise ValueError(f"frame {seq} of `{self.ego}`: expected a pose within 150 ms of its stamp {stamp} ns, found none in the log")
        return Frame(self.ego, seq, stamp, sweeps, poses, self._truth.get(seq))

    def _opened(self) -> Log:
        """The log, opened in this process."""
        if self._pid != os.getpid():
            self._log, self._pid = Log(self.path), os.getpid()
        return self._log

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_log": None, "_pid": None}


def _has_sweeps(log: Log, agent: str) -> bool:
    return "points" in log.about["streams"][agent]

"""Logs and recordings, read."""

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray
from realo_operator import Message

from . import _check, _realo, _tables
from ._check import Floats
from .boxes import Boxes

if TYPE_CHECKING:
    import pandas as pd

Path = str | os.PathLike[str]
#: All log times.
FOREVER = 2**63 - 1


@dataclass(frozen=True)
class Agent:
    """An agent of a log. footprint: its outline [x min, x max, y min, y max] in its body frame, m; None where it has none."""

    name: str
    kind: str
    footprint: list[float] | None = None
    sensor: str = ""
    sensor_position: list[float] | None = None


@dataclass(frozen=True, eq=False)
class Sweep:
    """The points of a sweep in the agent's body frame.

    stamp: the reference time, ns; ready: when it existed, ns; points `[n, 3]` float32, m; intensity uint8; time: ns from the stamp;
    ring: the beam.
    """

    agent: str
    seq: int
    stamp: int
    ready: int
    points: NDArray[np.float32]
    intensity: NDArray[np.uint8]
    time: NDArray[np.int32]
    ring: NDArray[np.uint16]

    @staticmethod
    def _of(row: pa.StructArray) -> "Sweep":
        message = Message.read(row)
        header, columns = message.header, message.payload
        points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
        rest = (columns["intensity"], columns["time"], columns["ring"])
        return Sweep(header.agent, header.seq, header.stamp, header.ready, points, *rest)

    def to_arrow(self) -> pa.Table:
        """A row for each point: x, y, z, intensity, time, ring."""
        columns = dict(zip("xyz", np.ascontiguousarray(self.points.T)))
        columns |= {"intensity": self.intensity, "time": self.time, "ring": self.ring}
        return pa.table({name: pa.array(values) for name, values in columns.items()})

    def to_dataframe(self) -> "pd.DataFrame":
        """`to_arrow` as a DataFrame of pandas."""
        return _tables.to_dataframe(self.to_arrow())


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of an agent: map from body.

    stamp, ready, ns; position `[n, 3]`, m; quaternion `[n, 4]`, x y z w; covariance `[n, 6, 6]`, NaN where it is not known.
    """

    agent: str
    seq: NDArray[np.uint64]
    stamp: NDArray[np.int64]
    ready: NDArray[np.int64]
    position: Floats
    quaternion: Floats
    covariance: Floats

    def __len__(self) -> int:
        return len(self.stamp)

    def matrices(self) -> Floats:
        """`[n, 4, 4]` matrices: `map_from_body @ point_in_body`."""
        return matrices(np.column_stack([self.position, self.quaternion]))

    def to_arrow(self) -> pa.Table:
        """A row for each pose: seq, stamp, ready, x, y, z, qx, qy, qz, qw, covariance (if any is known)."""
        columns = {"seq": pa.array(self.seq), "stamp": pa.array(self.stamp), "ready": pa.array(self.ready)}
        numbers = np.ascontiguousarray(np.column_stack([self.position, self.quaternion]).T)
        columns |= {name: pa.array(values) for name, values in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), numbers)}
        if not np.isnan(self.covariance).all():
            columns["covariance"] = _tables.listed(self.covariance.reshape(-1, 36))
        return pa.table(columns)

    def to_dataframe(self) -> "pd.DataFrame":
        """`to_arrow` as a DataFrame of pandas."""
        return _tables.to_dataframe(self.to_arrow())


def matrices(poses: Floats) -> Floats:
    """The matrices of rows x y z qx qy qz qw; NaN stays NaN."""
    x, y, z, w = (poses[:, 3:] / np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)).T
    out = np.zeros((len(poses), 4, 4))
    out[:, :3, 0] = np.column_stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    out[:, :3, 1] = np.column_stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)])
    out[:, :3, 2] = np.column_stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    out[:, :3, 3], out[:, 3, 3] = poses[:, :3], 1
    return out


@dataclass(frozen=True, eq=False)
class Labels:
    """Boxes of one sweep of an agent in its body frame: detections, or final boxes of a run."""

    agent: str
    seq: int
    stamp: int
    ready: int
    boxes: Boxes

    @staticmethod
    def _of(row: pa.StructArray) -> "Labels":
        message = Message.read(row)
        header = message.header
        return Labels(header.agent, header.seq, header.stamp, header.ready, Boxes.of_columns(message.payload))


@dataclass(frozen=True, eq=False)
class Truth:
    """What is around an agent at a sweep's stamp, in its true body frame.

    points `[n, agents]`: the points that each of `agents` has on each object, the agent itself first; None where the log does not
    say. key: whether the frame is scored. ego_footprint: as `Agent.footprint`. views: rows of 14 numbers, images of cameras in which
    objects could be labelled, none where that is everywhere. own: what the agent's own side labelled, where the log tells it apart.
    """

    agent: str
    seq: int
    stamp: int
    ready: int
    boxes: Boxes
    agents: list[str]
    points: NDArray[np.uint32] | None = None
    key: bool = True
    ego_footprint: list[float] | None = None
    views: Floats | None = None
    own: "Truth | None" = None

    @staticmethod
    def _of(row: pa.StructArray) -> "Truth":
        message = Message.read(row)
        header, columns = message.header, message.payload
        who = header.agent, header.seq, header.stamp, header.ready
        own = None
        if len(columns["own_key"]):
            boxes = Boxes.of_columns(columns, "own_")
            points = _counts(columns["own_points"], len(boxes), 1)
            own = Truth(*who, boxes, [header.agent], points, bool(columns["own_key"][0]), None, columns["own_views"])
        boxes, agents = Boxes.of_columns(columns), [str(name) for name in columns["agents"]]
        footprint = list(columns["ego_footprint"]) if len(columns["ego_footprint"]) else None
        points = _counts(columns["points"], len(boxes), len(agents))
        return Truth(*who, boxes, agents, points, bool(columns["key"]), footprint, columns["views"], own)


def _counts(points: NDArray[np.uint32], boxes: int, agents: int) -> NDArray[np.uint32] | None:
    return points.reshape(boxes, agents) if agents and len(points) == boxes * agents else None


class Log:
    """An open log, read at any place. `agents` are its agents by name, `about` is what it says of itself.

    Raises ValueError for a file that is not a log, and FileNotFoundError where there is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = os.fspath(path)
        self._file = _realo.LogFile(self.path)
        self.about: dict[str, Any] = json.loads(self._file.about())
        self.agents = {about["name"]: Agent(**about) for about in self.about["agents"]}

    def __repr__(self) -> str:
        return f"Log({self.path!r}, agents={list(self.agents)})"

    def __reduce__(self) -> tuple[type["Log"], tuple[str]]:
        # Another process opens the file itself.
        return Log, (self.path,)

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last log time, ns."""
        return tuple(self.about["span"]) if self.about["span"] else None

    def sweep_times(self, agent: str) -> pa.Table:
        """seq, stamp and ready time of each of an agent's sweeps, without their points."""
        return pa.table(self._file.sweeps(agent))

    def sweeps(self, agent: str, start: int = 0, end: int = FOREVER) -> Iterator[Sweep]:
        """The sweeps of an agent that are ready at log times in `[start, end)`, ns."""
        return map(Sweep._of, self._file.messages(agent, "points", start, end))

    def sweep(self, agent: str, stamp: int, ready: int) -> Sweep:
        """The sweep of a stamp and a ready time, as `sweep_times` has them. Reads that part of the file alone."""
        return Sweep._of(self._file.cloud(agent, int(stamp), int(ready)))

    def poses(self, agent: str, truth: bool = False) -> Poses:
        """The poses of an agent: as it believed or, with `truth`, as they were."""
        table = self._file.poses(agent, truth)
        seq, stamp, ready = (table[name].to_numpy() for name in ("seq", "stamp", "ready"))
        pose = _tables.fixed(table["pose"], 7)
        covariance = _tables.fixed(table["covariance"], 36).reshape(-1, 6, 6)
        return Poses(agent, seq, stamp, ready, pose[:, :3], pose[:, 3:], covariance)

    def poses_at(self, agent: str, stamps: ArrayLike, truth: bool = False) -> Floats:
        """`[n, 4, 4]` matrices map from body at stamps, ns: recorded, interpolated, or carried on over at most 150 ms, as stages get
        them. NaN where none is known."""
        wanted = np.atleast_1d(np.asarray(stamps))
        if wanted.dtype.kind not in "iu":
            _check.refuse("Log.poses_at", "stamps", "whole nanoseconds", f"{wanted.dtype}", "floats of that size have lost digits")
        return matrices(_tables.fixed(self._file.poses_at(agent, truth, wanted.tolist())["pose"], 7))

    def detections(self, agent: str, start: int = 0, end: int = FOREVER) -> Iterator[Labels]:
        """The recorded detections of an agent."""
        return map(Labels._of, self._file.messages(agent, "detections", start, end))

    def labels(self, agent: str, own: bool = False, start: int = 0, end: int = FOREVER) -> Iterator[Truth]:
        """The labels of an agent as the log has them: all objects or, with `own`, what its own side labelled."""
        return map(Truth._of, self._file.messages(agent, "own_labels" if own else "ground_truth", start, end))

    def truth(self, ego: str, agents: Sequence[str] = ()) -> Iterator[Truth]:
        """The truth of an ego's sweeps as runs are scored by it: with the points of all that take part (`agents`, or all), one for each
        sweep, level."""
        if isinstance(agents, str):
            _check.refuse("Log.truth", "agents", "a list of names", f"the text {agents!r}", f"pass [{agents!r}]")
        return map(Truth._of, self._file.truth(ego, list(agents)))


class Recording:
    """The recording of a run: `recording.mcap` in the folder of a log and an ego."""

    def __init__(self, path: Path) -> None:
        self.path = os.fspath(path)
        # What is no recording is refused here.
        _realo.recorded(self.path, "boxes")

    def boxes(self) -> Iterator[Labels]:
        """The final boxes of each sweep."""
        return map(Labels._of, _realo.recorded(self.path, "boxes"))

    def detections(self) -> Iterator[Labels]:
        """What each agent detected alone, where the graph records it."""
        return map(Labels._of, _realo.recorded(self.path, "detections"))

    def truth(self) -> Iterator[Truth]:
        """The truth that was played; without the ego's footprint."""
        return map(Truth._of, _realo.recorded(self.path, "truth"))

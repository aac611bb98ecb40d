"""Oriented boxes as columns."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import realo_log
from numpy.typing import ArrayLike, NDArray
from realo_operator import Header, Message

from . import _check, _tables
from ._check import Floats

if TYPE_CHECKING:
    import pandas as pd

#: What `LogWriter.truth` and `LogWriter.detections` take: `Boxes.for_log()`.
LogBoxes = Mapping[str, Any]
NUMBERS = ("x", "y", "z", "length", "width", "height", "yaw")


class Boxes:
    """Boxes of one frame, or of many with `frame`, the number of each box's frame.

    center `[n, 3]` and size `[n, 3]` (length, width, height), m; yaw `[n]`, rad from +x towards +y; classes: a text a box; score
    `[n]` in 0..1; velocity `[n, 3]`, m/s, and covariance `[n, 3, 3]` of x, y, yaw: rows of NaN where they are not known; track:
    whole numbers, None where there is none. One value stands for all boxes.

    Raises ValueError for other shapes, numbers that are not finite, sizes that are not above 0, and scores outside 0..1.
    """

    center: Floats
    size: Floats
    yaw: Floats
    classes: NDArray[np.object_]
    score: NDArray[np.float32]
    velocity: Floats
    track: NDArray[np.object_]
    covariance: Floats
    frame: NDArray[np.int64] | None

    def __init__(
        self,
        center: ArrayLike,
        size: ArrayLike,
        yaw: ArrayLike,
        classes: str | Sequence[str] | NDArray[Any],
        *,
        score: ArrayLike = 1.0,
        velocity: ArrayLike | None = None,
        track: object = None,
        covariance: ArrayLike | None = None,
        frame: ArrayLike | None = None,
        where: str = "Boxes",
    ) -> None:
        self.center = _check.rows(where, "center", center, 3)
        n = len(self.center)
        size = np.broadcast_to(np.asarray(size), (n, 3)) if np.shape(size) == (3,) else size
        self.size = _check.rows(where, "size", size, 3, n)
        realo_log.between(where, "size", self.size, 1e-6, np.inf, "leave out boxes without extent")
        self.yaw = _check.column(where, "yaw", yaw, n)
        self.classes = _check.texts(where, "classes", classes, n)
        scores = _check.column(where, "score", score, n)
        self.score = realo_log.between(where, "score", scores, 0, 1, "scale them: per cent are score / 100").astype(np.float32)
        self.velocity = _check.optional_rows(where, "velocity", velocity, 3, n)
        self.track = _check.tracks(where, track, n)
        self.covariance = _check.optional_rows(where, "covariance", covariance, 9, n).reshape(n, 3, 3)
        self.frame = None if frame is None else _check.whole(where, "frame", frame, n, 0, 2**62)

    @classmethod
    def of(cls, values: ArrayLike, classes: str | Sequence[str] | NDArray[Any], **more: Any) -> "Boxes":
        """From `[n, 7]` rows x, y, z, length, width, height, yaw; `more` as in `Boxes`."""
        where = more.get("where", "Boxes.of")
        rows = _check.rows(where, "values", values, 7)
        return cls(rows[:, :3], rows[:, 3:6], rows[:, 6], classes, **{"where": where} | more)

    @classmethod
    def empty(cls) -> "Boxes":
        """No boxes."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), [])

    def __len__(self) -> int:
        return len(self.center)

    def __repr__(self) -> str:
        names, counts = np.unique(self.classes.astype(str), return_counts=True)
        return f"Boxes({', '.join(f'{n} {name}' for name, n in zip(names, counts)) or 'none'})"

    def __eq__(self, other: object) -> bool:
        """Whether all columns hold the same, bit by bit."""
        if not isinstance(other, Boxes) or len(self) != len(other):
            return NotImplemented if not isinstance(other, Boxes) else False
        mine, others = vars(self), vars(other)
        return all(_same(mine[name], others[name]) for name in mine)

    __hash__ = None  # type: ignore[assignment]

    def __getitem__(self, which: Any) -> "Boxes":
        """Some of the boxes: a mask, their numbers, or a slice."""
        out = object.__new__(Boxes)
        which = [which] if isinstance(which, (int, np.integer)) else which
        vars(out).update({name: values if values is None else values[which] for name, values in vars(self).items()})
        return out

    @staticmethod
    def join(parts: Iterable["Boxes"], frames: Sequence[int] | None = None) -> "Boxes":
        """The boxes of several, in order; `frames` numbers the parts."""
        parts = list(parts)
        out = object.__new__(Boxes)
        all_of = vars(Boxes.empty()) if not parts else vars(parts[0])
        for name in all_of:
            columns = [getattr(part, name) for part in parts] or [all_of[name]]
            vars(out)[name] = None if any(column is None for column in columns) else np.concatenate(columns)
        if frames is not None:
            lengths = np.array([len(part) for part in parts], np.int64)
            out.frame = np.repeat(np.asarray(frames, np.int64), lengths)
        return out

    def by_frame(self, frames: Iterable[int]) -> Iterator["Boxes"]:
        """The boxes of each frame."""
        numbers = self._frames("Boxes.by_frame")
        order = np.argsort(numbers, kind="stable")
        for number in frames:
            low, high = np.searchsorted(numbers[order], [number, number + 1])
            yield self[order[low:high]]

    def _frames(self, where: str) -> NDArray[np.int64]:
        if self.frame is None:
            _check.refuse(where, "frame", "the number of each box's frame", "none", "give Boxes(…, frame=…)")
        return self.frame

    @property
    def values(self) -> Floats:
        """`[n, 7]` rows x, y, z, length, width, height, yaw."""
        return np.column_stack([self.center, self.size, self.yaw])

    def columns(self) -> dict[str, Any]:
        """The columns as plug-ins and `realo_geometry` have them."""
        numbers = dict(zip(NUMBERS, np.ascontiguousarray(self.values.T)))
        covariance = self.covariance.reshape(-1, 9)
        more = {"class": self.classes, "score": self.score, "track": self.track, "velocity": self.velocity}
        return {**numbers, **more, "covariance": covariance}

    @staticmethod
    def of_columns(columns: Mapping[str, Any], prefix: str = "") -> "Boxes":
        """The opposite of `columns`; nothing is checked: they come from a log or a message."""
        column = {name: columns[prefix + name] for name in (*NUMBERS, "class", "score", "track", "velocity", "covariance")}
        out = object.__new__(Boxes)
        out.center = np.column_stack([column[name] for name in "xyz"])
        out.size = np.column_stack([column[name] for name in ("length", "width", "height")])
        out.yaw, out.classes, out.score = np.array(column["yaw"]), np.array(column["class"], object), np.array(column["score"])
        out.velocity, out.track = np.array(column["velocity"]), np.array(column["track"], object)
        out.covariance, out.frame = np.reshape(column["covariance"], (-1, 3, 3)), None
        return out

    def _row(self) -> pa.StructArray:
        return Message.boxes(Header(), self.columns()).write()

    @staticmethod
    def _of_row(row: pa.StructArray) -> "Boxes":
        return Boxes.of_columns(Message.read(row).payload)

    def for_log(self) -> LogBoxes:
        """What `LogWriter.truth`, `LogWriter.detections` and `LogWriter.own_labels` take; a log keeps no covariance of them."""
        fields: LogBoxes = realo_log.boxes(
            self.center, self.size, self.yaw, list(self.classes), self.score, self.velocity, list(self.track)
        )
        return fields

    def to_arrow(self) -> pa.Table:
        """A row for each box: frame (if there is one), x … yaw, class, score, track, vx, vy, vz, covariance (if any is known)."""
        names = {} if self.frame is None else {"frame": pa.array(self.frame)}
        names |= {name: pa.array(values) for name, values in zip(NUMBERS, np.ascontiguousarray(self.values.T))}
        names |= {"class": pa.array(self.classes, pa.string()), "score": pa.array(self.score)}
        names["track"] = pa.array(self.track, pa.uint64())
        for axis, values in zip(("vx", "vy", "vz"), np.ascontiguousarray(self.velocity.T)):
            names[axis] = pa.array(values, mask=np.isnan(values))
        if not np.isnan(self.covariance).all():
            names["covariance"] = _tables.listed(self.covariance.reshape(-1, 9))
        return pa.table(names)

    def to_dataframe(self) -> "pd.DataFrame":
        """`to_arrow` as a DataFrame of pandas."""
        return _tables.to_dataframe(self.to_arrow())

    @staticmethod
    def from_table(table: Any) -> "Boxes":
        """From a table as `to_arrow` makes it, of pyarrow, pandas or polars; of the columns from `score` on each may be missing."""
        where, found = "Boxes.from_table", _tables.to_table(table, "table")
        missing = [name for name in (*NUMBERS, "class") if name not in found.column_names]
        if missing:
            has = ", ".join(found.column_names)
            _check.refuse(where, "table", f"a column {missing[0]}", f"the columns {has}", "rename the column that holds it")
        numbers = {name: found[name].to_numpy() for name in found.column_names if name in (*NUMBERS, "score", "frame")}
        more: dict[str, Any] = {name: numbers[name] for name in ("score", "frame") if name in numbers}
        if "track" in found.column_names:
            more["track"] = found["track"].to_pylist()
        if "vx" in found.column_names:
            velocity = [found[axis].combine_chunks().cast(pa.float64()) for axis in ("vx", "vy", "vz")]
            more["velocity"] = np.column_stack([axis.to_numpy(zero_copy_only=False) for axis in velocity])
        if "covariance" in found.column_names:
            more["covariance"] = _tables.fixed(found["covariance"].cast(pa.list_(pa.float64(), 9)), 9)
        values = np.column_stack([numbers[name] for name in NUMBERS])
        return Boxes.of(values, found["class"].to_pylist(), **more, where=where)


def _same(one: Any, other: Any) -> bool:
    if one is None or other is None:
        return one is other
    if one.dtype == object:
        return bool((one == other).all())
    return bool(np.array_equal(one, other, equal_nan=True))

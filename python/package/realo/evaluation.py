"""The evaluator on arrays."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from . import _check, _realo
from .boxes import Boxes
from .log import Labels, Truth
from .results import Run

#: Frames of arrays are so far apart, ns; no score depends on it.
STEP = 100_000_000

Predictions = Boxes | Sequence[Boxes | None] | Mapping[int, Boxes] | Iterable[Labels]
Objects = Boxes | Sequence[Boxes] | Mapping[int, Boxes] | Iterable[Truth]


def evaluate(
    predictions: Predictions,
    truth: Objects,
    protocol: str = "default",
    *,
    frames: Iterable[int] | None = None,
    ego_footprint: ArrayLike | None = None,
    unknown_classes: str = "refuse",
    name: str = "arrays",
    ego: str = "ego",
) -> Run:
    """Scores boxes against truth, both in the ego's body frame: what `realo evaluate` says of the same boxes, to the last digit.

    predictions, truth: `Boxes` with `frame`; or a list of `Boxes`, one a frame; or a dict of them by frame. A frame for which a list
    or dict of predictions has None or nothing was not processed: all of its objects are missed. Truth of a log (`Log.truth`) and
    boxes of a recording (`Recording.boxes`) are taken as they are, and paired by `seq`.
    protocol: a name (default, dair, dair-vehicle, dair-roadside) or a file (docs/reference/protocols.md).
    frames: numbers of the frames, of which some may have no box at all; by default those that occur.
    ego_footprint: [x min, x max, y min, y max]: predictions centred in it are the ego itself.
    unknown_classes: whether classes that the protocol does not know are refused, or dropped and counted, as realo does with logs: drop.
    """
    where = "evaluate"
    _check.one_of(where, "unknown_classes", unknown_classes, ["refuse", "drop"])
    _same_length(predictions, truth)
    found, processed, stamps = _predicted(predictions)
    footprint = None
    if ego_footprint is not None:
        footprint = _check.rows(where, "ego_footprint", np.reshape(ego_footprint, (1, -1)), 4)[0].tolist()
    objects = _objects(truth, footprint)
    for number, stamp in stamps.items():
        there = objects.rows.get(number, {}).get("stamp", stamp)
        if there != stamp:
            expected, advice = f"boxes of the truth's sweeps, stamp {there} ns for seq {number}", "are both of one log?"
            _check.refuse(where, "predictions", expected, f"stamp {stamp} ns", advice)
    numbers = sorted(set(objects.rows) | set(processed or _numbers(found)))
    if frames is not None:
        wanted = [int(number) for number in frames]
        outside = sorted(set(numbers) - set(wanted))
        if outside:
            _check.refuse(where, "frames", "all frames that have boxes", f"boxes of frame {outside[0]} beside them", "add it")
        numbers = sorted(set(wanted))
    if not numbers:
        _check.refuse(where, "truth", "one frame or more", "none", "frames=range(n) names frames of which none has a box")
    for argument, boxes in ("predictions", found), ("truth", objects.boxes), ("truth", objects.own):
        _check_classes(argument, boxes, protocol, unknown_classes)
    # Every frame was processed, unless the caller tells them apart.
    done = set(numbers) if processed is None else processed
    rows = [objects.row(number, number in done) for number in numbers]
    place = {number: at for at, number in enumerate(numbers)}
    sides = {
        "predictions": _side(found, None, place, "predictions"),
        "truth": _side(objects.boxes, objects.points, place, "truth"),
        "own": _side(objects.own, objects.own_points, place, "truth"),
    }
    return Run(_realo.evaluate(protocol, rows, sides, name, ego), name)


def _same_length(predictions: Any, truth: Any) -> None:
    """Lists are paired by their places, so one that is short is a mistake. What comes of logs is paired by `seq`."""
    if not all(isinstance(side, (list, tuple)) for side in (predictions, truth)):
        return
    if any(isinstance(one, (Labels, Truth)) for side in (predictions, truth) for one in side):
        return
    if len(predictions) != len(truth):
        advice = "give a frame without boxes an empty Boxes, one that was not processed None, or dicts by frame"
        _check.refuse("evaluate", "predictions", f"{len(truth)} frames, as `truth` has", f"{len(predictions)}", advice)


def _numbers(boxes: Boxes) -> list[int]:
    return [] if boxes.frame is None else np.unique(boxes.frame).tolist()


def _check_classes(argument: str, boxes: Boxes, protocol: str, unknown: str) -> None:
    names = sorted(set(boxes.classes.tolist()))
    known, numbers = _realo.classes_of(protocol, names)
    strangers = [name for name, number in zip(names, numbers) if number is None]
    if strangers and unknown == "refuse":
        expected = f"classes of the protocol {protocol} ({', '.join(known)}, or a name that belongs to one)"
        advice = "rename it, or unknown_classes='drop' to leave such boxes out and count them"
        _check.refuse("evaluate", argument, expected, f"{strangers[0]!r}", advice)


def _as_frames(argument: str, values: Any) -> dict[int, Any]:
    """A list or a dict by frame."""
    if isinstance(values, Mapping):
        return {int(number): one for number, one in values.items()}
    if isinstance(values, (str, bytes, np.ndarray)) or not isinstance(values, Iterable):
        advice = "make them by Boxes.of(values, classes, frame=…)"
        _check.refuse("evaluate", argument, "Boxes, or a list of Boxes, one a frame", type(values).__name__, advice)
    listed = list(values)
    if listed and all(isinstance(one, (Labels, Truth)) for one in listed):
        numbers = [one.seq for one in listed]
        twice = next((number for number in numbers if numbers.count(number) > 1), None) if len(set(numbers)) < len(numbers) else None
        if twice is not None:
            advice = "score each log by itself, or give a dict by frame"
            _check.refuse("evaluate", argument, "each frame once", f"frame {twice} more than once", advice)
        return dict(zip(numbers, listed))
    return dict(enumerate(listed))


def _flat(argument: str, parts: Mapping[int, Boxes]) -> Boxes:
    for number, boxes in parts.items():
        if not isinstance(boxes, Boxes):
            found = f"{type(boxes).__name__} at frame {number}"
            _check.refuse("evaluate", argument, "Boxes", found, "make them by Boxes.of(values, classes)")
    return Boxes.join(parts.values(), list(parts))


def _predicted(predictions: Predictions) -> tuple[Boxes, set[int] | None, dict[int, int]]:
    """All boxes, the frames that were processed (None: all), and the stamps of those that have one."""
    if isinstance(predictions, Boxes):
        predictions._frames("predictions")
        return predictions, None, {}
    given = _as_frames("predictions", predictions)
    stamps = {number: one.stamp for number, one in given.items() if isinstance(one, Labels)}
    parts = {number: one.boxes if isinstance(one, Labels) else one for number, one in given.items() if one is not None}
    return _flat("predictions", parts), set(parts), stamps


@dataclass(eq=False)
class _Objects:
    """Truth of all frames."""

    boxes: Boxes
    points: Any
    own: Boxes
    own_points: Any
    rows: dict[int, dict[str, Any]]
    footprint: list[float] | None

    def row(self, number: int, processed: bool) -> dict[str, Any]:
        plain = {"stamp": number * STEP, "key": True, "ego_footprint": self.footprint, "views": [], "own_key": None, "own_views": []}
        return {"seq": number, "processed": processed, **plain, **self.rows.get(number, {})}


def _objects(truth: Objects, footprint: list[float] | None) -> _Objects:
    if isinstance(truth, Boxes):
        numbers = np.unique(truth._frames("truth")).tolist()
        return _Objects(truth, None, Boxes.empty(), None, {number: {} for number in numbers}, footprint)
    given = _as_frames("truth", truth)
    if not all(isinstance(one, Truth) for one in given.values()):
        return _Objects(_flat("truth", given), None, Boxes.empty(), None, {number: {} for number in given}, footprint)
    rows = {number: _row(one, footprint) for number, one in given.items()}
    own = {number: one.own for number, one in given.items() if one.own is not None}
    boxes = _flat("truth", {number: one.boxes for number, one in given.items()})
    owned = _flat("truth", {number: one.boxes for number, one in own.items()})
    return _Objects(boxes, _points(given.values()), owned, _points(own.values()), rows, footprint)


def _row(truth: Truth, footprint: list[float] | None) -> dict[str, Any]:
    own = truth.own
    return {
        "stamp": truth.stamp,
        "key": truth.key,
        "ego_footprint": footprint if truth.ego_footprint is None else truth.ego_footprint,
        "views": [] if truth.views is None else truth.views.tolist(),
        "own_key": None if own is None else own.key,
        "own_views": [] if own is None or own.views is None else own.views.tolist(),
    }


def _points(truths: Iterable[Truth]) -> Any:
    """Points of all agents and of the ego on each object, -1 where they are not known."""
    parts = [np.full((len(one.boxes), 2), -1) if one.points is None else _sums(one.points) for one in truths]
    return np.concatenate(parts or [np.zeros((0, 2))]).astype(np.int64)


def _sums(points: Any) -> Any:
    counts = points.astype(np.int64)
    return np.column_stack([counts.sum(axis=1), counts[:, 0]])


def _side(boxes: Boxes, points: Any, place: Mapping[int, int], argument: str) -> dict[str, Any]:
    """Boxes and their frames as Rust takes them."""
    n = len(boxes)
    points = np.full((n, 2), -1) if points is None else points
    frames = boxes._frames(argument) if n else np.zeros(0, np.int64)
    known = np.array(sorted(place), np.int64)
    places = np.searchsorted(known, frames)
    return {
        "boxes": boxes._row(),
        "frame": pa.array(places, pa.uint32()),
        "points": pa.array(np.ascontiguousarray(points[:, 0]), pa.int64()),
        "own_points": pa.array(np.ascontiguousarray(points[:, 1]), pa.int64()),
    }

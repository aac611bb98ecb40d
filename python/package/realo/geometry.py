"""Geometry of boxes on the ground plane, computed in Rust as stages compute it."""

from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray

from . import _check, _realo
from ._check import Floats
from .boxes import Boxes


class Suppressed(NamedTuple):
    """What is left by `nms`: which boxes were kept, best score first, and these boxes (after the vote)."""

    kept: NDArray[np.int64]
    boxes: Boxes


def iou(a: Boxes | ArrayLike, b: Boxes | ArrayLike) -> Floats:
    """Intersection over union on the ground of each box of `a` with each of `b`, `[len(a), len(b)]`.

    Boxes, or rows of 7 numbers x, y, z, length, width, height, yaw, or of 5: x, y, length, width, yaw.
    """
    one, other = _rectangles("a", a), _rectangles("b", b)
    found = _realo.iou(pa.array(one.ravel(), pa.float64()), pa.array(other.ravel(), pa.float64()))
    shares: Floats = found.to_numpy().reshape(len(one), len(other))
    return shares


def _rectangles(name: str, values: Boxes | ArrayLike) -> Floats:
    if isinstance(values, Boxes):
        return np.column_stack([values.center[:, :2], values.size[:, :2], values.yaw])
    width = np.shape(values)[-1] if np.ndim(values) else 0
    if np.size(values) and width not in (5, 7):
        expected = "shape (n, 7): x, y, z, length, width, height, yaw, or (n, 5): x, y, length, width, yaw"
        _check.refuse("iou", name, expected, f"{np.shape(values)}", "give each row these columns")
    rows = _check.rows("iou", name, values, 7 if width == 7 else 5)
    return np.ascontiguousarray(rows[:, [0, 1, 3, 4, 6]] if width == 7 else rows)


def corners(boxes: Boxes) -> Floats:
    """x, y of the corners of each box, `[n, 4, 2]`: front-left, front-right, rear-right, rear-left."""
    found: Floats = _realo.corners(_boxes("corners", boxes)._row()).to_numpy().reshape(-1, 4, 2)
    return found


def nms(
    boxes: Boxes,
    threshold: float = 0.15,
    *,
    min_score: float = 0.0,
    max_boxes: int = 1000,
    per_class: bool = False,
    vote: float = 1.0,
    region: ArrayLike | None = None,
) -> Suppressed:
    """Keeps, of boxes that overlap by an IoU above `threshold`, the one of best score: the stage `nms` (docs/reference/stages.md).

    region: [x min, x max, y min, y max], m: boxes not all inside are dropped. vote: IoU from which boxes of a class have a say in
    where the kept one is; 1: none has.
    """
    for name, value, low in ("threshold", threshold, 0.0), ("min_score", min_score, 0.0), ("vote", vote, threshold):
        if not low <= value <= 1:
            _check.refuse("nms", name, f"{low} to 1", f"{value}", "it is a share")
    if max_boxes < 1:
        _check.refuse("nms", "max_boxes", "1 or more", f"{max_boxes}", "leave it out")
    limits = [] if region is None else _check.rows("nms", "region", np.reshape(region, (1, -1)), 4).ravel().tolist()
    settings = {"threshold": threshold, "min_score": min_score, "max_boxes": max_boxes, "per_class": per_class, "vote": vote}
    kept, left = _realo.nms(_boxes("nms", boxes)._row(), {**settings, "region": limits})
    numbers = kept.to_numpy().astype(np.int64)
    found = Boxes._of_row(left)
    found.frame = None if boxes.frame is None else boxes.frame[numbers]
    return Suppressed(numbers, found)


def transform(to_from_from: ArrayLike, boxes: Boxes) -> Boxes:
    """Boxes in another frame, by a 4×4 matrix. They stay gravity-aligned: tilt moves the centre and turns the heading only."""
    if np.shape(to_from_from) != (4, 4):
        advice = "put a rotation and a translation into the first three rows, and 0, 0, 0, 1 into the last one"
        _check.refuse("transform", "to_from_from", "shape (4, 4)", f"{np.shape(to_from_from)}", advice)
    matrix = _check.rows("transform", "to_from_from", to_from_from, 4, 4)
    found = Boxes._of_row(_realo.transform(matrix.ravel().tolist(), _boxes("transform", boxes)._row()))
    found.frame = boxes.frame
    return found


def _boxes(where: str, boxes: object) -> Boxes:
    if not isinstance(boxes, Boxes):
        _check.refuse(where, "boxes", "Boxes", type(boxes).__name__, "make them by Boxes.of(values, classes)")
    return boxes

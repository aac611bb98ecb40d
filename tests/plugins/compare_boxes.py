"""Compares boxes of two folders of frames, frame by frame, and prints the largest differences as JSON.

    python3 compare_boxes.py FOUND EXPECTED

A file is what `keep_messages.py` or `torch_script.py` of examples/python writes. A box of one that has none of its class in the
other within 0.5 m and 0.05 of score is `alone`.
"""

import json
import sys
from pathlib import Path

import numpy as np

NAMES = ("x", "y", "z", "length", "width", "height", "yaw")


def frame(path):
    """Boxes as `[n, 7]`, their scores and classes."""
    with np.load(path) as file:
        if "boxes" in file:
            boxes = file["boxes"].astype(float)
            return boxes, file["score"], file["names"]
        return np.stack([file[name] for name in NAMES], axis=1), file["score"], file["class"]


def turned(yaw):
    return np.remainder(yaw + np.pi, 2 * np.pi) - np.pi


def nearest(one, other):
    """For each box of one the differences from its nearest of the other: centre and sizes (m), heading (rad), score."""
    (boxes, scores, names), (others, other_scores, other_names) = one, other
    far = np.linalg.norm(boxes[:, None, :3] - others[None, :, :3], axis=2)
    # Of boxes of one place, as two headings give them, the one alike.
    far += np.abs(turned(boxes[:, None, 6] - others[None, :, 6])) + np.abs(scores[:, None] - other_scores[None])
    far[names[:, None] != other_names[None]] = np.inf
    at = np.argmin(far, axis=1) if far.size else np.zeros(len(boxes), int)
    found = far[np.arange(len(boxes)), at] < 0.5 if far.size else np.zeros(len(boxes), bool)
    found &= np.abs(scores - other_scores[at]) < 0.05 if far.size else False
    apart = np.abs(boxes - others[at])[found] if far.size else np.zeros((0, 7))
    if far.size:
        apart[:, 6] = np.abs(turned(boxes[:, 6] - others[at, 6]))[found]
    return found, apart, np.abs(scores - other_scores[at])[found] if far.size else np.zeros(0)


def main(found, expected):
    names = sorted(path.name for path in Path(found).glob("*.npz"))
    assert names == sorted(path.name for path in Path(expected).glob("*.npz")), "other frames"
    said = {"frames": len(names), "boxes": 0, "alone": 0, "highest_alone": 0.0, "boxes_apart": 0.0, "scores_apart": 0.0, "equal": True}
    for name in names:
        pair = frame(Path(found) / name), frame(Path(expected) / name)
        # Headings are given within half a turn by one and as computed by the other.
        same = [(turned(boxes[:, 6]), boxes[:, :6], scores, labels) for boxes, scores, labels in pair]
        said["equal"] &= all(a.shape == b.shape for a, b in zip(*same)) and all(
            (np.abs(turned(a - b)) < 1e-12).all() if i == 0 else (a == b).all() for i, (a, b) in enumerate(zip(*same))
        )
        said["boxes"] += len(pair[0][0])
        for one, other in (pair, pair[::-1]):
            has, boxes, scores = nearest(one, other)
            said["alone"] += int((~has).sum())
            said["highest_alone"] = max(said["highest_alone"], float(one[1][~has].max(initial=0)))
            said["boxes_apart"] = max(said["boxes_apart"], float(boxes.max(initial=0)))
            said["scores_apart"] = max(said["scores_apart"], float(scores.max(initial=0)))
    said["equal"] = bool(said["equal"])
    print(json.dumps(said))


if __name__ == "__main__":
    main(*sys.argv[1:])

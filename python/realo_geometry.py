"""Frames, boxes, clouds and feature maps: x forward, y left, z up, yaw from +x towards +y; metres, radians, poses as 4×4 matrices.

`to_from_from @ point_in_from`, so poses compose by `@`. Boxes and clouds are dicts of columns,
feature maps have `data` of `[rows (y), columns (x), channels]`.
"""

import numpy as np


def matrix(pose):
    """The matrix of a pose `x y z qx qy qz qw`."""
    x, y, z, w = np.array(pose[3:]) / np.linalg.norm(pose[3:])
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = pose[:3]
    return out


def relative(map_from_to, map_from_from):
    """`to_from_from` of two frames that are given in `map`."""
    turn, out = map_from_to[:3, :3].T, np.eye(4)
    # The difference first: it keeps its digits far from the map's origin.
    out[:3, :3], out[:3, 3] = turn @ map_from_from[:3, :3], turn @ (map_from_from[:3, 3] - map_from_to[:3, 3])
    return out


def inverse(b_from_a):
    """`a_from_b`."""
    return relative(b_from_a, np.eye(4))


def transform_boxes(to_from_from, boxes):
    """Boxes in another frame. They stay gravity-aligned: tilt moves the centre and turns the heading only."""
    turn, yaw = to_from_from[:3, :3], boxes["yaw"]
    center = np.stack([boxes[axis] for axis in "xyz"], axis=-1) @ turn.T + to_from_from[:3, 3]
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1) @ turn.T
    angle = np.arctan2(turn[1, 0], turn[0, 0])
    flat = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    moved = {axis: center[:, i] for i, axis in enumerate("xyz")}
    moved |= {"yaw": np.arctan2(heading[:, 1], heading[:, 0]), "velocity": boxes["velocity"] @ turn.T}
    return {**boxes, **moved, "covariance": (flat @ boxes["covariance"].reshape(-1, 3, 3) @ flat.T).reshape(-1, 9)}


def transform_cloud(to_from_from, cloud):
    """A cloud in another frame; the other columns are shared."""
    rows = zip("xyz", to_from_from.astype(np.float32))
    return {**cloud, **{axis: a * cloud["x"] + b * cloud["y"] + c * cloud["z"] + d for axis, (a, b, c, d) in rows}}


def same_grid(one, other):
    """Whether two feature maps are of one model, size and place, with f32 numbers of which all are finite."""
    names = ("rows", "columns", "channels", "cell", "model", "dtype")
    same = all(one[name] == other[name] for name in names) and list(one["origin"]) == list(other["origin"])
    return same and one["dtype"] == "f32" and bool(np.isfinite(other["data"]).all())


def warp_map(to_from_from, feature_map):
    """The features of a map at the cells of a map of the same grid in another frame, `[rows, columns, channels]`, and which
    of these cells it covers, `[rows, columns]`.

    Bilinear between the four cells around that are there, zeros outside. A map that tells its `confidence` covers what the
    nearest cell says, if that one is there: its confidence is not 0. The map moves as the ground, z = 0, moves.
    """
    data, cell, origin = feature_map["data"], feature_map["cell"], np.asarray(feature_map["origin"])
    sparse, there = len(feature_map["confidence"]) > 0, np.ones(data.shape[:2], bool)
    if sparse:
        there = np.asarray(feature_map["confidence"]).reshape(there.shape) > 0
    size = np.array(data.shape[:2])
    x, y = (origin[i] + (np.arange(n) + 0.5) * cell for i, n in ((0, size[1]), (1, size[0])))
    own = inverse(to_from_from)[:2]
    # Rows and columns of the map, not yet whole, at each cell.
    x, y = ((a * x + b * y[:, None] + d - start) / cell - 0.5 for (a, b, _, d), start in zip(own, origin))
    place = np.stack([y, x], axis=-1)
    first = np.floor(place)
    out, weights = np.zeros(data.shape, np.float32), np.zeros(data.shape[:2], np.float32)
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = np.prod(np.where(corner, place - first, 1 - (place - first)), axis=-1)
        inside, rows, columns = _cells(first + corner, size)
        weight = np.where(inside & there[rows, columns], weight, 0).astype(np.float32)
        out += weight[..., None] * data[rows, columns]
        weights += weight
    inside, rows, columns = _cells(np.rint(place), size)
    covered = inside & there[rows, columns]
    if sparse:
        out *= np.divide(covered, weights, out=np.zeros_like(weights), where=covered)[..., None]
    return out, covered


def _cells(place, size):
    """Which places lie on a map, and their rows and columns; of others those of its edge."""
    inside = ((place >= 0) & (place < size)).all(axis=-1)
    rows, columns = np.moveaxis(np.clip(place, 0, size - 1).astype(int), -1, 0)
    return inside, rows, columns


def select(columns, which):
    """Some of the boxes or points: a mask, or their numbers."""
    return {name: values[which] for name, values in columns.items()}


def join(parts):
    """The boxes or points of several, in order."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def iou(a, b):
    """Intersection over union on the ground plane of each box of `a` (rows) with each of `b` (columns), in [0, 1]."""
    names = ("x", "y", "length", "width", "yaw")
    first, second = ([np.asarray(boxes[n])[at] for n in names] for boxes, at in ((a, np.s_[:, None]), (b, np.s_[None])))
    areas = [np.abs(boxes[2] * boxes[3]) for boxes in (first, second)]
    shared = np.clip(_shared(*first, *second), 0, np.minimum(*areas))
    return np.divide(shared, areas[0] + areas[1] - shared, out=np.zeros_like(shared), where=shared > 0)


def _shared(x, y, length, width, yaw, other_x, other_y, other_length, other_width, other_yaw):
    """Area that boxes share: around the other, in this one's frame, the integral of clamped y over clamped x."""
    cos, sin, turn = np.cos(yaw), np.sin(yaw), other_yaw - yaw
    dx, dy = other_x - x, other_y - y
    x, y = dx * cos + dy * sin, dy * cos - dx * sin
    lx, ly = (np.abs(other_length) / 2 * along for along in (np.cos(turn), np.sin(turn)))
    wx, wy = (np.abs(other_width) / 2 * along for along in (-np.sin(turn), np.cos(turn)))
    # Against the sense of yaw, so that the upper edges add and the lower ones subtract.
    ways = (-1, 1), (1, 1), (1, -1), (-1, -1)
    corners = [(x + l * lx + w * wx, y + l * ly + w * wy) for l, w in ways]
    with np.errstate(divide="ignore", invalid="ignore"):
        return sum(_edge(corners[i - 1], corners[i], np.abs(length) / 2, np.abs(width) / 2) for i in range(4))


def _edge(start, end, length, width):
    """Integral of y over x along an edge, x clamped to ±length and y to ±width."""
    left, right = np.clip(start[0], -length, length), np.clip(end[0], -length, length)
    slope = (end[1] - start[1]) / (end[0] - start[0])
    low, high = (start[1] + (x - start[0]) * slope for x in (left, right))
    # The shares of the way at which y meets -width and width; `fmin` and `fmax` take 0/0 to a side.
    one, other = (-width - low) / (high - low), (width - low) / (high - low)
    enters, leaves = (np.fmin(np.fmax(share, 0), 1) for share in (np.fmin(one, other), np.fmax(one, other)))
    y = lambda share: np.clip(low + share * (high - low), -width, width)  # noqa: E731
    mean = enters * y(0) + (leaves - enters) * 0.5 * (y(enters) + y(leaves)) + (1 - leaves) * y(1)
    return np.where(left == right, 0, (right - left) * mean)

"""The evaluator on arrays beside shapely in the field's way, in one run: `python3 python/benches/evaluate.py [FRAMES] [BOXES]`.

The field's way (as in OpenCOOD and V2X-Real): polygons of shapely; each detection, best first, takes the free object of largest IoU,
for each class and threshold. Beside it shapely's array functions. Both must find what realo finds. Needs the wheel and shapely.
"""

import sys
import time

import numpy as np
import realo
import shapely
from shapely.geometry import Polygon

IOUS = 0.3, 0.5
CLASSES = {"vehicle": ("Car", (4.4, 1.9, 1.6)), "pedestrian": ("Pedestrian", (0.6, 0.6, 1.7)), "truck": ("Truck", (8.5, 2.5, 3.2))}
ASKED = 50


def scene(random, n):
    """Objects of all classes in the region, and what a detector makes of them."""
    kinds = random.choice(list(CLASSES), n)
    sizes = np.array([CLASSES[kind][1] for kind in kinds])
    values = np.column_stack([random.uniform(-90, 90, n), random.uniform(-33, 33, n), sizes[:, 2] / 2, sizes, random.uniform(-3, 3, n)])
    found = values + random.normal(0, 1, values.shape) * [0.2, 0.2, 0.1, 0.05, 0.05, 0.05, 0.04]
    return kinds, values, found, random.uniform(0, 1, n).astype(np.float32)


def polygons(values, corners):
    return [Polygon(corner) for corner in corners] if len(values) else []


def by_pairs(found, truth, threshold):
    """Which detections, best first, are true."""
    hits, left = [], list(truth)
    for polygon in found:
        ious = [polygon.intersection(other).area / polygon.union(other).area for other in left]
        best = int(np.argmax(ious)) if ious else -1
        hits.append(bool(ious) and ious[best] >= threshold)
        if hits[-1]:
            left.pop(best)
    return hits


def by_arrays(found, truth, threshold):
    """The same by shapely's functions of arrays."""
    if not len(found) or not len(truth):
        return [False] * len(found)
    one, other = np.array(found)[:, None], np.array(truth)[None]
    shared = shapely.area(shapely.intersection(one, other))
    ious = shared / (shapely.area(one) + shapely.area(other) - shared)
    hits, free = [], np.ones(len(truth), bool)
    for row in ious:
        best = int(np.argmax(np.where(free, row, -1)))
        hits.append(bool(free[best] and row[best] >= threshold))
        free[best] &= not hits[-1]
    return hits


def average_precision(scores, hits, total):
    order = np.argsort(-np.asarray(scores, np.float32), kind="stable")
    hits = np.asarray(hits, bool)[order]
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(envelope[hits].sum() / total)


def field(scenes, corners, way):
    """AP by class and IoU."""
    out = {}
    for kind in CLASSES:
        for threshold in IOUS:
            scores, hits, total = [], [], 0
            for (kinds, values, found, score), (there, seen) in zip(scenes, corners):
                of = np.flatnonzero(kinds == kind)
                best = of[np.argsort(-score[of], kind="stable")]
                hits += way(polygons(found[best], seen[best]), polygons(values[of], there[of]), threshold)
                scores += score[best].tolist()
                total += len(of)
            out[kind, threshold] = average_precision(scores, hits, total)
    return out


def timed(call):
    start = time.perf_counter()
    found = call()
    return found, time.perf_counter() - start


def flat(scenes):
    """The arrays of all frames."""
    kinds, values, found, score = (np.concatenate(column) for column in zip(*scenes))
    names = np.array([CLASSES[kind][0] for kind in kinds])
    return names, values, found, score, np.repeat(np.arange(len(scenes)), [len(kinds) for kinds, *_ in scenes])


def by_realo(names, values, found, score, frame):
    return realo.evaluate(realo.Boxes.of(found, names, score=score, frame=frame), realo.Boxes.of(values, names, frame=frame)).ap()


def main():
    frames, boxes = (int(argument) for argument in (sys.argv[1:] + ["1000", "60"][len(sys.argv) - 1:])[:2])
    random = np.random.default_rng(1)
    scenes = [scene(random, boxes) for _ in range(frames)]
    of = lambda values: realo.corners(realo.Boxes.of(values, "Car"))  # noqa: E731: the same corners for both, not timed
    corners = [(of(values), of(found)) for _, values, found, _ in scenes]
    arrays = flat(scenes)
    ours, seconds = min((timed(lambda: by_realo(*arrays)) for _ in range(3)), key=lambda one: one[1])
    slow, slow_seconds = timed(lambda: field(scenes, corners, by_pairs))
    fast, fast_seconds = timed(lambda: field(scenes, corners, by_arrays))
    apart = max(abs(ours[kind][iou] - theirs[kind, iou]) for theirs in (slow, fast) for kind in CLASSES for iou in IOUS)
    print(f"{frames} frames × {boxes} boxes, 3 classes, IoU 0.3 and 0.5")
    print(f"realo.evaluate                       {seconds:8.3f} s   (also range and point bins, frames, both orders)")
    print(f"shapely, pair by pair (field's way)  {slow_seconds:8.3f} s   {slow_seconds / seconds:6.0f} times as long")
    print(f"shapely, arrays                      {fast_seconds:8.3f} s   {fast_seconds / seconds:6.0f} times as long")
    print(f"largest difference of an AP: {apart:.2g}")
    if apart > 1e-9 or slow_seconds < ASKED * seconds:
        sys.exit(f"expected the same AP within 1e-9, and {ASKED} times the speed of the field's way")


if __name__ == "__main__":
    main()

#!/usr/bin/env python3
"""Makes hota.json beside it: sequences of random tracks, and what TrackEval says of them.

Usage, with numpy, scipy and trackeval 1.3.0: hota.py
"""

import json
import random
from pathlib import Path

import numpy as np
from trackeval.metrics.hota import HOTA

DRAWS = random.Random(7)


def sequence(frames, objects, tracks):
    """Frames of identities and overlaps, each track mostly on one object."""
    made = []
    for _ in range(frames):
        truths = sorted(DRAWS.sample(range(objects), DRAWS.randint(0, objects)))
        detections = sorted(DRAWS.sample(range(tracks), DRAWS.randint(0, tracks)))
        near = lambda i, j: DRAWS.uniform(0.4, 1.0) if j % objects == i else max(0.0, DRAWS.uniform(-1.5, 0.9))
        overlaps = [[round(near(i, j), 4) for j in detections] for i in truths]
        made.append({"truths": truths, "detections": detections, "overlaps": sum(overlaps, [])})
    return made


def scored(metric, frames):
    """TrackEval's result of a sequence; its identities have no gaps."""
    count = lambda key: sum(len(frame[key]) for frame in frames)
    number = lambda key: {name: i for i, name in enumerate(sorted({name for frame in frames for name in frame[key]}))}
    truths, detections = number("truths"), number("detections")
    return metric.eval_sequence({
        "num_gt_dets": count("truths"), "num_tracker_dets": count("detections"),
        "num_gt_ids": len(truths), "num_tracker_ids": len(detections),
        "gt_ids": [np.array([truths[i] for i in frame["truths"]], int) for frame in frames],
        "tracker_ids": [np.array([detections[i] for i in frame["detections"]], int) for frame in frames],
        "similarity_scores": [np.array(frame["overlaps"], float).reshape(len(frame["truths"]), len(frame["detections"])) for frame in frames],
    })


def main():
    """Writes the sequences and their results, each alone and all together."""
    metric = HOTA()
    shapes = [(20, 4, 6), (30, 8, 9), (5, 1, 3), (12, 6, 2), (3, 0, 2), (3, 2, 0)]
    sequences = [sequence(*shape) for shape in shapes]
    results = [scored(metric, frames) for frames in sequences]
    means = lambda result: {key: float(np.mean(result[key])) for key in ("HOTA", "DetA", "AssA", "LocA")}
    together = metric.combine_sequences(dict(enumerate(results)))
    document = {
        "origin": "hota.py with trackeval 1.3.0 (MIT)",
        "sequences": [{"frames": frames, **means(result)} for frames, result in zip(sequences, results)],
        "together": means(together),
    }
    Path(__file__).with_name("hota.json").write_text(json.dumps(document, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main()

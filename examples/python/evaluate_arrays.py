"""Scores somebody else's predictions: arrays in, the table out. Needs the wheel: `python3 -m pip install CHECKOUT/python`."""
import numpy as np
import realo

random = np.random.default_rng(0)  # Made up here; yours come from np.load: rows x, y, z, length, width, height, yaw, and their frames.
truth, frame = random.uniform([-90, -30, 0, 4, 1.8, 1.4, -3], [90, 30, 1, 5, 2.1, 1.8, 3], (600, 7)), np.arange(600) // 30
found, score = truth + random.normal(0, [0.5, 0.3, 0.2, 0.2, 0.1, 0.1, 0.2], truth.shape), random.uniform(0, 1, 600)
run = realo.evaluate(realo.Boxes.of(found, "Car", score=score, frame=frame), realo.Boxes.of(truth, "Car", frame=frame), "dair")
print(run)

"""A log and boxes for the tests, made from arrays."""

import os
import shutil

import numpy as np
import realo

START = 1_700_000_000_000_000_000
SWEEP = 100_000_000
UNIT = [0.0, 0.0, 0.0, 1.0]
AGENTS = {"car": "vehicle", "other": "vehicle", "mast": "roadside"}
CLASSES = ["Car", "Pedestrian", "Truck"]


def needs_program():
    """A reason to leave a test out where the program `realo` is not there."""
    named = os.environ.get("REALO_BIN")
    return None if shutil.which(named or "realo") else "needs the program realo: set REALO_BIN"


def some_boxes(random, n, where=60.0):
    """Boxes that stand apart, as vehicles, pedestrians and trucks do."""
    classes = random.choice(CLASSES, n)
    sizes = np.array([{"Car": (4.4, 1.9, 1.6), "Pedestrian": (0.6, 0.6, 1.7), "Truck": (8.5, 2.5, 3.2)}[name] for name in classes])
    grid = np.stack(np.meshgrid(np.arange(-where, where, 12), np.arange(-34.0, 35, 12)), axis=-1).reshape(-1, 2)
    place = grid[random.permutation(len(grid))[:n]]
    center = np.column_stack([place, sizes[:, 2] / 2])
    velocity = random.uniform(-9, 9, (n, 3))
    velocity[::3] = np.nan
    yaw = random.uniform(-3.1, 3.1, n)
    return realo.Boxes(center, sizes, yaw, classes.tolist(), velocity=velocity, track=list(range(1, n + 1)))


def seen(random, boxes, found=0.85, noise=0.25, score=True):
    """What a detector makes of boxes: most of them, a little off, and a few that are not there."""
    there = boxes[random.uniform(size=len(boxes)) < found]
    false = some_boxes(random, 3)
    both = realo.Boxes.join([there, false])
    n = len(both)
    off = random.normal(0, noise, (n, 3)) * [1, 1, 0.2]
    scores = np.round(random.uniform(0.05, 1, n), 3) if score else 1.0
    return realo.Boxes(both.center + off, both.size, both.yaw + random.normal(0, 0.05, n), list(both.classes), score=scores)


def write_log(path, sweeps=6, seed=7):
    """A log of two vehicles and a mast, with everything that a log may have; gives what was written, by agent."""
    random = np.random.default_rng(seed)
    agents = [realo.agent(name, kind, footprint=[-1, 3.5, -0.9, 0.9] if kind == "vehicle" else None) for name, kind in AGENTS.items()]
    written = {name: {"sweeps": [], "poses": [], "truth": [], "detections": []} for name in AGENTS}
    with realo.LogWriter(path, agents, source="a test") as log:
        for k in range(sweeps):
            around_car = some_boxes(random, 24)
            for at, name in enumerate(AGENTS):
                stamp = START + k * SWEEP + at * 7_000_000
                half = 0.15 * at
                offset = np.array([5.0 * at, -1.0 * at, 0])
                pose = (np.array([691_000.25 + 0.1 * k, 5_334_000.5, 0.125]) + offset, np.array([0, 0, np.sin(half), np.cos(half)]))
                car_from_agent = np.eye(4)
                cos, sin = np.cos(2 * half), np.sin(2 * half)
                car_from_agent[:2, :2], car_from_agent[:3, 3] = [[cos, -sin], [sin, cos]], offset
                objects = realo.transform(np.linalg.inv(car_from_agent), around_car)
                covariance = np.diag(random.uniform(0.01, 0.1, 6))
                log.pose(name, stamp, *pose, covariance=covariance)
                log.pose(name, stamp, *pose, truth=True)
                n = 500 + 10 * k
                cloud = {
                    "points": random.uniform(-80, 80, (n, 3)).astype(np.float32),
                    "intensity": random.integers(0, 256, n).astype(np.uint8),
                    "time": random.integers(-50_000_000, 50_000_000, n).astype(np.int32),
                    "ring": random.integers(0, 128, n).astype(np.uint16),
                }
                log.sweep(name, stamp, ready=stamp + 50_000_000, **cloud)
                counts = random.integers(0, 40, len(objects))
                found = seen(random, objects)
                log.detections(name, stamp, found.for_log(), ready=stamp + 50_000_000)
                log.truth(name, stamp, objects.for_log(), points=counts, key=k % 2 == 0, ready=stamp + 50_000_000)
                written[name]["sweeps"].append((stamp, cloud))
                written[name]["poses"].append((stamp, *pose, covariance))
                written[name]["truth"].append((stamp, objects, counts))
                written[name]["detections"].append((stamp, found))
    return written

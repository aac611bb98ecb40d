"""A detector without learning: clusters of the points above the ground, each a box of at least a car's size.

It takes the place of `encoder` and `head` of a lane. A network goes into `detect`: load its weights in `__init__`
(`torch.load(self.config.weights)`; name the file by an argument), stack `x y z` there, and give its boxes to `boxes`.
"""

import numpy as np
from realo_operator import Message, Operator, Port, boxes, run

#: Length, width and height of a car, m.
CAR = np.array([4.2, 1.8, 1.5])
#: Half the width of the ground that is looked at, m.
REACH = 70.0


def clusters(x, y, cell):
    """For each point the number of its cluster: points whose cells of the ground touch are of one."""
    size = int(2 * REACH / cell) + 1
    row, column = (np.clip(((a + REACH) / cell).astype(int), 0, size - 1) for a in (x, y))
    labels = np.zeros((size + 2, size + 2), int)
    inner = labels[1:-1, 1:-1]
    inner[row, column] = np.arange(1, len(x) + 1)
    occupied = inner > 0
    while True:
        shifted = [labels[i : i + size, j : j + size] for i in range(3) for j in range(3)]
        grown = np.where(occupied, np.max(shifted, axis=0), 0)
        if (grown == inner).all():
            return np.unique(inner[row, column], return_inverse=True)[1]
        inner[:] = grown


def fitted(x, y):
    """The rectangle of the min area around points: centre, length, width, yaw. What is shorter than a car is made as
    long, away from the sensor, which sees the near sides alone."""
    angles = np.radians(np.arange(0, 90, 2.0))[:, None]
    along, across = x * np.cos(angles) + y * np.sin(angles), y * np.cos(angles) - x * np.sin(angles)
    best = np.argmin(np.ptp(along, axis=1) * np.ptp(across, axis=1))
    yaw, spans = angles[best, 0], []
    for values in (along[best], across[best]):
        spans.append([values.min(), values.max()])
    if np.ptp(spans[0]) < np.ptp(spans[1]):
        # Length is the longer side: turn by a quarter.
        yaw, spans = yaw + np.pi / 2, [spans[1], [-spans[0][1], -spans[0][0]]]
    for span, min in zip(spans, CAR):
        missing = max(0.0, min - (span[1] - span[0]))
        near = abs(span[0]) < abs(span[1])
        span[1 if near else 0] += missing if near else -missing
    (a, b), (c, d) = spans
    u, v = (a + b) / 2, (c + d) / 2
    return u * np.cos(yaw) - v * np.sin(yaw), u * np.sin(yaw) + v * np.cos(yaw), b - a, d - c, yaw


def detect(cloud, cell, min_points):
    """Boxes of a cloud: columns of the payload `Boxes`."""
    high = (cloud["z"] > 0.3) & (cloud["z"] < 3.0) & (np.hypot(cloud["x"], cloud["y"]) < REACH)
    x, y, z = (cloud[axis][high].astype(float) for axis in "xyz")
    rows = []
    if len(x):
        of = clusters(x, y, cell)
        for number in range(of.max() + 1):
            its = of == number
            count = int(its.sum())
            if count < min_points:
                continue
            center_x, center_y, length, width, yaw = fitted(x[its], y[its])
            if length > 1.5 * CAR[0] or width > 1.6 * CAR[1]:
                continue  # a wall, a hedge
            height = max(CAR[2], z[its].max())
            rows.append((center_x, center_y, height / 2, length, width, height, yaw, count / (count + 20)))
    names = ("x", "y", "z", "length", "width", "height", "yaw", "score")
    return boxes(**dict(zip(names, np.array(rows).reshape(-1, len(names)).T)), class_="Car")


class DetectorClusters(Operator):
    NAME = "detector-clusters"
    #: cell: points whose cells of this size (m) touch are of one object; min_points: of an object.
    DEFAULTS = {"cell": 0.6, "min_points": 10}
    INPUTS = [Port("clouds", "PointCloud", "sweeps of any agent", queue="latest")]
    OUTPUTS = [Port("proposals", "Boxes", "boxes in the frame of the sweep")]

    def on_input(self, port, message, out):
        found = detect(message.payload, self.config.cell, self.config.min_points)
        out.send("proposals", Message.boxes(message.header, found))


if __name__ == "__main__":
    run(DetectorClusters)

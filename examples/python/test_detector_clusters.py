"""What the detector finds in a made-up sweep."""

import unittest
from types import SimpleNamespace

import numpy as np
from realo_operator import Header, Message, Outputs, geometry

from detector_clusters import DetectorClusters


def sweep(*cars):
    """Ground, and the near sides of cars at (x, y): what a LiDAR at the origin sees."""
    points = [(x, y, 0.0) for x in range(-40, 41, 2) for y in range(-40, 41, 2)]
    for x, y in cars:
        points += [(x + u, y - 0.9 * np.sign(y), z) for u in np.arange(-2.1, 2.2, 0.2) for z in (0.4, 0.8, 1.2)]
        points += [(x - 2.1 * np.sign(x), y + v, z) for v in np.arange(-0.9, 1.0, 0.2) for z in (0.4, 0.8, 1.2)]
    x, y, z = np.array(points, np.float32).T
    n = len(x)
    rest = {"intensity": np.zeros(n, np.uint8), "time": np.zeros(n, np.int32), "ring": np.zeros(n, np.uint16)}
    header = Header(agent="cav1", kind="points", seq=7, pose=[0, 0, 0, 0, 0, 0, 1])
    return Message(header, "PointCloud", {"x": x, "y": y, "z": z, **rest})


class TestDetector(unittest.TestCase):
    def detect(self, message):
        out = Outputs()
        DetectorClusters(SimpleNamespace(**DetectorClusters.DEFAULTS)).on_input("clouds", message, out)
        ((port, answer),) = out.sent
        self.assertEqual((port, answer.type, answer.header.kind, answer.header.seq), ("proposals", "Boxes", "boxes", 7))
        return answer.payload

    def test_finds_cars_by_their_near_sides(self):
        found = self.detect(sweep((15, 6), (-20, -8), (30, 10)))
        order = np.argsort(found["x"])
        np.testing.assert_allclose(found["x"][order], [-20, 15, 30], atol=0.3)
        np.testing.assert_allclose(found["y"][order], [-8, 6, 10], atol=0.3)
        one = Message.boxes(Header(), geometry.select(found, [0]))
        self.assertEqual(one.payload["class"][0], "Car")

    def test_finds_nothing_where_nothing_is(self):
        self.assertEqual(len(self.detect(sweep())["x"]), 0)


if __name__ == "__main__":
    unittest.main()

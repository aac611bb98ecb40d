"""Writes what `realo-lab export rrd` sends on standard input as a recording of rerun: rrd.py OUT NAME.

A thing is a line of JSON, and the bytes that it announces behind it.
"""

import json
import sys

import numpy as np
import rerun as rr

# The colours of the report, which colour-blind people tell apart.
COLORS = {"boxes": (86, 180, 233), "detections": (230, 159, 0), "ground_truth": (47, 191, 154)}


def show_pose(agent, thing, _):
    rr.log(f"map/{agent}", rr.Transform3D(translation=thing["translation"], quaternion=rr.Quaternion(xyzw=thing["rotation"])))


def show_boxes(agent, thing, _):
    rows = np.array(thing["rows"], dtype=np.float64).reshape(-1, 7)
    half = rows[:, 6] / 2
    turned = np.stack([np.zeros_like(half), np.zeros_like(half), np.sin(half), np.cos(half)], axis=1)
    path = f"map/{agent}/{thing['topic']}"
    color = COLORS[thing["topic"]]
    # Without any, those before go.
    rr.log(path, rr.Boxes3D(centers=rows[:, :3], half_sizes=rows[:, 3:6] / 2, quaternions=turned, labels=thing["labels"],
                            colors=[color] * len(rows), show_labels=thing["topic"] == "boxes"))


def show_points(agent, thing, data):
    count = thing["points"]
    positions = np.frombuffer(data, dtype="<f4", count=3 * count).reshape(-1, 3)
    grey = 90 + np.frombuffer(data, dtype=np.uint8, offset=12 * count).astype(np.uint16) * 165 // 255
    rr.log(f"map/{agent}/points", rr.Points3D(positions, colors=np.repeat(grey[:, None], 3, axis=1).astype(np.uint8), radii=0.04))


SHOWN = {"pose": show_pose, "boxes": show_boxes, "points": show_points}


def main(out, name):
    rr.init("realo", recording_id=name)
    rr.save(out)
    rr.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for line in iter(sys.stdin.buffer.readline, b""):
        thing = json.loads(line)
        data = sys.stdin.buffer.read(thing["bytes"])
        if len(data) != thing["bytes"]:
            sys.exit("what realo-lab sent is cut")
        rr.set_time("stamp", timestamp=np.datetime64(thing["stamp"], "ns"))
        SHOWN[thing["kind"]](thing["agent"], thing, data)
    rr.disconnect()


main(*sys.argv[1:])

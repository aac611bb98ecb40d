"""Logs, results and the evaluator of realo, from Python.

    import realo

    log = realo.Log("my.mcap")                            # points, poses, boxes as numpy arrays
    run = realo.evaluate(predictions, truth)              # boxes of anybody against truth: print(run) is the table
    run = realo.run("late_fusion", "my.mcap", ego="car")  # a graph in virtual time
    frames = realo.Frames("my.mcap", ego="car")           # realo.torch.Dataset of them for PyTorch

Frames: x forward, y left, z up, yaw from +x towards +y; metres, radians, nanoseconds. docs/guide/python.md is the guide.
Operators of graphs are in `realo_operator`, geometry on numpy alone in `realo_geometry`.
"""

from .boxes import Boxes
from .evaluation import evaluate
from .frames import Frame, Frames
from .geometry import corners, iou, nms, transform
from .log import Agent, Labels, Log, Poses, Recording, Sweep, Truth
from .results import Run, compare, pool, read_run
from .runner import RunError, run
from .writing import LogWriter, agent, view

__all__ = [
    "Agent",
    "Boxes",
    "Frame",
    "Frames",
    "Labels",
    "Log",
    "LogWriter",
    "Poses",
    "Recording",
    "Run",
    "RunError",
    "Sweep",
    "Truth",
    "agent",
    "compare",
    "corners",
    "evaluate",
    "iou",
    "nms",
    "pool",
    "read_run",
    "run",
    "transform",
    "view",
]

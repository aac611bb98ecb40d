"""Operators of realo graphs that are written in Python.

    class Mine(Operator):
        NAME = "mine"
        DEFAULTS = {"threshold": 0.15}
        INPUTS = [Port("boxes", "Boxes", queue="latest")]
        OUTPUTS = [Port("proposals", "Boxes")]

        def on_input(self, port, message, out):
            out.send("proposals", message)

    if __name__ == "__main__":
        run(Mine)

A graph names such a program by `path: bin/realo` and `args: program mine.py threshold=0.3`. Its host, on dora or in
virtual time, starts it, keeps order, holds messages until they are ready, joins, counts and ends; the operator does none
of it, reads no clock and does not know which driver runs it. `print` goes to standard error.
"""

import realo_geometry as geometry
from .message import Header, Message, boxes
from .operator import Counter, Operator, Outputs, Port
from .pipe import run

__all__ = ["Counter", "Header", "Message", "Operator", "Outputs", "Port", "boxes", "geometry", "run"]

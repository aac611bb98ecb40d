"""Hosts an operator of a realo graph that is written in Python, under both drivers.

    class Mine(Operator):
        NAME = "mine"
        DEFAULTS = {"threshold": 0.15}
        INPUTS = [Port("boxes", "Boxes", queue="latest")]
        OUTPUTS = [Port("boxes", "Boxes")]

        def on_input(self, port, message, out):
            out.send("boxes", message)

    if __name__ == "__main__":
        run(Mine)

On dora the process joins the dataflow that started it (this needs the wheel `dora-rs`). With `REALO_DRIVER=pipe` in its
environment it answers a run in virtual time over its standard streams. The host keeps order, holds messages until they
are ready, joins, counts and ends; the operator does none of it, reads no clock and does not know which driver runs it.
"""

from .main import run
from .message import Header, Message
from .operator import Operator, Outputs, Port

__all__ = ["Header", "Message", "Operator", "Outputs", "Port", "run"]

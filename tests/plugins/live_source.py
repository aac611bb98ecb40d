"""A source of boxes of the world outside, for tests: a list each tenth of a second, until it is ended."""

import json
import sys
from types import SimpleNamespace

import realo_operator
from realo_operator import Header, Message, Operator, Port, boxes, pipe

PERIOD = 100_000_000


class Source(Operator):
    """Sends the boxes of `car`."""

    NAME = "live-source"
    OUTPUTS = [Port("boxes", "Boxes")]
    DEFAULTS = {}

    def __init__(self, config):
        super().__init__(config)
        self.seq, self.begun = 0, None

    def on_wake(self, now, out):
        """Sends a list when its time has come; the host asks again and again."""
        self.begun = self.begun or now
        if now - self.begun >= self.seq * PERIOD:
            header = Header(run="live", agent="car", seq=self.seq, stamp=now, ready=now, frame="car/body", pose=[0, 0, 0, 0, 0, 0, 1])
            out.send("boxes", Message.boxes(header, boxes([10.0], [2.0], length=4.0, width=2.0, height=1.5)))
            self.seq += 1
        out.wake_at(now)

    def on_end(self, out):
        """Says how many it sent."""
        print(f"live-source ended in order after {self.seq} lists", file=sys.stderr)


if __name__ == "__main__":
    # The role is no part of the module for operators.
    pipe.json = SimpleNamespace(loads=json.loads, dumps=lambda value: json.dumps(value | {"role": "source"} if "inputs" in value else value))
    realo_operator.run(Source)

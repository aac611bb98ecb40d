"""A stage that hands on what it gets, and keeps it: a file `AGENT-SEQ.npz` for each message, with the payload's columns, the
header's agent, seq, stamp (ns) and pose (`x y z qx qy qz qw` in `map`). It goes before an input:

    realo run GRAPH --replace ego.encoder.clouds="program keep_messages.py type=PointCloud out=clouds"
"""

from pathlib import Path

import numpy as np
from realo_operator import Operator, Port, run
from realo_operator.message import PAYLOADS


class KeepMessages(Operator):
    NAME = "keep-messages"
    #: type: payload of the messages; out: the folder, relative to the graph's; empty: nothing is kept, which shows what a hop
    #: to another process takes.
    DEFAULTS = {"type": "PointCloud", "out": ""}

    def __init__(self, config):
        super().__init__(config)
        if config.type not in PAYLOADS:
            raise ValueError(f"setting `type`: expected one of {', '.join(PAYLOADS)}, found `{config.type}`")
        self.INPUTS = [Port("messages", config.type, "messages of any agent")]
        self.OUTPUTS = [Port("messages", config.type, "the same")]
        if config.out:
            Path(config.out).mkdir(parents=True, exist_ok=True)

    def on_input(self, port, message, out):
        header, payload = message.header, message.payload
        if self.config.out:
            said = {"agent": header.agent, "seq": header.seq, "stamp": header.stamp, "pose": header.pose}
            texts = {name: np.array(values, str) for name, values in payload.items() if getattr(values, "dtype", None) == object}
            np.savez(Path(self.config.out) / f"{header.agent}-{header.seq:06}.npz", **{**payload, **texts}, **said)
        out.send("messages", message)


if __name__ == "__main__":
    run(KeepMessages)

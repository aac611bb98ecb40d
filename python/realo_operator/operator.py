"""What a stage implements, and what it hands to its host."""

from dataclasses import dataclass

from .message import PAYLOADS, Message


@dataclass(frozen=True)
class Port:
    """One input or output. What follows `about` matters for inputs only.

    types: name of a payload, or several; queue: `all` keeps every message in order (at most 1,024 may wait), `latest`
    one for each agent; class_: of messages that are ready at one time `state` goes first, then `data`, then `query`;
    join: ports of one group are assembled by (agent, seq) into one set.
    """

    name: str
    types: str | tuple[str, ...]
    about: str = ""
    queue: str = "all"
    class_: str = "data"
    required: bool = True
    join: str | None = None

    def __post_init__(self):
        types = (self.types,) if isinstance(self.types, str) else tuple(self.types)
        object.__setattr__(self, "types", types)
        for field, value, known in [
            *(("types", name, PAYLOADS) for name in types),
            ("queue", self.queue, ("all", "latest")),
            ("class_", self.class_, CLASSES),
        ]:
            if value not in known:
                raise ValueError(f"port `{self.name}`, {field}: expected one of {', '.join(known)}, found `{value}`")

    def document(self):
        """As the pipe protocol declares it."""
        return {
            "name": self.name,
            "types": list(self.types),
            "about": self.about,
            "queue": self.queue,
            "class": self.class_,
            "required": self.required,
            "join": self.join,
        }


CLASSES = ("state", "data", "query")


class Operator:
    """A pure stage: messages in, messages out. It reads no clock, socket or environment."""

    NAME = ""
    #: Arguments with their defaults; they become attributes of `self.config`.
    DEFAULTS: dict = {}
    INPUTS: list[Port] = []
    OUTPUTS: list[Port] = []

    def __init__(self, config):
        self.config = config

    def on_input(self, port, message, out):
        """Takes one message. An exception is counted and logged with the message's header; the run goes on."""
        raise NotImplementedError

    def on_wake(self, now, out):
        """Is called at the times (ns) that `out.wake_at` asked for."""

    def on_end(self, out):
        """Is called once, after the last message and the last wake."""


class Outputs:
    """What an operator hands to its host during one call, which begins at `now` (ns, on the log's time line)."""

    def __init__(self, operator, now):
        self._types = {port.name: port.types for port in operator.OUTPUTS}
        self.now = now
        self.sent = []
        self.wakes = set()
        self.counts = {}

    def send(self, port, message: Message):
        """Sends a message whose header derives from those of the inputs that made it. A `ready` before now becomes
        now; a later one is kept and delays the message."""
        if port not in self._types:
            raise ValueError(f"expected an output, one of {', '.join(self._types)}, found `{port}`")
        if message.type not in self._types[port]:
            raise ValueError(f"output `{port}` carries {' or '.join(self._types[port])}, found a {message.type}")
        message.header.ready = max(message.header.ready, self.now)
        self.sent.append((port, message))

    def wake_at(self, time):
        """Asks for a call of `on_wake` at `time`, ns; the past means now."""
        self.wakes.add(max(int(time), self.now))

    def count(self, counter, n=1):
        """Adds to a counter of the node."""
        if n > 0:
            self.counts[counter] = self.counts.get(counter, 0) + int(n)

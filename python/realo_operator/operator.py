"""What a stage implements, and what it hands to its host."""

from dataclasses import dataclass

from .message import Header, Message


@dataclass(frozen=True)
class Port:
    """One input or output. What follows `about` matters for inputs only.

    queue: `all` keeps every message in order (at most 1,024 may wait), `latest` one for each agent; class_: of messages
    that are ready at one time `state` goes first, then `data`, then `query`; join: ports of one group are assembled by
    (agent, seq); accounts: the way of what crossed a link ends here, and the stage tells what became of it; lane: `ego`,
    `others`, `others_received` or `ego_received`, whose data it carries where lanes meet (outputs as well).
    """

    name: str
    types: str | tuple[str, ...]
    about: str = ""
    queue: str = "all"
    class_: str = "data"
    required: bool = True
    join: str | None = None
    accounts: bool = False
    lane: str | None = None

    def document(self):
        """As the pipe protocol declares it."""
        words = {name.rstrip("_"): value for name, value in vars(self).items()}
        return {**words, "types": [self.types] if isinstance(self.types, str) else list(self.types)}


@dataclass(frozen=True)
class Counter:
    """What a stage counts. With a `note` the count means that data were lost or changed, and the results say so.

    note: goes on after "rsu1: 3 of 20 ", e.g. "boxes were dropped, because they have no extent"; remedy: what to try; log_fault:
    the log itself is the cause, so that `realo run` exits with 3. `{node}` in both stands for the id of the node.
    """

    name: str
    note: str = ""
    remedy: str = ""
    log_fault: bool = False

    def __post_init__(self):
        if bool(self.note) != bool(self.remedy) or (self.log_fault and not self.note):
            raise ValueError(f"counter `{self.name}`: expected a note and a remedy, or neither")


class Operator:
    """A pure stage: messages in, messages out. It reads no clock, socket or environment."""

    NAME = ""
    #: Settings with their defaults; they become attributes of `self.config`.
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

    def __init__(self, now=0):
        self.now, self.sent, self.rows, self.wakes, self.counts, self.fates = now, [], [], set(), {}, []
        self.losses = {}

    def send(self, port, message: Message):
        """Sends a message whose header derives from those of the inputs that made it. A `ready` before now becomes
        now; a later one is kept and delays the message."""
        self.rows.append(message.write())
        self.sent.append((port, message))

    def used(self, header: Header, query: Header):
        """Says that a collaborator's message took part in a fusion with the ego's message `query`."""
        self.report(header, "used", use={"query": query.seq, "age_ns": query.ready - header.stamp})

    def report(self, header: Header, fate, **more):
        """Says what became of a message that crossed a link: `used`, `skipped`, `over_limit`, `distrusted`,
        `stale`, `superseded`, `lost`, `rejected` or `in_flight`. Only whoever ends a message's way says so; of any other nothing is said."""
        if header.to:
            crossing = {"from": header.agent, "to": header.to, "kind": header.kind, "seq": header.seq}
            self.fates.append({**crossing, "fate": fate, **more})

    def wake_at(self, time):
        """Asks for a call of `on_wake` at `time`, ns; the past means now."""
        self.wakes.add(int(time))

    def count(self, counter, n=1, agent="", of=0):
        """Adds to a counter of the node: a `Counter`, or the name of one that means no loss. `agent`: whose data they are; of:
        `n` of so many (count 0 of them too, so that a note can say how many of how many)."""
        n, of = int(n), int(of)
        counter = Counter(counter) if isinstance(counter, str) else counter
        if n:
            self.counts[counter.name] = self.counts.get(counter.name, 0) + n
        if counter.note and (n or of):
            meaning = "log_fault" if counter.log_fault else "loss"
            words = {"meaning": meaning, "note": counter.note, "remedy": counter.remedy, "agents": {}}
            agents = self.losses.setdefault(counter.name, words)["agents"]
            share = agents.setdefault(agent, {"count": 0, "of": 0})
            share["count"], share["of"] = share["count"] + n, share["of"] + of

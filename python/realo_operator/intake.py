"""What waits in front of a stage: queues, slots and joins. It knows no clock."""

from collections import deque

from .books import add, input_books
from .operator import CLASSES

#: Messages that an `all` port may hold.
CAPACITY = 1024
#: Deliveries that are remembered of an agent and port, to know the copies that a channel makes.
REMEMBERED = 64


class Work:
    """Messages that a stage takes in one go: one, or a complete set of a join group in declared order."""

    def __init__(self, calls):
        self.calls = calls
        self.ready = max(message.header.ready for _, message in calls)

    @property
    def header(self):
        return self.calls[0][1].header


class Intake:
    """wired: names of the inputs that the graph feeds; the others of a join group are not waited for."""

    def __init__(self, inputs, wired):
        self._ports = {port.name: port for port in inputs}
        self._rank = {port.name: i for i, port in enumerate(inputs)}
        self._wired = set(wired)
        self.books = {port.name: input_books() for port in inputs if port.name in self._wired}
        self._sets = {}
        self._last = {}
        self._waiting = {}
        self._arrivals = 0
        self._deliveries = {}

    def is_idle(self):
        return not self._waiting

    def offer(self, port, message):
        """Takes in a message. Raises `RuntimeError` if an `all` port holds too many."""
        add(self.books[port]["received"], message.header)
        if self._ports[port].join is None:
            self._enqueue(port, Work([(port, message)]))
        elif (work := self._complete(port, message)) is not None:
            self._enqueue(work.calls[0][0], work)

    def first(self):
        """Time and class of the next work, `None` without any."""
        place = min(self._waiting, default=None)
        return None if place is None else (place[0], CLASSES[place[1]])

    def next(self):
        """The next work, `None` without any."""
        if not self._waiting:
            return None
        work = self._waiting.pop(min(self._waiting))
        for port, message in work.calls:
            self._deliver(port, message.header, "taken")
        return work

    def reject(self, port, header):
        """Counts a message that the stage was given and could not take."""
        self._deliver(port, header, "rejected")

    def close(self):
        """Counts the parts of sets that never became complete; called once, at the end."""
        for sets in self._sets.values():
            for parts in sets.values():
                self._unjoin(parts)
        self._sets = {}

    def _unjoin(self, parts):
        for port, message in parts.items():
            add(self.books[port]["unjoined"], message.header)

    def _complete(self, port, message):
        group, header = self._ports[port].join, message.header
        members = [p.name for p in self._ports.values() if p.join == group and p.name in self._wired]
        key = (group, header.agent)
        if key in self._last and header.stamp <= self._last[key]:
            self._unjoin({port: message})
            return None
        sets = self._sets.setdefault(key, {})
        parts = sets.setdefault(header.seq, {})
        if port in parts:
            self._unjoin({port: parts[port]})
        parts[port] = message
        if len(parts) < len(members):
            if len(sets) > CAPACITY:
                self._unjoin(sets.pop(min(sets)))
            return None
        del sets[header.seq]
        self._last[key] = header.stamp
        for seq in [s for s, p in sets.items() if all(m.header.stamp <= header.stamp for m in p.values())]:
            self._unjoin(sets.pop(seq))
        return Work([(name, parts[name]) for name in members])

    def _enqueue(self, port, work):
        if self._ports[port].queue == "latest" and not self._replace(port, work):
            return
        if sum(place[2] == self._rank[port] for place in self._waiting) >= CAPACITY:
            raise RuntimeError(f"input `{port}` holds {CAPACITY} waiting messages: the stage cannot keep up")
        self._arrivals += 1
        class_ = max(CLASSES.index(self._ports[name].class_) for name, _ in work.calls)
        header = work.header
        self._waiting[(work.ready, class_, self._rank[port], header.agent, header.seq, self._arrivals)] = work

    def _replace(self, port, work):
        """Empties the slot of an agent for newer work; what is older than the waiting one is passed over itself."""
        slot = [p for p in self._waiting if p[2] == self._rank[port] and p[3] == work.header.agent]
        if slot and self._waiting[slot[0]].header.stamp > work.header.stamp:
            self._skip(work)
            return False
        for place in slot:
            self._skip(self._waiting.pop(place))
        return True

    def _skip(self, work):
        for port, message in work.calls:
            add(self.books[port]["skipped"], message.header)
            self._deliver(port, message.header, "skipped")

    def _deliver(self, port, header, event):
        """Notes what became of a message if a link delivered it, and counts it anew with its copies."""
        if not header.to:
            return
        known = self._deliveries.setdefault((port, header.agent), deque(maxlen=REMEMBERED))
        message = (header.kind, header.seq, header.stamp)
        delivery = next((d for d in known if d["message"] == message), None)
        if delivery is None:
            delivery = {"message": message, "taken": 0, "skipped": 0, "rejected": 0}
            known.append(delivery)
        if (before := _fate(delivery)) is not None:
            add(self.books[port][before], header, -1)
        delivery[event] += 1
        if (after := _fate(delivery)) is not None:
            add(self.books[port][after], header)


def _fate(delivery):
    """Where a delivery counts: nowhere once a copy got through, else as skipped if one was."""
    if delivery["taken"] > delivery["rejected"]:
        return None
    if delivery["skipped"]:
        return "delivered_skipped"
    return "delivered_rejected" if delivery["rejected"] else None

"""What a node counts, in the form in which `end` carries it."""


def tally():
    """Messages per agent and kind."""
    return {}


def add(tally, header, n=1):
    kinds = tally.setdefault(header.agent, {})
    kinds[header.kind] = max(0, kinds.get(header.kind, 0) + n)


def input_books():
    """The books of one input."""
    tallies = ("received", "skipped", "delivered_skipped", "delivered_rejected", "unjoined")
    numbers = ("transport_lost", "transport_repeated", "transport_reordered")
    return {**{name: tally() for name in tallies}, **dict.fromkeys(numbers, 0)}


class Durations:
    """Durations to three significant digits."""

    def __init__(self):
        self._counts = {}

    def record(self, nanos):
        nanos = max(0, int(nanos))
        unit = 10 ** max(0, len(str(nanos)) - 3)
        nanos = nanos // unit * unit
        self._counts[nanos] = self._counts.get(nanos, 0) + 1

    def document(self):
        return [[nanos, count] for nanos, count in sorted(self._counts.items())]

"""Puts the messages of one dora edge back in order of `hop`, and counts what dora lost, repeated or shuffled."""

#: How long a missing hop is waited for, ns.
PATIENCE = 20_000_000
#: Hops that were given up and are remembered, so that one that comes late is not counted twice.
REMEMBERED = 4096


class Reorder:
    def __init__(self, books):
        self._books = books
        self._next = 0
        self._early = {}
        self._given_up = []
        self._missing_since = None

    def offer(self, hop, item, now):
        """Takes in a message at wall time `now`; gives what can be handed on."""
        if hop in self._given_up:
            # Came after it had been counted as lost: dropped, and stays lost.
            return []
        if hop < self._next or hop in self._early:
            self._books["transport_repeated"] += 1
            return []
        if self._early and hop < max(self._early):
            self._books["transport_reordered"] += 1
        self._early[hop] = item
        return self._hand_on(now)

    def expire(self, now):
        """Gives up on hops that have been missing for too long; gives what can be handed on then."""
        ready = []
        while self._missing_since is not None and now - self._missing_since >= PATIENCE and self._early:
            self._give_up_before(min(self._early))
            ready += self._hand_on(now)
        return ready

    def deadline(self):
        """When `expire` has something to do, in wall time; `None`: never."""
        return None if self._missing_since is None else self._missing_since + PATIENCE

    def is_complete(self, count, now):
        """The edge ends after `count` messages: whether all of them came. Missing ones start to be waited for."""
        if self._next >= count:
            return True
        if self._missing_since is None:
            self._missing_since = now
        return False

    def finish(self, count):
        """Gives up on everything up to `count`; gives what came of it."""
        ready = []
        while self._next < count:
            self._give_up_before(min(self._early, default=count))
            ready += self._hand_on(0)
        self._missing_since = None
        return ready

    def _give_up_before(self, hop):
        self._books["transport_lost"] += hop - self._next
        self._given_up = (self._given_up + list(range(self._next, hop)))[-REMEMBERED:]
        self._next = hop
        self._missing_since = None

    def _hand_on(self, now):
        ready = []
        while self._next in self._early:
            ready.append(self._early.pop(self._next))
            self._next += 1
        if not self._early:
            self._missing_since = None
        elif ready or self._missing_since is None:
            self._missing_since = now
        return ready

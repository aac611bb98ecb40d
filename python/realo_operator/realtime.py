"""Hosts an operator as a dora process.

Messages are put back in the order of their `hop`, held until they are ready on the replay's clock, and queued as their
ports say. The stage ends when every input has sent its `end`; an input that closes without one means that a node died,
and this one fails too.
"""

import heapq
import json
import sys
import time
import traceback

from . import books
from .intake import Intake
from .message import Header, Message
from .operator import CLASSES, Outputs
from .reorder import Reorder

END, HELLO = "realo/end", "realo/hello"
#: How often the last word is said, and how far apart, s.
TIMES, APART = 3, 0.05
#: How long an input that dora has closed may still deliver its `end`, ns.
GRACE = 2_000_000_000
#: How long a node waits at most without looking around, ns.
IDLE = 200_000_000
#: Between two hellos that are passed on, ns.
HELLO_EVERY = 40_000_000
#: Errors that are printed; the rest is only counted.
LOGGED = 5


def serve(stage):
    """Joins the dataflow that started this process and runs to the end. Raises `RuntimeError` if it fails."""
    import dora

    Host(stage, dora.Node()).run()


class Edge:
    def __init__(self, port, source, input_books):
        self.port, self.source = port, source
        self.reorder = Reorder(input_books)
        self.end = self.closed = None
        self.complete = False


class Host:
    def __init__(self, stage, node):
        self.stage, self.node = stage, node
        config = node.node_config()
        self.id = config["id"] if "id" in config else stage.NAME
        self.inputs = {port.name: port for port in stage.INPUTS}
        wired = self._wired(config)
        self.intake = Intake(stage.INPUTS, wired)
        self.edges = {port: Edge(port, source, self.intake.books[port]) for port, source in wired.items()}
        self.hops = {port.name: 0 for port in stage.OUTPUTS}
        self.outputs = {}
        self.counters, self.errors, self.compute = {}, 0, books.Durations()
        self.held, self.arrivals = [], 0
        self.wakes = []
        self.clock = None
        self.run_name, self.above, self.last_hello = "", {}, 0

    def run(self):
        while not self._is_done():
            self._step()
        self._finish()

    def _wired(self, config):
        wired = {}
        for port, given in (config.get("inputs") or {}).items():
            if port not in self.inputs:
                raise ValueError(f"no input `{port}`; {self.stage.NAME} has: {', '.join(self.inputs)}")
            wired[port] = str(given.get("mapping", given) if isinstance(given, dict) else given)
        for port in self.inputs.values():
            if port.required and port.name not in wired:
                raise ValueError(f"input `{port.name}` must be wired: {port.about}")
        return wired

    def _is_done(self):
        complete = all(edge.complete for edge in self.edges.values())
        return complete and not self.held and self.intake.is_idle() and not self.wakes

    def _log_now(self):
        if self.clock is None:
            return 0
        wall, log, rate = self.clock
        return log + round((time.time_ns() - wall) * rate)

    def _wall_at(self, at):
        if self.clock is None:
            return 0
        wall, log, rate = self.clock
        return wall + round((at - log) / rate)

    def _step(self):
        while (event := self.node.try_recv()) is not None:
            self._hear(event)
        self._settle_edges()
        self._let_in()
        if self._serve():
            return
        wait = (self._next_deadline() - time.time_ns()) / 1e9
        if wait > 0 and (event := self._next(wait)) is not None:
            self._hear(event)

    def _next(self, seconds):
        before = time.monotonic()
        event = self.node.next(timeout=seconds)
        if event is None and (left := seconds - (time.monotonic() - before)) > 0:
            # The stream is closed; the time still has to pass for what is held.
            time.sleep(left)
        return event

    def _next_deadline(self):
        times = [time.time_ns() + IDLE]
        times += [deadline for e in self.edges.values() if (deadline := e.reorder.deadline()) is not None]
        times += [self._wall_at(self.held[0][0])] if self.held else []
        times += [self._wall_at(self.wakes[0])] if self.wakes else []
        return min(times)

    def _hear(self, event):
        kind = event["type"]
        if kind == "INPUT":
            self._hear_message(event["id"], event["value"])
        elif kind == "INPUT_CLOSED":
            if (edge := self.edges.get(event["id"])) is not None:
                edge.closed = time.time_ns()
        elif kind == "NODE_FAILED":
            raise RuntimeError(f"{self.id}: a node above failed: {event.get('error')}")
        elif kind == "STOP" and str(event.get("id", "")).upper() == "MANUAL":
            raise RuntimeError(f"{self.id}: stopped before the end of the stream")
        elif kind == "ERROR" and event.get("error") is not None and "timed out" not in str(event["error"]).lower():
            print(f"realo: {self.id}: dora: {event['error']}", file=sys.stderr, flush=True)

    def _hear_message(self, port, row):
        edge = self.edges.get(port)
        if edge is None:
            return
        try:
            message = Message.read(row)
        except ValueError as error:
            raise ValueError(f"{self.id}: input `{port}` from {edge.source}: not a realo message: {error}") from error
        header = message.header
        if self.clock is None and header.clock_origins:
            self.clock = (*header.clock_origins, header.clock_rate[0])
        topic = message.payload.get("topic") if message.type == "Report" else None
        if topic == HELLO:
            return self._pass_hello()
        if topic == END:
            end = json.loads(message.payload["json"])
            edge.end = end["hops"]
            for node, counted in end["books"]["nodes"].items():
                self.above.setdefault(node, counted)
            return None
        types = self.inputs[port].types
        if message.type not in types:
            expected = " or ".join(types)
            raise ValueError(f"{self.id}: input `{port}` takes {expected}, found {message.type} from {edge.source}")
        self.run_name = header.run
        return self._hold(port, edge.reorder.offer(header.hop, message, time.time_ns()))

    def _pass_hello(self):
        now = time.time_ns()
        if now - self.last_hello >= HELLO_EVERY:
            self.last_hello = now
            self._mark(HELLO, lambda _: "")

    def _mark(self, topic, document):
        clock = self.clock or ()
        for port in self.hops:
            header = Header(clock_origins=list(clock[:2]), clock_rate=list(clock[2:]))
            report = Message(header, "Report", {"topic": topic, "json": document(port)})
            self.node.send_output(port, report.write(), {})

    def _hold(self, port, messages):
        rank = {name: i for i, name in enumerate(self.inputs)}[port]
        class_ = CLASSES.index(self.inputs[port].class_)
        for message in messages:
            header = message.header
            place = (header.ready, class_, rank, header.agent, header.seq, self.arrivals)
            self.arrivals += 1
            heapq.heappush(self.held, (*place, port, message))

    def _settle_edges(self):
        """Gives up on what dora lost, and closes inputs that have ended."""
        now = time.time_ns()
        for edge in self.edges.values():
            if edge.complete:
                continue
            ready = edge.reorder.expire(now)
            if edge.end is not None and edge.reorder.is_complete(edge.end, now):
                edge.complete = True
            elif edge.end is not None and (edge.reorder.deadline() or now + 1) <= now:
                ready += edge.reorder.finish(edge.end)
                edge.complete = True
            elif edge.end is None and edge.closed is not None and now - edge.closed > GRACE:
                node = edge.source.split("/")[0]
                raise RuntimeError(f"{self.id}: node `{node}` failed: its output {edge.source} closed without an end")
            self._hold(edge.port, ready)

    def _let_in(self):
        """Moves held messages whose time has come to the queues."""
        now = self._log_now()
        while self.held and self.held[0][0] <= now:
            *_, port, message = heapq.heappop(self.held)
            self.intake.offer(port, message)

    def _serve(self):
        """Makes the next call, if one is due."""
        start = self._log_now()
        wake = self.wakes[0] if self.wakes and self.wakes[0] <= start else None
        first = self.intake.first()
        if wake is not None and (first is None or wake < first[0] or (wake == first[0] and first[1] == "query")):
            # A wake comes after the data and before the queries of its instant.
            heapq.heappop(self.wakes)
            self._call(start, wake, [(None, lambda out: self.stage.on_wake(start, out))])
            return True
        if (work := self.intake.next()) is None:
            return False
        self._call(start, work.ready, [(call, self._input(*call)) for call in work.calls])
        return True

    def _input(self, port, message):
        return lambda out: self.stage.on_input(port, message, out)

    def _call(self, start, ready, calls, timed=True):
        begun = time.time_ns()
        out = Outputs(self.stage, start)
        for given, call in calls:
            identity = None if given is None else given[1].header.copy()
            try:
                call(out)
            except Exception as error:  # noqa: BLE001: an error belongs to one message, the run goes on
                self._log(f"input `{given[0]}`, {identity}" if given else f"at {start} ns", error)
                if given is not None:
                    self.intake.reject(given[0], identity)
        if timed:
            self.compute.record(time.time_ns() - begun)
        for counter, n in out.counts.items():
            self.counters[counter] = self.counters.get(counter, 0) + n
        for wake in out.wakes:
            if wake not in self.wakes:
                heapq.heappush(self.wakes, wake)
        done = max(self._log_now(), start)
        for port, message in out.sent:
            self._send(port, message, ready, start, done)

    def _log(self, place, error):
        self.errors += 1
        if self.errors <= LOGGED:
            if not isinstance(error, ValueError):
                traceback.print_exception(error)
            print(f"realo: {self.id} ({self.stage.NAME}): {place}: {error}", file=sys.stderr, flush=True)

    def _send(self, port, message, ready, start, done):
        header = message.header.copy()
        wall, log, rate = self.clock
        header.clock_origins, header.clock_rate = [wall, log], [rate]
        header.run = header.run or self.run_name
        # The operator saw the call begin at `start`; a `ready` beyond that is a delay which follows the computation.
        header.ready = done + max(0, header.ready - start)
        header.hop = self.hops[port]
        self.hops[port] += 1
        entry = (self.id, ready, start, done, header.ready)
        for name, value in zip(("node", "input", "start", "done", "ready"), entry):
            getattr(header, f"trace_{name}").append(value)
        books.add(self.outputs.setdefault(port, books.tally()), header)
        self.node.send_output(port, Message(header, message.type, message.payload).write(), {})

    def _finish(self):
        start = self._log_now()
        self._call(start, start, [(None, self.stage.on_end)], timed=False)
        self.intake.close()
        own = {
            "name": self.stage.NAME,
            "inputs": self.intake.books,
            "outputs": self.outputs,
            "counters": self.counters,
            "errors": self.errors,
            "compute": self.compute.document(),
        }
        nodes = {**self.above, self.id: own}
        for round_ in range(TIMES):
            if round_ > 0:
                time.sleep(APART)
            self._mark(END, lambda port: json.dumps({"hops": self.hops[port], "books": {"nodes": nodes}}))

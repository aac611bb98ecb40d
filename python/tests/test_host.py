"""What the host does around an operator, by cases that can be worked out by hand."""

import random
import subprocess
import sys
import unittest

from realo_operator import Header, Message, Operator, Port
from realo_operator.books import input_books
from realo_operator.intake import CAPACITY, Intake
from realo_operator.main import configuration
from realo_operator.operator import Outputs
from realo_operator.reorder import PATIENCE, Reorder

PORTS = [
    Port("a", "Report", join="frame"),
    Port("b", "Report", join="frame"),
    Port("all", "Report"),
    Port("latest", "Report", queue="latest"),
]


def report(agent, seq, to=""):
    header = Header(agent=agent, kind="boxes", seq=seq, stamp=seq * 10, ready=seq * 10, to=to)
    return Message(header, "Report", {"topic": "t", "json": ""})


def intake():
    return Intake(PORTS, [port.name for port in PORTS])


def seqs(work):
    return [(port, message.header.seq) for port, message in work.calls]


def total(tally):
    return sum(n for kinds in tally.values() for n in kinds.values())


class TestIntake(unittest.TestCase):
    def test_joins_by_agent_and_seq_and_discards_older_parts(self):
        room = intake()
        room.offer("a", report("x", 1))
        room.offer("b", report("x", 2))
        room.offer("b", report("y", 1))
        self.assertIsNone(room.next())
        room.offer("a", report("x", 2))
        self.assertEqual(seqs(room.next()), [("a", 2), ("b", 2)])
        room.offer("b", report("x", 1))
        self.assertIsNone(room.next())
        self.assertEqual(total(room.books["a"]["unjoined"]), 1)
        self.assertEqual(total(room.books["b"]["unjoined"]), 1)
        room.close()
        self.assertEqual(total(room.books["b"]["unjoined"]), 2)

    def test_latest_keeps_the_newest_of_each_agent(self):
        room = intake()
        for seq in (1, 3, 2):
            room.offer("latest", report("x", seq))
        room.offer("latest", report("y", 0))
        self.assertEqual(seqs(room.next()), [("latest", 0)])
        self.assertEqual(seqs(room.next()), [("latest", 3)])
        self.assertTrue(room.is_idle())
        self.assertEqual(total(room.books["latest"]["skipped"]), 2)

    def test_a_delivered_message_counts_once_by_the_copy_that_came_furthest(self):
        # t taken, r given and rejected, s skipped.
        cases = {"t": (0, 0), "s": (1, 0), "r": (0, 1), "st": (0, 0), "ts": (0, 0), "rt": (0, 0), "ss": (1, 0)}
        cases.update({"rr": (0, 1), "rs": (1, 0), "sr": (1, 0)})
        for copies, expected in cases.items():
            room = intake()
            for newer, fate in enumerate(copies, 10):
                room.offer("latest", report("x", 1, to="ego"))
                if fate == "s":
                    room.offer("latest", report("x", newer))
                work = room.next()
                if fate == "r":
                    room.reject("latest", work.header)
            books = room.books["latest"]
            found = (total(books["delivered_skipped"]), total(books["delivered_rejected"]))
            self.assertEqual(found, expected, copies)

    def test_all_refuses_to_overflow(self):
        room = intake()
        for seq in range(CAPACITY):
            room.offer("all", report("x", seq))
        with self.assertRaisesRegex(RuntimeError, "`all` holds 1024"):
            room.offer("all", report("x", 9999))
        self.assertEqual(seqs(room.next()), [("all", 0)])


class TestReorder(unittest.TestCase):
    def test_waits_for_a_missing_hop_and_then_gives_up(self):
        books = input_books()
        reorder = Reorder(books)
        order = reorder.offer(0, 0, 0) + reorder.offer(2, 2, 1)
        late = 2 + PATIENCE
        order += reorder.expire(late) + reorder.offer(3, 3, late) + reorder.offer(1, 1, late)
        self.assertEqual((order, books["transport_lost"], books["transport_repeated"]), ([0, 2, 3], 1, 0))

    def test_accounts_for_every_hop(self):
        for seed in range(300):
            draw = random.Random(seed)
            books, order, now = input_books(), [], 0
            reorder = Reorder(books)
            for _ in range(draw.randrange(120)):
                now += draw.randrange(30_000_000)
                hop = draw.randrange(40)
                order += reorder.expire(now) + reorder.offer(hop, hop, now)
            order += reorder.finish(40)
            self.assertEqual(order, sorted(set(order)))
            self.assertEqual(len(order) + books["transport_lost"], 40)


class Mine(Operator):
    NAME = "mine"
    DEFAULTS = {"threshold": 0.15, "name": "x", "agents": [], "on": True}
    OUTPUTS = [Port("out", "Report")]


class TestOperator(unittest.TestCase):
    def test_arguments_over_defaults(self):
        config = configuration(Mine, ["threshold=1", "name=7", "on=false"])
        self.assertEqual((config.threshold, config.name, config.on, config.agents), (1.0, "7", False, []))
        for args, expected in [
            (["treshold=1"], "did you mean `threshold`"),
            (["threshold=many"], "`many` is no value"),
            (["threshold"], "key=value"),
            (["on=3"], "found `3`"),
            (["name=a", "name=b"], "given twice"),
        ]:
            with self.assertRaisesRegex(ValueError, expected):
                configuration(Mine, args)

    def test_outputs_refuse_what_was_not_declared(self):
        out = Outputs(Mine, 50)
        out.send("out", report("x", 1))
        self.assertEqual(out.sent[0][1].header.ready, 50)
        with self.assertRaisesRegex(ValueError, "found `ouf`"):
            out.send("ouf", report("x", 1))
        boxes = Message(Header(), "Boxes", {})
        with self.assertRaisesRegex(ValueError, "carries Report, found a Boxes"):
            out.send("out", boxes)
        out.wake_at(3)
        self.assertEqual(out.wakes, {50})

    def test_messages_come_back_and_what_is_none_is_refused(self):
        pose = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
        columns = {name: [1.0, 2.0] for name in ("x", "y", "z", "length", "width", "height", "yaw", "score")}
        columns |= {"class": ["Car", "Van"], "track": [None, 2**64 - 1], "covariance": [None, None]}
        columns["velocity"] = [None, [1.0, 2.0, 3.0]]
        message = Message(Header(agent="x", kind="boxes", pose=pose, trace_node=["a"]), "Boxes", columns)
        back = Message.read(message.write())
        self.assertEqual(back.header, message.header)
        self.assertEqual({name: column.to_pylist() for name, column in back.payload.items()}, columns)
        selection = Message(Header(), "Selection", {"query": 3, "entries": [message, report("y", 2)]})
        back = Message.read(selection.write())
        self.assertEqual([entry.type for entry in back.payload["entries"]], ["Boxes", "Report"])
        del columns["yaw"]
        with self.assertRaisesRegex(ValueError, "needs the column `yaw`"):
            message.write()
        with self.assertRaisesRegex(ValueError, "a message is a struct array of 1 row"):
            Message.read(back.write().slice(0, 0))

    def test_a_program_without_a_driver_fails_with_a_code(self):
        code = "from realo_operator import *\nclass M(Operator):\n NAME='m'\nrun(M)"
        done = subprocess.run([sys.executable, "-c", code, "x=1"], capture_output=True, text=True, check=False)
        self.assertEqual(done.returncode, 1)
        self.assertIn("unknown argument `x`", done.stderr)


if __name__ == "__main__":
    unittest.main()

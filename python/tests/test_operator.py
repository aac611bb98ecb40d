"""What the module does, by cases that can be worked out by hand."""

import io
import math
import os
import random
import subprocess
import sys
import unittest

import numpy as np
import pyarrow as pa
from realo_operator import Counter, Header, Message, Operator, Outputs, Port, geometry, pipe
from realo_operator.pipe import configuration


class Echo(Operator):
    NAME = "echo"
    DEFAULTS = {"score": 0.5, "most": None, "names": ["a"], "deep": False, "ego": "cav1"}
    INPUTS = [Port("clouds", "PointCloud")]
    OUTPUTS = [Port("clouds", "PointCloud")]

    def on_input(self, port, message, out):
        if message.header.seq == 13:
            raise ValueError("no luck")
        out.used(message.header, Header(seq=5, ready=100))
        out.send("clouds", message)


def cloud(points, seq=0):
    columns = {axis: np.arange(points, dtype=np.float32) for axis in "xyz"}
    kinds = {"intensity": np.uint8, "time": np.int32, "ring": np.uint16}
    columns.update({name: np.ones(points, kind) for name, kind in kinds.items()})
    return Message(Header(agent="cav2", to="cav1", kind="points", seq=seq, stamp=40), "PointCloud", columns)


def boxes(*rows):
    """Boxes of (x, y, length, width, yaw)."""
    columns = {name: np.array(values, float) for name, values in zip(("x", "y", "length", "width", "yaw"), zip(*rows))}
    n = len(rows)
    unknown = {"velocity": np.full((n, 3), np.nan), "covariance": np.full((n, 9), np.nan)}
    texts = {"class": np.array(["Car"] * n, object), "track": np.array([None] * n, object)}
    return {**columns, "z": np.zeros(n), "height": np.ones(n), "score": np.ones(n, np.float32), **unknown, **texts}


class TestMessage(unittest.TestCase):
    def test_payloads_come_back_and_numbers_share_memory(self):
        columns = boxes((1, 2, 4, 2, 0.1), (3, 4, 4, 2, 0.2))
        columns["velocity"][1] = [1, 2, 3]
        columns["track"][0] = 2**64 - 1
        header = Header(agent="cav1", kind="boxes", seq=3, pose=[1, 2, 3, 0, 0, 0, 1])
        row = Message(header, "Boxes", columns).write()
        back = Message.read(row)
        self.assertEqual((back.header.seq, back.header.pose, back.header.to), (3, header.pose, ""))
        for name, values in columns.items():
            np.testing.assert_array_equal(back.payload[name], values, name)
        again = Message.read(back.write())
        np.testing.assert_array_equal(again.payload["velocity"], columns["velocity"])
        self.assertFalse(back.payload["x"].flags.writeable)
        selection = Message(header, "Selection", {"query": 3, "entries": [back, cloud(2)]})
        entries = Message.read(selection.write()).payload["entries"]
        self.assertEqual([entry.type for entry in entries], ["Boxes", "PointCloud"])

    def test_feature_maps_have_their_shape(self):
        data = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
        payload = {"rows": 2, "columns": 3, "channels": 4, "cell": 0.4, "origin": [0, 0], "dtype": "f32", "model": "m"}
        payload |= {"confidence": []}
        back = Message.read(Message(Header(), "FeatureMap", {**payload, "data": data}).write())
        np.testing.assert_array_equal(back.payload["data"], data)

    def test_says_what_does_not_fit(self):
        with self.assertRaisesRegex(ValueError, "a PointCloud needs the column `x`"):
            Message(Header(), "PointCloud", {}).write()
        with self.assertRaisesRegex(ValueError, "field `seq`"):
            cloud(1, seq="many").write()


class TestPipe(unittest.TestCase):
    def answers(self, messages, shares):
        """What a stage answers to calls with these messages, over real pipes."""
        (call_end, calls), (replies, reply_end) = os.pipe(), os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(calls), os.close(replies)
            with os.fdopen(call_end, "rb") as read, os.fdopen(reply_end, "wb") as write:
                pipe.serve(Echo(configuration(Echo, [])), read, write, shares)
            os._exit(0)
        os.close(call_end), os.close(reply_end)
        found, memory = [], pipe.Memory()
        with os.fdopen(calls, "wb") as write, os.fdopen(replies, "rb") as read:
            hello = pipe.read(read, None)
            found.append(hello.column("memory")[0].as_py())
            for message in messages:
                call = {"call": ["input"], "port": ["clouds"], "now": [7], "message": message.write()}
                pipe.write(write, call, memory, shares)
                found.append(pipe.read(read, memory))
            pipe.write(write, {"call": ["end"], "port": [""], "now": [8]}, memory, False)
            found.append(pipe.read(read, memory))
        self.assertEqual(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), 0)
        return found

    def test_answers_over_the_pipe_and_through_shared_memory(self):
        for shares, points in [(False, 10), (False, 100_000), (hasattr(os, "memfd_create"), 100_000)]:
            memory, one, bad, end = self.answers([cloud(points), cloud(points, seq=13)], shares)
            self.assertEqual(memory, "memfd" if shares else "pipe")
            back = Message.read(one.column("message_0"))
            np.testing.assert_array_equal(back.payload["x"], cloud(points).payload["x"])
            self.assertIn('"fate": "used", "use": {"query": 5, "age_ns": 60}', one.column("reported")[0].as_py())
            self.assertEqual(bad.column("error")[0].as_py(), "no luck")
            self.assertEqual(end.column("ports")[0].as_py(), [])

    def test_errors_that_do_not_explain_themselves_say_what_and_where(self):
        def told(raise_):
            try:
                raise_()
            except Exception as error:  # noqa: BLE001: any error
                return pipe._told(error)

        def key():
            {}["velocity"]

        def silent():
            assert False

        def plain():
            raise ValueError("expected boxes, found none")

        self.assertRegex(told(key), r"^KeyError: 'velocity' \(test_operator\.py, line \d+\)$")
        self.assertRegex(told(silent), r"^AssertionError \(test_operator\.py, line \d+\)$")
        self.assertEqual(told(plain), "expected boxes, found none")

    @unittest.skipUnless(hasattr(os, "memfd_create"), "needs files in memory")
    def test_a_file_is_written_again_only_when_all_of_its_frame_is_gone(self):
        lender, borrower = pipe.Memory(), pipe.Memory()

        def frame(points):
            stream = io.BytesIO()
            pipe.write(stream, {"message": cloud(points).write()}, lender, True)
            stream.seek(0)
            return Message.read(pipe.read(stream, borrower).column("message")).payload["x"]

        x = frame(100_000)
        self.assertEqual((len(lender.lent), borrower.give_back()), (1, []))
        y = frame(50_000)
        np.testing.assert_array_equal(x, cloud(100_000).payload["x"])
        self.assertEqual(len(lender.lent), 2)
        del x, y
        answer = io.BytesIO()
        pipe.write(answer, {"one": [1]}, borrower, True)
        answer.seek(0)
        pipe.read(answer, lender)
        self.assertEqual((len(lender.free), lender.lent), (2, {}))
        self.assertEqual([len(frame(points)) for points in (100_000, 150_000)], [100_000, 150_000])
        self.assertEqual((len(lender.free), len(lender.lent)), (0, 2))
        kept = [frame(10_000) for _ in range(pipe.LENT_AT_MOST)]
        self.assertEqual((len(lender.lent), len(kept)), (pipe.LENT_AT_MOST, pipe.LENT_AT_MOST))

    @unittest.skipUnless(hasattr(os, "memfd_create"), "needs files in memory")
    def test_memory_that_could_be_cut_is_refused(self):
        file = os.memfd_create("test", os.MFD_ALLOW_SEALING)
        os.ftruncate(file, 10)
        with self.assertRaisesRegex(ValueError, "memory of 10 bytes, sealed"):
            pipe.mapped(os.getpid(), file, 10)
        os.close(file)
        self.assertFalse(pipe.reaches("") or pipe.reaches("1 2 3") or pipe.reaches(f"{os.getpid()} {file} 10"))

    def test_cut_frames_are_errors(self):
        with self.assertRaisesRegex(ValueError, "9 bytes, found 1"):
            pipe.read(io.BytesIO(b"\x09\0\0\0\0\0\0\0x"), pipe.Memory())
        self.assertIsNone(pipe.read(io.BytesIO(), pipe.Memory()))


class TestCounters(unittest.TestCase):
    def test_losses_know_their_words_their_agents_and_how_many_there_were(self):
        late = Counter("late", "boxes were late", "wait longer")
        off = Counter("off", "boxes have no pose", "write poses", log_fault=True)
        out = Outputs()
        for n in (1, 0, 2):
            out.count(late, n, "rsu1", 5)
        out.count(off, 1)
        out.count("kept", 3)
        out.count("none", 0)
        self.assertEqual(out.counts, {"late": 3, "off": 1, "kept": 3})
        self.assertEqual(
            out.losses,
            {
                "late": {
                    "meaning": "loss",
                    "note": "boxes were late",
                    "remedy": "wait longer",
                    "agents": {"rsu1": {"count": 3, "of": 15}},
                },
                "off": {
                    "meaning": "log_fault",
                    "note": "boxes have no pose",
                    "remedy": "write poses",
                    "agents": {"": {"count": 1, "of": 0}},
                },
            },
        )

    def test_a_note_without_a_remedy_is_refused(self):
        for words in [{"note": "boxes were late"}, {"remedy": "wait"}, {"log_fault": True}]:
            with self.assertRaisesRegex(ValueError, "counter `late`: expected a note and a remedy"):
                Counter("late", **words)


class TestConfiguration(unittest.TestCase):
    def test_reads_values_over_defaults(self):
        found = configuration(Echo, ["score=1", "most=3", "names=a, b", "deep=true", "ego=7"])
        self.assertEqual(vars(found), {"score": 1.0, "most": 3, "names": ["a", "b"], "deep": True, "ego": "7"})
        self.assertIs(type(found.score), float)

    def test_refuses_with_the_nearest_name(self):
        cases = {
            "scor=1": "did you mean `score`",
            "score=x": "setting `score`: expected JSON such as `0.5`, found `x`: ",
            "score": "setting `score` is not of the form key=value",
            "deep=1": "expected a value like `false`",
        }
        for arg, expected in cases.items():
            with self.assertRaisesRegex(ValueError, expected):
                configuration(Echo, [arg])
        with self.assertRaisesRegex(ValueError, "setting `ego` is given twice, as `a` and as `b`: keep one"):
            configuration(Echo, ["ego=a", "ego=b"])


class TestRefusal(unittest.TestCase):
    def test_the_host_hears_why_settings_are_refused(self):
        code = "import sys; sys.path.insert(0, sys.argv.pop(1)); from test_operator import Echo, pipe; pipe.run(Echo)"
        tests = os.path.dirname(os.path.abspath(__file__))
        paths = os.pathsep.join([os.path.dirname(tests), os.environ.get("PYTHONPATH", "")])
        for host, arg in (("pipe", "scor=1"), ("", "score=1")):
            env = {**os.environ, "REALO_DRIVER": host, "PYTHONPATH": paths}
            words = [sys.executable, "-B", "-c", code, tests, arg]
            done = subprocess.run(words, capture_output=True, env=env, stdin=subprocess.DEVNULL)
            self.assertEqual(done.returncode, 1, done.stderr)
            if not host:
                self.assertIn(b"echo: a plug-in, which a graph starts", done.stderr)
                continue
            self.assertEqual(done.stderr, b"")
            row = pipe.read(io.BytesIO(done.stdout), None)
            self.assertEqual((row.column("version")[0].as_py(), row.column("name")[0].as_py()), (pipe.VERSION, "echo"))
            self.assertIn("did you mean `score`", row.column("refused")[0].as_py())


class TestOutputs(unittest.TestCase):
    def test_fates_are_reported_of_what_crossed_a_link_only(self):
        out = Outputs()
        out.report(Header(agent="cav1"), "rejected")
        out.report(Header(agent="cav2", to="cav1", kind="boxes", seq=4), "stale")
        self.assertEqual(out.fates, [{"from": "cav2", "to": "cav1", "kind": "boxes", "seq": 4, "fate": "stale"}])


class TestGeometry(unittest.TestCase):
    def test_poses_compose_and_invert(self):
        a = geometry.matrix([1, 2, 3, 0, 0, math.sin(0.3), math.cos(0.3)])
        b = geometry.matrix([-4, 5, 0.5, 0.1, -0.2, 0.3, 0.9])
        np.testing.assert_allclose(a @ geometry.inverse(a), np.eye(4), atol=1e-15)
        np.testing.assert_allclose(geometry.relative(a, b), geometry.inverse(a) @ b, atol=1e-14)

    def test_boxes_and_clouds_move(self):
        quarter = geometry.matrix([10, 0, 0, 0, 0, math.sqrt(0.5), math.sqrt(0.5)])
        moved = geometry.transform_boxes(quarter, boxes((1, 0, 4, 2, 0)))
        np.testing.assert_allclose([moved[n][0] for n in ("x", "y", "yaw")], [10, 1, math.pi / 2], atol=1e-15)
        self.assertTrue(np.isnan(moved["velocity"]).all())
        points = geometry.transform_cloud(quarter, cloud(3).payload)
        np.testing.assert_allclose([points["x"], points["y"]], [[10, 9, 8], [0, 1, 2]], atol=1e-6)

    def test_maps_move_with_the_ground(self):
        data = np.arange(5 * 7 * 2, dtype=np.float32).reshape(5, 7, 2)
        map_ = {"rows": 5, "columns": 7, "channels": 2, "cell": 0.8, "origin": [-2.0, -1.6], "dtype": "f32", "model": "m"}
        map_ |= {"data": data, "confidence": []}
        # Two cells ahead and one to the right: its cell (1, 0) is the cell (0, 2) of the frame that it comes to.
        moved, covered = geometry.warp_map(geometry.matrix([1.6, -0.8, 0.3, 0, 0, 0, 1]), map_)
        np.testing.assert_allclose(moved[:4, 2:], data[1:, :5], atol=1e-4)
        np.testing.assert_array_equal(covered, [[row < 4 and column > 1 for column in range(7)] for row in range(5)])
        half, _ = geometry.warp_map(geometry.matrix([0.4, 0, 0, 0, 0, 0, 1]), map_)
        np.testing.assert_allclose(half[:, 1:], (data[:, 1:] + data[:, :-1]) / 2, atol=1e-4)
        around, covered = geometry.warp_map(geometry.matrix([1.6, 0.8, 0, 0, 0, 1, 0]), map_)
        np.testing.assert_allclose(around[0, 0], data[4, 6], atol=1e-4)
        self.assertTrue(covered.all())
        _, far = geometry.warp_map(geometry.matrix([1e6, 0, 0, 0, 0, 0, 1]), map_)
        self.assertFalse(far.any())
        sure = np.zeros((5, 7), np.float32)
        sure[1:3, 2:5] = 0.4
        ones = {**map_, "data": np.ones_like(data), "confidence": sure.ravel()}
        moved, covered = geometry.warp_map(geometry.matrix([1.8, -0.9, 0.3, 0, 0, 0, 1]), ones)
        np.testing.assert_array_equal(covered, [[row < 2 and 4 <= column for column in range(7)] for row in range(5)])
        np.testing.assert_allclose(moved, np.repeat(covered[..., None], 2, axis=2), atol=1e-5)

    def test_maps_that_do_not_fit_are_seen(self):
        data = np.zeros((2, 1, 3), np.float32)
        map_ = {"rows": 2, "columns": 1, "channels": 3, "cell": 0.8, "origin": np.zeros(2), "dtype": "f32", "model": "m"}
        map_ |= {"data": data, "confidence": []}
        self.assertTrue(geometry.same_grid(map_, {**map_, "origin": [0, 0]}))
        poisoned = np.array(data)
        poisoned[0, 0, 1] = np.nan
        for change in ({"model": "n"}, {"cell": 0.4}, {"origin": [0, 1]}, {"rows": 3}, {"data": poisoned}):
            self.assertFalse(geometry.same_grid(map_, {**map_, **change}), change)

    def test_iou_of_cases_by_hand(self):
        one = boxes((0, 0, 4, 2, 0))
        cases = [((0, 0, 4, 2, 0), 1), ((2, 0, 4, 2, 0), 1 / 3), ((0, 0, 4, 2, math.pi / 2), 1 / 3)]
        cases += [((5, 0, 4, 2, 0), 0), ((0, 0, 4, 0, 1), 0), ((0, 0, 1, 1, 0.7), 1 / 8)]
        found = geometry.iou(one, boxes(*(box for box, _ in cases)))
        np.testing.assert_allclose(found, [[iou for _, iou in cases]], atol=1e-12)

    def test_iou_agrees_with_counting(self):
        draw = random.Random(3)
        rows = [(draw.uniform(-3, 3), draw.uniform(-3, 3), draw.uniform(1, 5), draw.uniform(1, 3), draw.uniform(-3, 3))]
        rows += [tuple(draw.uniform(*span) for span in ((-3, 3), (-3, 3), (1, 5), (1, 3), (-3, 3))) for _ in range(7)]
        grid = np.stack(np.meshgrid(*[np.arange(-6, 6, 0.02)] * 2), -1).reshape(-1, 2)

        def inside(x, y, length, width, yaw):
            d = grid - [x, y]
            along, across = d @ [math.cos(yaw), math.sin(yaw)], d @ [-math.sin(yaw), math.cos(yaw)]
            return (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)

        masks = [inside(*row) for row in rows]
        counted = [[(a & b).sum() / (a | b).sum() for b in masks] for a in masks]
        found = geometry.iou(boxes(*rows), boxes(*rows))
        np.testing.assert_allclose(found, counted, atol=0.01)
        np.testing.assert_allclose(found, found.T, atol=1e-12)


if __name__ == "__main__":
    unittest.main()

"""What the writer of logs makes of the values that people give it: scaled by a stated rule, or refused by name."""

import os
import struct
import tempfile
import unittest
from pathlib import Path

import numpy as np
from realo_log import MAGIC, POINT, LogWriter, agent, boxes, view

S = 1_700_000_000_000_000_000
N = 200
XYZ = np.random.default_rng(1).uniform(-20, 20, (N, 3))
SHARE = np.linspace(0, 1, N)
UNIT = [0, 0, 0, 1]


class Case(unittest.TestCase):
    def setUp(self):
        self.folder = tempfile.TemporaryDirectory()
        self.addCleanup(self.folder.cleanup)
        self.path = os.path.join(self.folder.name, "made.mcap")

    def writer(self, **options):
        return LogWriter(self.path, [agent("car", "vehicle")], source="a test", **options)

    def refused(self, call, *words):
        with self.assertRaises(ValueError) as caught, self.writer() as log:
            call(log)
        for word in words:
            self.assertIn(word, str(caught.exception))
        self.assertEqual(os.listdir(self.folder.name), [], "nothing is left")

    def clouds(self, *sweeps):
        """The points of sweeps as they stand in the file."""
        with self.writer() as log:
            for k, (points, columns) in enumerate(sweeps):
                log.sweep("car", S + k * 100_000_000, points, **columns)
        data = Path(self.path).read_bytes()
        # The bytes of a cloud stand behind their number and before `is_dense`.
        found, at = [], 0
        for points, _ in sweeps:
            size = len(np.reshape(points, (-1, 3))) * POINT.itemsize
            at = data.index(struct.pack("<BII", 0, POINT.itemsize, size), at)
            start = data.index(struct.pack("<I", size), at + 8) + 4
            found.append(np.frombuffer(data[start:start + size], POINT))
            at = start + size
        return found

    def cloud(self, points=XYZ, **columns):
        return self.clouds((points, columns))[0]


class TestIntensity(Case):
    def test_each_kind_is_scaled_by_the_stated_rule(self):
        cases = {
            "bytes": ((SHARE * 255).astype(np.uint8), np.floor(SHARE * 255)),
            "0 to 1": (SHARE, SHARE * 255),
            "0 to 1 in single precision": (SHARE.astype(np.float32), SHARE * 255),
            "0 to 100": (SHARE * 100, SHARE * 100),
            "0 to 255": (SHARE * 255, SHARE * 255),
            "uint16 to 4000": ((SHARE * 4000).astype(np.uint16), SHARE * 4000 * 255 / 4095),
            "floats to 4000": (SHARE * 4000, SHARE * 4000 * 255 / 4095),
            "uint16 to its end": ((SHARE * 65535).astype(np.uint16), SHARE * 255),
            "beyond": (SHARE * 1e6, SHARE * 255),
            "one for all": (60, np.full(N, 60)),
        }
        for name, (given, expected) in cases.items():
            with self.subTest(name):
                found = self.cloud(intensity=given)["intensity"].astype(float)
                self.assertLessEqual(np.abs(found - expected).max(), 1)

    def test_a_range_that_is_given_counts_for_every_sweep(self):
        dark, bright = {"intensity": SHARE * 0.5, "intensity_max": 255}, {"intensity": SHARE * 200, "intensity_max": 255}
        found = self.clouds((XYZ, dark), (XYZ, bright))
        self.assertEqual([cloud["intensity"].max() for cloud in found], [0, 200])

    def test_a_brighter_sweep_than_the_first_is_refused(self):
        def call(log):
            log.sweep("car", S, XYZ, SHARE)
            log.sweep("car", S + 100_000_000, XYZ, SHARE * 200)
        self.refused(call, "`intensity`", "at most 1", "200", "intensity_max=")

    def test_what_has_no_rule_is_refused(self):
        for given, words in (
            (np.where(SHARE < 0.1, np.nan, SHARE), ("20 of 200",)),
            (SHARE * 255 - 94, ("0 to inf", "-94")),
            (np.full(N, np.inf), ("finite",)),
            (["a"] * N, ("numbers", "<U1")),
            (SHARE[:7], ("200 numbers", "(7,)")),
            (np.ma.masked_less(SHARE, 0.5), ("masked",)),
        ):
            self.refused(lambda log: log.sweep("car", S, XYZ, given), "sweep of `car`", "`intensity`", *words)


class TestPoints(Case):
    def test_times_are_ns_whatever_they_count_from(self):
        span = SHARE * 0.1
        cases = {
            "ns": np.round(span * 1e9).astype(np.int64),
            "ns as floats": span * 1e9,
            "s": span,
            "s in single precision": span.astype(np.float32),
            "ns since 1970": S + np.round(span * 1e9).astype(np.int64),
            "ns since 1970, unsigned": (S + np.round(span * 1e9).astype(np.int64)).astype(np.uint64),
            "s since 1970": S / 1e9 + span,
            "ns since 1970 as floats": S + span * 1e9,
        }
        for name, given in cases.items():
            with self.subTest(name):
                found = self.cloud(time=given)["time"]
                self.assertLessEqual(np.abs(found - span * 1e9).max(), 300)
        before = S - np.arange(N).astype(np.uint64)
        np.testing.assert_array_equal(self.cloud(time=before)["time"], -np.arange(N))

    def test_times_without_a_rule_are_refused(self):
        for given in (SHARE * 1e5, np.full(N, 2_900_000_000), np.full(N, S / 1e9, np.float32), np.full(N, 1.5), np.full(N, np.nan)):
            self.refused(lambda log: log.sweep("car", S, XYZ, time=given), "`time`")

    def test_rings_and_places_are_refused_where_they_do_not_fit(self):
        sweep = lambda points=XYZ, **columns: lambda log: log.sweep("car", S, points, **columns)  # noqa: E731
        self.refused(sweep(ring=np.full(N, 70_000)), "`ring`", "0 to 65535", "70000")
        self.refused(sweep(ring=-1), "`ring`", "-1")
        self.refused(sweep(ring=np.full(N, 0.5)), "`ring`", "whole")
        self.refused(sweep(np.column_stack([XYZ, SHARE])), "`points`", "(200, 4)", "points[:, :3]")
        self.refused(sweep(np.column_stack([XYZ, SHARE])[:198]), "`points`", "(198, 4)")
        self.refused(sweep(XYZ.T), "`points`", "points.T")
        self.refused(sweep(XYZ + [691_234, 5_334_567, 0]), "`points`", "body frame")
        self.refused(sweep(np.full((N, 3), np.inf)), "`points`", "infinity")
        self.refused(sweep(np.zeros(N, POINT)), "`points`", "fields x, y, z")

    def test_a_row_of_nan_is_a_direction_without_a_return(self):
        points = XYZ.reshape(10, 20, 3).copy()
        points[0, :5] = np.nan
        intensity, time = SHARE.copy(), SHARE * 0.1
        intensity[:5], time[:5] = np.nan, np.nan
        found = self.cloud(points, intensity=intensity.reshape(10, 20), time=time)
        self.assertEqual(np.isnan(found["x"]).sum(), 5)
        self.assertEqual((found["intensity"][-1], found["time"][-1]), (255, 100_000_000))
        self.assertEqual(len(self.cloud(np.zeros((0, 3)))), 0)


class TestStamps(Case):
    def test_integers_of_any_kind_are_stamps(self):
        with self.writer() as log:
            for stamp in (S, np.uint64(S + 1), np.array(S + 2), np.datetime64(S + 3, "ns")):
                log.pose("car", stamp, [0, 0, 0], UNIT, ready=stamp)
        self.assertIn(struct.pack("<QQ", S + 3, S + 3), Path(self.path).read_bytes())

    def test_other_stamps_are_refused(self):
        for stamp, words in (
            (float(S), ("whole nanoseconds", "256 ns")), (1_700_000_000, ("2023-11-14", "multiply by 1000000000")),
            (1_700_000_000_000, ("in ms", "multiply by 1000000")), (1_700_000_000_000_000, ("in us",)), (-1, ("1970",)),
            (2**63, ("2038",)), (True, ("whole",)), ("2023", ("whole",)), (np.datetime64("NaT"), ("1970",)),
        ):
            self.refused(lambda log: log.pose("car", stamp, [0, 0, 0], UNIT), "`stamp`", *words)
            self.refused(lambda log: log.truth("car", stamp, boxes([], [], [], [])), "`stamp`", *words)
        self.refused(lambda log: log.pose("car", S, [0, 0, 0], UNIT, ready=S / 1e9), "`ready`")

    def test_a_clock_of_another_kind_is_taken_by_name(self):
        with self.writer(clock="other") as log:
            log.pose("car", 1_700_000_000, [0, 0, 0], UNIT)
        with self.writer() as log:
            for stamp in range(0, 2 * 10**9, 10**8):
                log.pose("car", stamp, [0, 0, 0], UNIT)


class TestPoses(Case):
    def test_poses_are_refused_where_they_do_not_fit(self):
        pose = lambda position, quaternion=UNIT, **more: lambda log: log.pose("car", S, position, quaternion, **more)  # noqa: E731
        far = [691_234.25, 5_334_567.5, 512.0]
        self.refused(pose(np.array(far, np.float32)), "`position`", "float64", "0.5 m")
        self.refused(pose([np.float32(v) for v in far]), "`position`", "float64")
        self.refused(pose([0, np.nan, 0]), "`position`", "finite")
        self.refused(pose([0, 0]), "`position`", "3 numbers")
        self.refused(pose([0, 0, 0], [0, 0, 2, 2]), "`quaternion`", "length 2.828")
        self.refused(pose([0, 0, 0], [0, 0, 0, 0]), "`quaternion`")
        self.refused(pose([0, 0, 0], [0, 0, 1]), "`quaternion`", "4 numbers")
        self.refused(pose([0, 0, 0], covariance=np.eye(3)), "`covariance`", "36 numbers")
        self.refused(pose([0, 0, 0], covariance=-np.eye(6)), "`covariance`")
        self.refused(lambda log: log.pose("bus", S, far, UNIT), "`bus`")
        with self.writer() as log:
            log.pose("car", S, far, np.array([0, 0, 0.6, 0.8], np.float32))
        data = Path(self.path).read_bytes()
        at = data.index(struct.pack("<3d", *far)) + 24
        self.assertAlmostEqual(np.linalg.norm(np.frombuffer(data[at:at + 32], "<f8")), 1, 12)


class TestBoxes(Case):
    given = {"center": [[1, 2, 3]] * 2, "size": [[4, 2, 1.5]] * 2, "yaw": [0, 0.5], "classes": ["car", "bus"]}

    def test_tracks_are_text(self):
        for given, expected in (
            (["obj00a7f3c9", "0000-123"], ["obj00a7f3c9", "0000-123"]), ([1.0, np.float32(2)], ["1", "2"]), ([-1, 2**70], ["-1", str(2**70)]),
            ([None, float("nan")], ["", ""]), ([b"abc", np.str_("d")], ["abc", "d"]), (np.array([7, 8], np.uint64), ["7", "8"]),
        ):
            self.assertEqual(boxes(**self.given, track=given)["track"], expected)

    def test_columns_are_refused_by_name(self):
        for name, value, word in (
            ("center", [[1, 2]] * 2, "(2, 2)"), ("center", [[1, 2, 3]], "2 rows"), ("center", [[np.nan] * 3] * 2, "finite"),
            ("center", [[691_234, 0, 0]] * 2, "body frame"), ("size", [[4, 0, 1]] * 2, "extent"), ("yaw", [0, 90], "radians"),
            ("yaw", [0], "2 numbers"), ("classes", "car", "['car']"), ("classes", [1, 2], "text"), ("score", [0.5, 95], "100"),
            ("score", [0.5, np.nan], "0 to 1"), ("velocity", [[np.inf] * 3] * 2, "NaN"), ("track", ["a"], "2 tracks"), ("track", 7, "list"),
        ):
            with self.subTest(name), self.assertRaises(ValueError) as caught:
                boxes(**{**self.given, name: value})
            self.assertIn(f"`{name}`", str(caught.exception))
            self.assertIn(word, str(caught.exception))
        for points, word in ([-1, 3], "-1"), ([np.nan, 3], "nan"), ([1], "2 numbers"), ([2**32, 1], "4294967296"):
            self.refused(lambda log: log.truth("car", S, boxes(**self.given), points=points), "ground_truth of `car`", "`points`", word)


class TestArguments(Case):
    """Values that Python or numpy would take for others."""

    sweep = staticmethod(lambda points=XYZ, **columns: lambda log: log.sweep("car", S, points, **columns))

    def test_truth_values_and_texts_are_no_numbers(self):
        yes = [True] + [1.0] * (N - 1)
        for name in "intensity", "time", "ring":
            for given in yes, SHARE > 0.5, True, "7", np.array("7"), SHARE.astype(str), SHARE * 1j, None, [None] * N:
                self.refused(self.sweep(**{name: given}), "sweep of `car`", f"`{name}`", "numbers")
        self.refused(self.sweep(intensity=SHARE, intensity_max=True), "`intensity_max`", "truth values")
        self.refused(self.sweep(intensity=SHARE, intensity_max=np.nan), "`intensity_max`", "finite")
        self.refused(self.sweep(intensity=SHARE, intensity_max=-1), "`intensity_max`", "-1")
        self.refused(lambda log: log.pose("car", S, [0, True, 0], UNIT), "`position`", "truth values")
        self.refused(lambda log: log.pose("car", S, "000", UNIT), "`position`", "numbers")
        self.refused(lambda log: log.pose("car", S, [0, 0, 0], [0, 0, 0, True]), "`quaternion`", "truth values")
        for name in "center", "size", "yaw", "score", "velocity":
            given = {**TestBoxes.given, name: [[True, 1, 1]] * 2 if name in ("center", "size", "velocity") else [True, 0]}
            with self.subTest(name), self.assertRaisesRegex(ValueError, f"`{name}`: expected numbers, found truth values"):
                boxes(**given)

    def test_texts_are_no_truth_values(self):
        self.refused(lambda log: log.truth("car", S, boxes([], [], [], []), key="False"), "`key`", "True or False")
        self.refused(lambda log: log.pose("car", S, [0, 0, 0], UNIT, truth="no"), "`truth`", "True or False")
        with self.assertRaisesRegex(ValueError, "`force`: expected True or False"):
            self.writer(force="no")

    def test_numbers_without_dimension_are_one_for_all(self):
        found = self.cloud(intensity=np.array(60), ring=np.uint8(3), time=np.float32(0.0625))
        self.assertEqual([set(found[name]) for name in ("intensity", "ring", "time")], [{60}, {3}, {62_500_000}])
        with self.writer() as log:
            log.pose("car", S, [np.array(1.0), np.float64(2), 3], UNIT)
        self.assertIn(struct.pack("<3d", 1, 2, 3), Path(self.path).read_bytes())
        os.remove(self.path)
        given = [np.array(691_234.25, np.float32), np.array(5_334_567.5, np.float32), 1.0]
        self.refused(lambda log: log.pose("car", S, given, UNIT), "`position`", "float64")

    def test_columns_of_another_order_are_refused(self):
        grid, of_grid = XYZ.reshape(10, 20, 3), SHARE.reshape(10, 20)
        expected = self.cloud(intensity=SHARE)["intensity"]
        for given in of_grid, np.asfortranarray(of_grid), SHARE[:, None], SHARE[None], SHARE[::-1][::-1], SHARE.astype(">f8"):
            np.testing.assert_array_equal(self.cloud(grid, intensity=given)["intensity"], expected)
        os.remove(self.path)
        self.refused(self.sweep(grid, intensity=of_grid.T), "`intensity`", "(20, 10)", "shape (10, 20)")
        self.refused(self.sweep(intensity=of_grid), "`intensity`", "(10, 20)")
        self.refused(self.sweep(intensity=[]), "`intensity`", "(0,)")
        self.refused(self.sweep([[1, 2, 3], [4, 5]]), "`points`", "rows of one length")
        self.refused(lambda log: log.truth("car", S, boxes(**TestBoxes.given), points=[[1], [2], [3]]), "`points`", "2 numbers")

    def test_offsets_of_small_unsigned_stamps_do_not_wrap(self):
        with self.writer(clock="other") as log:
            log.sweep("car", 2_000_000_000, XYZ, time=(2_000_000_000 - np.arange(N)).astype(np.uint32))
        cloud = np.zeros(N, POINT)
        cloud["x"], cloud["y"], cloud["z"] = XYZ.T
        cloud["time"] = -np.arange(N)
        self.assertIn(cloud.tobytes(), Path(self.path).read_bytes())

    def test_times_that_no_stamp_holds_are_refused(self):
        for stamp in np.datetime64("2500-01-01"), np.datetime64("1969-12-31T23", "h"), np.datetime64(10**12, "Y"), 2**70, np.timedelta64(S, "ns"):
            self.refused(lambda log: log.pose("car", stamp, [0, 0, 0], UNIT), "`stamp`")
        for ready in S // 10**9, S - 2 * 10**9, True, float(S), "now", [S]:
            self.refused(lambda log: log.pose("car", S, [0, 0, 0], UNIT, ready=ready), "`ready`")
            self.refused(lambda log: log.sweep("car", S, XYZ, ready=ready), "`ready`")
            self.refused(lambda log: log.truth("car", S, boxes([], [], [], []), ready=ready), "`ready`")

    def test_ready_may_be_a_second_before_the_stamp(self):
        with self.writer() as log:
            log.pose("car", S, [0, 0, 0], UNIT, ready=S - 10**9)
        self.assertIn(struct.pack("<QQ", S - 10**9, S), Path(self.path).read_bytes())
        os.remove(self.path)
        words = f"nanoseconds from {S - 10**9} on, at most 1 s before the stamp"
        self.refused(lambda log: log.pose("car", S, [0, 0, 0], UNIT, ready=S - 10**9 - 1), "`ready`", words)

    def test_a_second_message_of_a_sweep_is_refused(self):
        def twice(log, call):
            call()
            call()
        nothing = boxes([], [], [], [])
        self.refused(lambda log: twice(log, lambda: log.sweep("car", S, XYZ)), "`stamp`", "a second one")
        for stream in "truth", "detections", "own_labels":
            self.refused(lambda log: twice(log, lambda: getattr(log, stream)("car", S, nothing)), "`stamp`", "a second one")

    def test_places_and_covariances_are_refused_where_there_can_be_none(self):
        self.refused(lambda log: log.pose("car", S, [1e300, 0, 0], UNIT), "`position`", "1e+300")
        order = np.eye(6)
        order[0, 1] = 0.5
        self.refused(lambda log: log.pose("car", S, [0, 0, 0], UNIT, covariance=order), "`covariance`", "symmetric", "0.5")
        order[1, 0] = 0.5 + 1e-9
        with self.writer() as log:
            log.pose("car", S, [0, 0, 0], UNIT, covariance=order)

    def test_lists_without_an_order_and_tracks_that_are_cut_are_refused(self):
        given = TestBoxes.given
        for name in "classes", "track":
            for value in {"a", "b"}, {"a": 1, "b": 2}, (one for one in "ab"), 7, "ab", b"ab", np.array([["a", "b"]]):
                with self.subTest(name), self.assertRaisesRegex(ValueError, f"boxes: `{name}`"):
                    boxes(**{**given, name: value})
        for track in True, float("inf"), 2.0**53, [1], {"id": 1}, b"\xff", "a\0", "\udc80":
            with self.subTest(track), self.assertRaisesRegex(ValueError, "boxes: `track`"):
                boxes(**given, track=[track, None])
        self.assertEqual(boxes(**given, track=[np.array(1.0), np.ma.masked])["track"], ["1", ""])
        for name in "", " ", b"\xff", None, True:
            with self.assertRaisesRegex(ValueError, "boxes: `classes`"):
                boxes(**{**given, "classes": ["car", name]})

    def test_what_is_made_otherwise_is_refused(self):
        for call, name in (
            (lambda log: log.truth("car", S, []), "boxes"), (lambda log: log.truth("car", S, {"center": []}), "boxes"),
            (lambda log: log.detections("car", S, None), "boxes"),
            (lambda log: log.truth("car", S, boxes([], [], [], []), views=view([0] * 3, UNIT, [1, 1], [1, 1], [2, 2])), "views"),
            (lambda log: log.truth("car", S, boxes([], [], [], []), views=None), "views"),
        ):
            self.refused(call, f"`{name}`")
        for agents in [], ["car"], agent("car", "vehicle"), [{"name": "car"}], [agent("car", "vehicle"), agent("Car", "vehicle")]:
            with self.assertRaisesRegex(ValueError, "`agents`"):
                LogWriter(self.path, agents, source="a test")
        for name in "", "a b", "a/b", ".a", "a.", "tf", "x" * 65, 7:
            with self.assertRaisesRegex(ValueError, "`name`"):
                agent(name, "vehicle")
        good = {"position": [0] * 3, "quaternion": UNIT, "focal": [900, 900], "center": [960, 540], "size": [1920, 1080]}
        self.assertEqual(view(**good)["size"].tolist(), [1920, 1080])
        for name, value in (
            ("position", [np.nan] * 3), ("quaternion", [0] * 4), ("focal", [0, 900]), ("center", [np.inf, 0]), ("size", [0, 1080]),
            ("size", [19.5, 1080]), ("margin", -1), ("margin", np.nan), ("margin", [1, 2]), ("focal", [True, 900]),
        ):
            with self.subTest(name), self.assertRaisesRegex(ValueError, f"view: `{name}`"):
                view(**{**good, name: value})

    def test_motion_sensors_are_refused_by_name(self):
        origin = {"map_origin": [48.1, 11.6, 500]}
        for call, options, words in (
            (lambda log: log.imu("car", S, [0, 0], [0, 0, 9.8]), {}, ["angular_rate", "3 numbers"]),
            (lambda log: log.imu("car", S, [0, 0, 0], [0, 0, np.nan]), {}, ["acceleration", "finite"]),
            (lambda log: log.imu("car", S, [0, 0, 0], [0, 0, 9.8], variances=(1e-6, 0)), {}, ["variances", "above 0"]),
            (lambda log: log.imu("car", S, [0, 0, 0], [0, 0, 9.8], variances=[1e-6]), {}, ["variances", "two numbers"]),
            (lambda log: log.fix("car", S, [48.1, 11.6, 500]), {}, ["map_origin", "none"]),
            (lambda log: log.fix("car", S, 48.1), origin, ["place", "3 numbers"]),
            (lambda log: log.fix("car", S, [98.1, 11.6, 500]), origin, ["latitude", "90"]),
            (lambda log: log.fix("car", S, np.float32([48.1, 11.6, 500])), origin, ["place", "float64"]),
            (lambda log: log.fix("car", S, [48.1, 11.6, 500], quality="rtk"), origin, ["quality", "differential"]),
            (lambda log: log.fix("car", S, [48.1, 11.6, 500], np.zeros((3, 3))), origin, ["covariance", "above 0"]),
            (lambda log: log.wheels("car", S, [1, 2]), {}, ["speed"]),
            (lambda log: log.mount("car", "points", [0, 0, 1]), {}, ["stream", "wheels"]),
            (lambda log: [log.imu("car", S, [0, 0, 0], [0, 0, 9.8]), log.mount("car", "imu", [0, 0, 1])], {}, ["second mount"]),
        ):
            with self.subTest(words), self.assertRaises(ValueError) as caught, self.writer(**options) as log:
                call(log)
            for word in words:
                self.assertIn(word, str(caught.exception))
        with self.assertRaisesRegex(ValueError, "map_origin"):
            self.writer(map_origin=[1, 2])
        with self.writer() as log:
            with self.assertRaisesRegex(ValueError, "angular_rate"):
                log.imu("car", S, [0, 0], [0, 0, 9.8])
            log.mount("car", "imu", [0, 0, 1])  # Nothing of what was refused is in the log.
            log.imu("car", S, [0, 0, 0], [0, 0, 9.8], variances=np.array([1e-6, 1e-4]))

    def test_what_is_written_after_the_end_is_refused(self):
        with self.writer() as log:
            log.pose("car", S, [0, 0, 0], UNIT)
        with self.assertRaisesRegex(ValueError, "open, found one that was closed"):
            log.pose("car", S + 1, [0, 0, 0], UNIT)


class TestFile(Case):
    def test_an_exception_leaves_no_log(self):
        with self.writer() as log:
            log.pose("car", S, [0, 0, 0], UNIT)
        before = Path(self.path).read_bytes()
        with self.assertRaisesRegex(ValueError, "frame 8"), self.writer() as log:
            log.sweep("car", S, XYZ)
            self.assertTrue(any(name.endswith(".partial") for name in os.listdir(self.folder.name)))
            raise ValueError("cannot parse frame 8")
        self.assertEqual(os.listdir(self.folder.name), ["made.mcap"])
        self.assertEqual(Path(self.path).read_bytes(), before, "what was there stays")

    def test_a_log_has_its_name_when_it_is_closed(self):
        log = self.writer()
        log.sweep("car", S, XYZ)
        self.assertFalse(os.path.exists(self.path))
        log.close()
        log.close()
        data = Path(self.path).read_bytes()
        self.assertTrue(data.startswith(MAGIC) and data.endswith(MAGIC) and b"realo_end" in data)

    @unittest.skipUnless(os.path.exists("/dev/full"), "a device that is always full")
    def test_a_full_disk_is_an_error(self):
        with self.assertRaises(OSError), LogWriter("/dev/full", [agent("car", "vehicle")], source="a test") as log:
            log.sweep("car", S, XYZ)

    def test_files_of_others_stay(self):
        with open(self.path, "w") as file:
            file.write("my diary")
        with self.assertRaisesRegex(ValueError, "log of realo"):
            self.writer()
        self.assertEqual(Path(self.path).read_text(), "my diary")
        self.writer(force=True).close()
        self.assertTrue(Path(self.path).read_bytes().startswith(MAGIC))

    def test_agents_are_refused_by_name(self):
        for name, more, word in (
            ("kind", {"kind": "car"}, "vehicle or roadside"), ("footprint", {"footprint": [1, 2]}, "4 numbers"),
            ("footprint", {"footprint": [3, -1, -1, 1]}, "x min"), ("footprint", {"footprint": [-150, 330, -90, 90]}, "in metres"),
            ("sensor_position", {"sensor_position": [1, np.nan, 2]}, "finite"),
        ):
            with self.assertRaises(ValueError) as caught:
                agent(**{"name": "car", "kind": "vehicle", **more})
            self.assertIn(f"`{name}`", str(caught.exception))
            self.assertIn(word, str(caught.exception))
        agent("car", "vehicle", footprint=np.array([-1, 3, -1, 1]))

    def test_a_folder_that_is_not_there_is_refused_by_name(self):
        with tempfile.TemporaryDirectory() as folder, self.assertRaisesRegex(ValueError, "`path`: expected a file in a folder that is there"):
            LogWriter(f"{folder}/none/x.mcap", [agent("car", "vehicle")], source="test")


if __name__ == "__main__":
    unittest.main()

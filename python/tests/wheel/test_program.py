"""Runs of the program `realo` from Python, and that both score alike."""

import json
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import made
import realo
from realo import runner

MISSING = made.needs_program()
CHECKOUT = Path(__file__).parents[3]
SCORES = ["accuracy", "accuracy_seen", "accuracy_processed", "precision_recall_by_range", "recall_by_points", "frames", "tracking",
          "dropped_detections", "dropped_truths", "in_no_view", "protocol"]


@unittest.skipIf(MISSING, f"SKIPPED: {MISSING}")
class TestProgram(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.folder = folder.name
        cls.log = os.path.join(cls.folder, "made.mcap")
        made.write_log(cls.log, sweeps=12)
        cls.out = os.path.join(cls.folder, "out")
        cls.found = realo.run("late_fusion", cls.log, ego="car", recorded_detections=True, out=cls.out)

    def test_a_run_in_virtual_time_gives_its_results_twice(self):
        self.assertEqual((self.found.result["mode"], self.found.result["ego"]), ("virtual", "car"))
        self.assertGreater(self.found.ap()["vehicle"][0.3], 0.3)
        # Without a folder nothing is left, and the result is the same bit by bit.
        again = realo.run("late_fusion", self.log, ego="car", recorded_detections=True)
        self.assertEqual(json.dumps(again.result), json.dumps(self.found.result))
        self.assertEqual(realo.read_run(self.out).result, self.found.result)

    def test_settings_reach_the_graph(self):
        changed = realo.run("late_fusion", self.log, ego="car", recorded_detections=True, set={"fusion.nms.threshold": 0.1},
                            agents=["car", "mast"], link="delay_ms=120", seed=3)
        self.assertIn("fusion.nms.threshold=0.1", changed.result["set"])
        self.assertEqual((changed.result["agents"], changed.result["seed"]), (["car", "mast"], "3"))
        self.assertEqual(realo.run("no_fusion", self.log, ego="mast", recorded_detections=True, coop="i2i", offline=True).result["mode"],
                         "offline")

    def test_arrays_score_as_realo_evaluate_does_to_the_last_digit(self):
        recording = os.path.join(self.out, "made", "car", "recording.mcap")
        program = [runner.program(), "evaluate", self.log, "--detections", recording, "--json"]
        for protocol in ("default", "dair"):
            said = subprocess.run([*program, "--protocol", protocol], capture_output=True, text=True, check=True).stdout
            printed = json.loads(said)
            expected = find(printed, "accuracy")
            boxes = realo.Recording(recording).boxes()
            truth = realo.Log(self.log).truth("car")
            found = realo.evaluate(boxes, truth, protocol, unknown_classes="drop", name="made", ego="car").result
            self.assertGreater(found["accuracy"]["sorted"]["counts"]["vehicle"]["0.3"]["total"], 30)
            for name in SCORES:
                if name in expected or name in found:
                    self.assertEqual(json.dumps(found[name], sort_keys=True), json.dumps(expected[name], sort_keys=True), name)

    def test_what_a_run_recorded_is_read(self):
        recording = realo.Recording(os.path.join(self.out, "made", "car", "recording.mcap"))
        boxes, truth = list(recording.boxes()), list(recording.truth())
        self.assertEqual(([one.seq for one in boxes], len(truth)), (list(range(12)), 12))
        self.assertEqual(truth[4].boxes, list(realo.Log(self.log).truth("car"))[4].boxes)
        frame = realo.Frames(self.log, "car")[4]
        self.assertEqual(frame.stamp, boxes[4].stamp)

    def test_what_fails_says_why(self):
        with self.assertRaisesRegex(realo.RunError, "(?s)ended with 1: .*`bus`") as caught:
            realo.run("late_fusion", self.log, ego="bus")
        self.assertEqual(caught.exception.code, 1)
        with self.assertRaises(realo.RunError):
            realo.run("late_fusion", self.log, no_such_option=1)
        for settings in ({"mode": "realtime"}, {"rate": 2}, {"view": True}):
            with self.assertRaisesRegex(ValueError, f"`{next(iter(settings))}`"):
                realo.run("late_fusion", self.log, **settings)
        with self.assertRaisesRegex(ValueError, "`graph`"):
            realo.run(["a", "b"], self.log)

    def test_a_stage_in_python_runs_in_this_install(self):
        stage = CHECKOUT / "examples/python/fusion_boxes.py"
        with mock.patch.dict(os.environ, {"PATH": os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])}):
            found = realo.run("late_fusion", self.log, ego="car", recorded_detections=True,
                              replace={"fusion.fusion": f"program {stage} min_score=0"})
        self.assertEqual(found.ap(), self.found.ap())


def find(document, key):
    """The object of a document that has a key."""
    if isinstance(document, dict):
        if key in document:
            return document
        parts = document.values()
    else:
        parts = document if isinstance(document, list) else []
    return next((found for part in parts if (found := find(part, key)) is not None), None)


class TestWithoutProgram(unittest.TestCase):
    def test_a_program_that_is_not_there_is_named(self):
        with mock.patch.dict(os.environ, {"REALO_BIN": "/no/such/realo"}), self.assertRaisesRegex(FileNotFoundError, "REALO_BIN"):
            realo.run("late_fusion")
        with mock.patch.dict(os.environ, {"PATH": "/nowhere", "REALO_BIN": ""}), self.assertRaisesRegex(FileNotFoundError, "cargo build"):
            realo.run("late_fusion")

    def test_modules_of_plug_ins_are_in_the_same_install(self):
        import realo_geometry
        import realo_log
        import realo_operator

        package = Path(realo.__file__).parent.parent
        for module in (realo_geometry, realo_log, realo_operator):
            self.assertTrue(Path(module.__file__).is_relative_to(package), module.__file__)
        self.assertTrue((package / "realo_operator/schema.json").is_file())
        self.assertTrue((package / "realo/py.typed").is_file())


if __name__ == "__main__":
    unittest.main()

"""The evaluator, suppression and geometry on arrays; results, read and written."""

import json
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import made
import numpy as np
import realo
import realo_geometry


def frames_of(random, n=20):
    truth = [made.some_boxes(random, 20) for _ in range(n)]
    return [made.seen(random, objects) for objects in truth], truth


class TestEvaluate(unittest.TestCase):
    def setUp(self):
        self.random = np.random.default_rng(3)

    def test_perfect_boxes_score_1_and_none_score_0(self):
        truth = [made.some_boxes(self.random, 20) for _ in range(5)]
        run = realo.evaluate(truth, truth)
        self.assertEqual(run.mean_ap(), {0.3: 1.0, 0.5: 1.0})
        self.assertEqual(run.result["frames"], {"total": 5, "key": 5, "skipped": 0, "key_skipped": 0, "processed": 5})
        run = realo.evaluate([None] * 5, truth)
        self.assertEqual(run.mean_ap(), {0.3: 0.0, 0.5: 0.0})
        self.assertEqual(run.result["frames"]["skipped"], 5)

    def test_a_known_answer_by_hand(self):
        # Two cars; the best box is right, the next is false, the last finds the other: AP = 1 · 0.5 + 2/3 · 0.5.
        truth = realo.Boxes.of([[10, 0, 1, 4, 2, 2, 0], [30, 0, 1, 4, 2, 2, 0]], "Car")
        found = realo.Boxes.of([[10, 0, 1, 4, 2, 2, 0], [50, 0, 1, 4, 2, 2, 0], [30, 0, 1, 4, 2, 2, 0]], "Car", score=[0.9, 0.8, 0.7])
        ap = realo.evaluate([found], [truth], protocol="dair").ap()["vehicle"][0.5]
        self.assertAlmostEqual(ap, 0.5 + 0.5 * 2 / 3, places=12)

    def test_lists_dicts_and_flat_arrays_give_the_same(self):
        predictions, truth = frames_of(self.random)
        listed = realo.evaluate(predictions, truth).result
        by_number = realo.evaluate(dict(enumerate(predictions)), dict(enumerate(truth))).result
        flat = [realo.Boxes.join(parts, range(len(parts))) for parts in (predictions, truth)]
        for order in ("accuracy", "accuracy_processed", "recall_by_points"):
            self.assertEqual(json.dumps(listed[order]), json.dumps(by_number[order]))
            self.assertEqual(json.dumps(listed[order]), json.dumps(realo.evaluate(*flat).result[order]))
        self.assertEqual([len(part) for part in flat[1].by_frame(range(20))], [20] * 20)

    def test_frames_without_boxes_count(self):
        truth = realo.Boxes.of([[10, 0, 1, 4, 2, 2, 0]], "Car", frame=[4])
        found = realo.Boxes.of([[10, 0, 1, 4, 2, 2, 0]], "Car", frame=[7])
        run = realo.evaluate(found, truth, "dair", frames=range(10))
        self.assertEqual(run.result["frames"]["total"], 10)
        self.assertEqual(run.result["accuracy"]["sorted"]["counts"]["vehicle"]["0.5"], {"true": 0, "false": 1, "total": 1})
        with self.assertRaisesRegex(ValueError, "`frames`: expected all frames that have boxes, found boxes of frame 4"):
            realo.evaluate(found, truth, "dair", frames=[7])

    def test_points_and_footprints_count_as_in_a_log(self):
        boxes = realo.Boxes.of([[10, 0, 1, 4, 2, 2, 0], [30, 0, 1, 4, 2, 2, 0], [50, 0, 1, 4, 2, 2, 0]], "Car")
        points = np.array([[50, 0], [2, 4], [1, 1]], np.uint32)
        truth = realo.Truth("car", 0, made.START, made.START, boxes, ["car", "mast"], points)
        own = realo.Boxes.of([[0, 0, 1, 4, 2, 2, 0]], "Car", score=0.5)
        run = realo.evaluate([realo.Boxes.join([boxes, own])], [truth], ego_footprint=[-1, 3.5, -0.9, 0.9])
        self.assertEqual(run.result["dropped_truths"]["few_points"], 1)
        self.assertEqual(run.result["dropped_detections"]["own_body"], 1)
        self.assertEqual(run.result["accuracy"]["sorted"]["counts"]["vehicle"]["0.3"], {"true": 2, "false": 1, "total": 2})
        self.assertEqual(run.result["accuracy_seen"]["sorted"]["counts"]["vehicle"]["0.3"]["total"], 1)

    def test_bad_input_is_refused_by_name(self):
        good = realo.Boxes.of([[10, 0, 1, 4, 2, 2, 0]], "Car")
        of = realo.Boxes.of
        for call, words in (
            (lambda: of([[1, 2, 3, 4, 5, 6]], "Car"), r"`values`: expected shape \(n, 7\), found \(1, 6\)"),
            (lambda: of([["a"] * 7], "Car"), "`values`: expected numbers, found <U1"),
            (lambda: of([[np.nan, 0, 1, 4, 2, 2, 0]], "Car"), "`values`: expected finite numbers, found 1 of 7"),
            (lambda: of([[10, 0, 1, 0, 2, 2, 0]], "Car"), "`size`: expected 1e-06 to inf, found 0"),
            (lambda: of(good.values, "Car", score=40), "`score`: expected 0 to 1, found 40"),
            (lambda: of(good.values, "Car", score=[0.1, 0.2]), "`score`: expected 1 numbers"),
            (lambda: of(good.values, [3]), "`classes`: expected texts, found 3"),
            (lambda: of(good.values, ["Car", "Car"]), "`classes`: expected 1 texts"),
            (lambda: of(good.values, "Car", track=["x1"]), "`track`"),
            (lambda: of(good.values, "Car", frame=[-1]), "`frame`: expected 0 to"),
            (lambda: of(good.values, "Car", velocity=[1, 2]), "`velocity`"),
            (lambda: realo.evaluate([good], [good], protocol="kitti"), "`protocol`: .*`kitti` is neither one of `default`"),
            (lambda: realo.evaluate([of(good.values, "Cat")], [good]), "`predictions`: expected classes of the protocol default .*'Cat'"),
            (lambda: realo.evaluate([good], [of(good.values, "Cat")]), "`truth`: expected classes of the protocol"),
            (lambda: realo.evaluate(good, [good]), "`frame`: expected the number of each box's frame, found none"),
            (lambda: realo.evaluate(good.values, [good]), "`predictions`: expected Boxes, or a list of Boxes"),
            (lambda: realo.evaluate([good.values], [good]), "`predictions`: expected Boxes, found ndarray at frame 0"),
            (lambda: realo.evaluate([good], [good], ego_footprint=[1, 2]), "`ego_footprint`"),
            (lambda: realo.evaluate([good], [good], "dair-vehicle"), "`truth`: .*has no such labels"),
            (lambda: realo.evaluate([good], [good] * 3), "`predictions`: expected 3 frames, as `truth` has, found 1"),
            (lambda: realo.evaluate([good, None], [good]), "`predictions`: expected 1 frames, as `truth` has, found 2"),
            (lambda: realo.evaluate([], []), "`truth`: expected one frame or more, found none"),
            (lambda: realo.compare({}), "`runs`: expected one run or more"),
            (lambda: realo.iou(np.zeros((2, 6)), good), r"`a`: expected shape \(n, 7\): x, y, z, .*found \(2, 6\)"),
        ):
            with self.assertRaisesRegex(ValueError, words):
                call()
        run = realo.evaluate([of(good.values, "Cat")], [good], unknown_classes="drop")
        self.assertEqual(run.result["dropped_detections"]["classes"], {"Cat": 1})

    def test_the_run_as_tables_and_as_a_folder(self):
        predictions, truth = frames_of(self.random)
        run = realo.evaluate(predictions, truth, name="mine")
        self.assertIn("mAP", str(run))
        self.assertIn("| mAP", run.table("md", width=200))
        table = run.to_arrow().to_pylist()
        row = next(row for row in table if (row["against"], row["order"], row["class"], row["iou"]) == ("accuracy", "sorted", "vehicle", 0.5))
        self.assertEqual(row["AP"], run.ap()["vehicle"][0.5])
        by_frame = run.frames().group_by(["class", "iou"]).aggregate([("true", "sum")]).to_pylist()
        total = next(row["true_sum"] for row in by_frame if (row["class"], row["iou"]) == ("vehicle", 0.5))
        self.assertEqual(total, row["true"])
        self.assertEqual(len(run.objects()), sum(len(boxes) for boxes in truth))
        with tempfile.TemporaryDirectory() as folder:
            target = os.path.join(folder, "mine")
            run.write(target)
            again = realo.read_run(target)
            self.assertEqual(json.dumps(again.result), json.dumps(run.result))
            self.assertEqual(json.dumps(again.samples), json.dumps(run.samples))
            self.assertIn("mine", realo.compare({"mine": again, "again": run}))
            with self.assertRaisesRegex(FileNotFoundError, "`folder`"):
                realo.read_run(os.path.join(folder, "nowhere"))
            with open(os.path.join(target, "result.json"), "w") as file:
                file.write("{}")
            with self.assertRaisesRegex(ValueError, "`folder`"):
                realo.read_run(target)

    def test_pooled_runs_are_scored_over_the_frames_of_all(self):
        predictions, truth = frames_of(self.random)
        half = [realo.evaluate(predictions[part], truth[part], name=f"log{n}") for n, part in enumerate((slice(0, 10), slice(10, 20)))]
        pooled, whole = realo.pool(half), realo.evaluate(predictions, truth)
        self.assertEqual(pooled.ap(), whole.ap())
        self.assertIsNotNone(pooled.result["intervals"])


    def test_the_example_prints_the_table(self):
        example = Path(__file__).parents[3] / "examples/python/evaluate_arrays.py"
        done = subprocess.run([sys.executable, str(example)], capture_output=True, text=True, check=False)
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertIn("mAP", done.stdout)


class TestGeometry(unittest.TestCase):
    def setUp(self):
        random = np.random.default_rng(5)
        n = 60
        values = np.column_stack([random.uniform(-6, 6, (n, 3)), random.uniform(0.5, 6, (n, 3)), random.uniform(-4, 4, n)])
        velocity = random.uniform(-3, 3, (n, 3))
        covariance = np.broadcast_to(np.diag([0.1, 0.2, 0.05]), (n, 3, 3))
        scores = random.uniform(0, 1, n).astype(np.float32)
        self.boxes = realo.Boxes.of(values, random.choice(made.CLASSES, n).tolist(), score=scores, velocity=velocity, covariance=covariance)

    def test_iou_is_that_of_numpy(self):
        found = realo.iou(self.boxes, self.boxes[:20])
        self.assertEqual(found.shape, (60, 20))
        np.testing.assert_allclose(found, realo_geometry.iou(self.boxes.columns(), self.boxes[:20].columns()), atol=1e-9)
        np.testing.assert_allclose(np.diag(found), 1)
        np.testing.assert_array_equal(realo.iou(self.boxes.values, self.boxes.values[:20]), found)
        flat = self.boxes.values[:, [0, 1, 3, 4, 6]]
        np.testing.assert_array_equal(realo.iou(flat, flat[:20]), found)
        self.assertEqual(realo.iou(np.zeros((0, 7)), flat).shape, (0, 60))
        for wrong in ([[np.nan] * 7], [[1, 2, 3]], 5):
            with self.assertRaisesRegex(ValueError, "`a`"):
                realo.iou(wrong, flat)

    def test_suppression_is_the_greedy_one(self):
        overlap = realo.iou(self.boxes, self.boxes)
        kept = []
        for one in np.argsort(-self.boxes.score, kind="stable"):
            if all(overlap[other, one] <= 0.2 for other in kept):
                kept.append(int(one))
        found = realo.nms(self.boxes, 0.2)
        self.assertEqual(found.kept.tolist(), kept)
        self.assertEqual(found.boxes, self.boxes[kept])
        per_class = realo.nms(self.boxes, 0.2, per_class=True)
        self.assertGreaterEqual(len(per_class.kept), len(kept))
        self.assertEqual(len(realo.nms(self.boxes, 0.2, min_score=1.0).kept), 0)
        inside = realo.nms(self.boxes, 1.0, region=[-4, 4, -4, 4])
        self.assertTrue((np.abs(realo.corners(inside.boxes)) <= 4).all())
        for options, words in ({"threshold": 2}, "`threshold`"), ({"max_boxes": 0}, "`max_boxes`"), ({"region": [1]}, "`region`"):
            with self.assertRaisesRegex(ValueError, words):
                realo.nms(self.boxes, **options)

    def test_corners_are_half_an_extent_away(self):
        corners = realo.corners(self.boxes)
        np.testing.assert_allclose(corners.mean(axis=1), self.boxes.center[:, :2], atol=1e-12)
        ahead = np.linalg.norm(corners[:, 0] - corners[:, 3], axis=1)
        np.testing.assert_allclose(ahead, self.boxes.size[:, 0])

    def test_boxes_move_between_frames_as_in_numpy(self):
        turn = np.eye(4)
        turn[:2, :2], turn[:3, 3] = [[0, -1], [1, 0]], [3, -2, 0.5]
        moved = realo.transform(turn, self.boxes)
        expected = realo_geometry.transform_boxes(turn, self.boxes.columns())
        for name, values in moved.columns().items():
            if name not in ("class", "track"):
                np.testing.assert_allclose(values, expected[name], atol=1e-9, err_msg=name)
        back = realo.transform(np.linalg.inv(turn), moved)
        np.testing.assert_allclose(back.values[:, :6], self.boxes.values[:, :6], atol=1e-9)
        with self.assertRaisesRegex(ValueError, r"`to_from_from`: expected shape \(4, 4\), found \(3, 3\); put a rotation"):
            realo.transform(np.eye(3), self.boxes)
        for wrong in (np.eye(4) * 2, np.full((4, 4), np.nan)):
            with self.assertRaisesRegex(ValueError, "`to_from_from`"):
                realo.transform(wrong, self.boxes)


if __name__ == "__main__":
    unittest.main()

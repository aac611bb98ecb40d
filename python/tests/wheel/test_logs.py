"""Logs come back exactly as they were written, as arrays, as tables, and through workers."""

import json
import multiprocessing
import os
import pickle
import tempfile
import unittest

import made
import numpy as np
import pyarrow as pa
import realo


class TestLogs(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        cls.path = os.path.join(cls.folder.name, "made.mcap")
        cls.written = made.write_log(cls.path)
        cls.log = realo.Log(cls.path)

    def test_it_says_what_it_is(self):
        self.assertEqual(list(self.log.agents), list(made.AGENTS))
        car = self.log.agents["car"]
        self.assertEqual((car.kind, car.footprint), ("vehicle", [-1, 3.5, -0.9, 0.9]))
        self.assertEqual(self.log.about["streams"]["mast"]["points"], 6)
        self.assertEqual(len(self.log.about["scored"]["car"]), 3)
        self.assertEqual(self.log.span, (made.START, made.START + 5 * made.SWEEP + 64_000_000))

    def test_points_come_back_bit_by_bit(self):
        for name in made.AGENTS:
            found = list(self.log.sweeps(name))
            self.assertEqual(len(found), 6)
            for seq, (sweep, (stamp, cloud)) in enumerate(zip(found, self.written[name]["sweeps"])):
                self.assertEqual((sweep.agent, sweep.seq, sweep.stamp, sweep.ready), (name, seq, stamp, stamp + 50_000_000))
                for column, values in cloud.items():
                    np.testing.assert_array_equal(getattr(sweep, column), values)
                    self.assertEqual(getattr(sweep, column).dtype, values.dtype)

    def test_a_sweep_is_read_by_its_stamp_and_a_part_by_its_time(self):
        times = self.log.sweep_times("other")
        stamp, ready = times["stamp"][3].as_py(), times["ready"][3].as_py()
        sweep = self.log.sweep("other", stamp, ready)
        np.testing.assert_array_equal(sweep.points, self.written["other"]["sweeps"][3][1]["points"])
        part = list(self.log.sweeps("other", start=ready, end=ready + 2 * made.SWEEP))
        self.assertEqual([sweep.seq for sweep in part], [3, 4])
        with self.assertRaisesRegex(KeyError, "other has no sweep with stamp 5 ns"):
            self.log.sweep("other", 5, ready)

    def test_poses_come_back_bit_by_bit(self):
        for truth in (False, True):
            poses = self.log.poses("mast", truth=truth)
            self.assertEqual(len(poses), 6)
            for at, (stamp, position, quaternion, covariance) in enumerate(self.written["mast"]["poses"]):
                self.assertEqual(poses.stamp[at], stamp)
                np.testing.assert_array_equal(poses.position[at], position)
                np.testing.assert_array_equal(poses.quaternion[at], quaternion)
                np.testing.assert_array_equal(poses.covariance[at], np.full((6, 6), np.nan) if truth else covariance)
        matrix = poses.matrices()[2]
        stamp, position, quaternion, _ = self.written["mast"]["poses"][2]
        np.testing.assert_allclose(matrix[:3, 3], position)
        yaw = 2 * np.arctan2(quaternion[2], quaternion[3])
        np.testing.assert_allclose(matrix[:2, 0], [np.cos(yaw), np.sin(yaw)])
        between = self.log.poses_at("car", [self.written["car"]["poses"][0][0] + made.SWEEP // 2, 5])
        self.assertAlmostEqual(between[0, 0, 3], 691_000.3, places=6)
        self.assertTrue(np.isnan(between[1]).any())

    def test_boxes_come_back_bit_by_bit(self):
        for name in made.AGENTS:
            for label, (stamp, objects, counts) in zip(self.log.labels(name), self.written[name]["truth"], strict=True):
                self.assertEqual((label.stamp, label.agents), (stamp, [name]))
                self.assertEqual(label.boxes, objects)
                np.testing.assert_array_equal(label.points[:, 0], counts)
            self.assertEqual([label.key for label in self.log.labels(name)], [True, False] * 3)
            for label, (stamp, found) in zip(self.log.detections(name), self.written[name]["detections"], strict=True):
                self.assertEqual((label.stamp, label.boxes), (stamp, found))

    def test_truth_of_an_ego_has_the_points_of_all(self):
        found = list(self.log.truth("car", ["car", "mast"]))
        self.assertEqual(len(found), 6)
        for at, one in enumerate(found):
            stamp, objects, counts = self.written["car"]["truth"][at]
            self.assertEqual((one.stamp, one.agents, one.ego_footprint), (stamp, ["car", "mast"], [-1, 3.5, -0.9, 0.9]))
            self.assertEqual(one.boxes, objects)
            np.testing.assert_array_equal(one.points, np.column_stack([counts, self.written["mast"]["truth"][at][2]]))

    def test_tables_keep_every_bit(self):
        boxes = self.written["car"]["truth"][0][1]
        boxes = realo.Boxes(
            boxes.center, boxes.size, boxes.yaw, list(boxes.classes), score=0.5, velocity=boxes.velocity, track=list(boxes.track),
            covariance=np.broadcast_to(np.eye(3) * 0.1, (len(boxes), 3, 3)), frame=np.arange(len(boxes)) % 3)
        table = boxes.to_arrow()
        self.assertIsInstance(table, pa.Table)
        self.assertEqual(realo.Boxes.from_table(table), boxes)
        try:
            import pandas  # noqa: F401
        except ImportError:
            with self.assertRaisesRegex(ImportError, "pip install pandas"):
                boxes.to_dataframe()
        else:
            frame = boxes.to_dataframe()
            self.assertEqual(frame["class"].value_counts().sum(), len(boxes))
            again = realo.Boxes.from_table(frame)
            np.testing.assert_array_equal(again.values, boxes.values)
            self.assertEqual(list(again.track), list(boxes.track))
        sweep = next(self.log.sweeps("car"))
        self.assertEqual(sweep.to_arrow().column_names, ["x", "y", "z", "intensity", "time", "ring"])
        self.assertEqual(len(self.log.poses("car").to_arrow()), 6)

    def test_what_is_no_log_is_refused(self):
        other = os.path.join(self.folder.name, "text.mcap")
        with open(other, "w") as file:
            file.write("no log\n" * 20)
        with self.assertRaisesRegex(ValueError, "`path`: .*text.mcap. is not an MCAP file"):
            realo.Log(other)
        with self.assertRaisesRegex(FileNotFoundError, "nowhere.mcap"):
            realo.Log(os.path.join(self.folder.name, "nowhere.mcap"))
        with self.assertRaisesRegex(ValueError, "`recording`.*is not a recording of a run"):
            realo.Recording(self.path)
        with self.assertRaisesRegex(ValueError, "`agent`: expected one of car, other, mast, found `bus`"):
            list(self.log.sweeps("bus"))

    def test_a_damaged_log_says_where(self):
        with open(self.path, "rb") as file:
            data = bytearray(file.read())
        place = len(data) // 2
        data[place:place + 64] = bytes(64)
        damaged = os.path.join(self.folder.name, "damaged.mcap")
        with open(damaged, "wb") as file:
            file.write(data)
        with self.assertRaisesRegex(ValueError, "damaged.mcap"):
            log = realo.Log(damaged)
            for name in log.agents:
                list(log.sweeps(name))
                list(log.labels(name))

    def test_a_log_goes_to_another_process_by_its_path(self):
        again = pickle.loads(pickle.dumps(self.log))
        self.assertEqual(again.agents, self.log.agents)


def digest(frames, numbers, queue):
    """What a worker finds in frames."""
    found = {}
    for number in numbers:
        frame = frames[number]
        found[number] = [float(sweep.points.astype(np.float64).sum()) for sweep in frame.sweeps.values()]
    queue.put(found)


class TestFrames(unittest.TestCase):
    setUpClass = TestLogs.__dict__["setUpClass"]

    def test_a_frame_has_all_agents_nearest_in_time(self):
        frames = realo.Frames(self.path, "car")
        self.assertEqual(len(frames), 6)
        frame = frames[2]
        self.assertEqual(list(frame.sweeps), ["car", "other", "mast"])
        self.assertEqual([sweep.seq for sweep in frame.sweeps.values()], [2, 2, 2])
        for name in made.AGENTS:
            np.testing.assert_array_equal(frame.sweeps[name].points, self.written[name]["sweeps"][2][1]["points"])
        self.assertEqual(frame.boxes, self.written["car"]["truth"][2][1])
        _, ego, _, _ = self.written["car"]["poses"][2]
        _, other, _, _ = self.written["other"]["poses"][2]
        np.testing.assert_allclose(frame.ego_from("other")[:3, 3], other - ego, atol=1e-9)
        np.testing.assert_array_equal(frame.ego_from("car"), np.eye(4))
        self.assertEqual([frame.seq for frame in frames[1:3]], [1, 2])
        self.assertEqual(frames[-1].seq, 5)
        with self.assertRaises(IndexError):
            frames[6]
        self.assertEqual([frame.seq for frame in realo.Frames(self.path, "car", scored=True)], [0, 2, 4])
        alone = realo.Frames(self.path, "mast", agents=[], truth=False, exact=True)
        self.assertEqual((list(alone[0].sweeps), alone[0].truth, len(alone[0].boxes)), (["mast"], None, 0))

    def test_agents_out_of_reach_are_missing(self):
        path = os.path.join(self.folder.name, "late.mcap")
        with realo.LogWriter(path, [realo.agent("car", "vehicle"), realo.agent("late", "vehicle")], source="a test") as log:
            for name, late in ("car", 0), ("late", 50_000_001):
                for k in range(3):
                    stamp = made.START + k * 200_000_000 + late
                    log.pose(name, stamp, [k, 0, 0], made.UNIT)
                    log.sweep(name, stamp, np.zeros((4, 3)), ready=stamp)
        self.assertEqual([list(frame.sweeps) for frame in realo.Frames(path, "car", truth=False)], [["car"]] * 3)

    def test_workers_forked_and_spawned_read_the_same(self):
        frames = realo.Frames(self.path, "car")
        frames[0]
        here = {n: [float(s.points.astype(np.float64).sum()) for s in frames[n].sweeps.values()] for n in range(len(frames))}
        for method in ("fork", "spawn"):
            with self.subTest(method):
                context = multiprocessing.get_context(method)
                queue = context.Queue()
                parts = [[0, 2, 4], [5, 3, 1]]
                workers = [context.Process(target=digest, args=(frames, part, queue)) for part in parts]
                for worker in workers:
                    worker.start()
                found = {}
                for _ in workers:
                    found |= queue.get(timeout=300)
                for worker in workers:
                    worker.join()
                self.assertEqual([worker.exitcode for worker in workers], [0, 0])
                self.assertEqual(json.dumps(found, sort_keys=True), json.dumps(here, sort_keys=True))

    def test_wrong_arguments_are_named(self):
        for arguments, words in (
            ({"ego": "bus"}, "`ego`: expected one of car, other, mast, found 'bus'"),
            ({"ego": "car", "agents": ["bus"]}, "`agents`: expected one of"),
            ({"ego": "car", "agents": "mast"}, "`agents`: expected a list of names"),
            ({"ego": "car", "scored": True, "truth": False}, "`scored`: expected truth=True"),
        ):
            with self.assertRaisesRegex(ValueError, words):
                realo.Frames(self.path, **arguments)

    def test_a_dataset_of_torch_feeds_workers(self):
        try:
            import torch
            from torch.utils.data import DataLoader
        except ImportError:
            self.skipTest("SKIPPED: PyTorch is not installed, so realo.torch was not tested")
        from realo.torch import Dataset, collate

        dataset = Dataset(self.path, "car")
        self.assertEqual(dataset.class_names, sorted(made.CLASSES))
        for workers in (0, 2):
            batches = list(DataLoader(dataset, batch_size=4, num_workers=workers, collate_fn=collate))
            self.assertEqual([len(batch) for batch in batches], [4, 2])
            for sample in (sample for batch in batches for sample in batch):
                objects = self.written["car"]["truth"][sample["seq"]][1]
                self.assertTrue(torch.equal(sample["boxes"], torch.from_numpy(objects.values.astype(np.float32))))
                self.assertEqual([dataset.class_names[n] for n in sample["classes"]], list(objects.classes))
                cloud = self.written["mast"]["sweeps"][sample["seq"]][1]
                np.testing.assert_array_equal(sample["points"]["mast"][:, :3].numpy(), cloud["points"])
                np.testing.assert_array_equal(sample["points"]["mast"][:, 3].numpy(), cloud["intensity"].astype(np.float32) / 255)
                self.assertEqual(sample["ego_from"]["other"].dtype, torch.float64)
        only = Dataset(self.path, "car", class_names=["Truck"], transform=None)[0]
        self.assertTrue((only["classes"] == 0).all())


if __name__ == "__main__":
    unittest.main()

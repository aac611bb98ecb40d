"""realo-ros2 beside a real ROS 2 (rclpy) and a second DDS (Cyclone), on this machine alone.

Needs `realo`, `realo-ros2` and dora built or installed; see run.sh beside it.
"""

import json
import os
import pathlib
import signal
import struct
import subprocess
import sys
import tempfile
import time
import unittest

ROOT = pathlib.Path(__file__).resolve().parents[3]
NODES = pathlib.Path(__file__).with_name("nodes.py")
GRAPHS = ROOT / "examples/ros2"
REALO = pathlib.Path(os.environ.get("REALO_BIN", ROOT / "target/release/realo"))
ROS2 = pathlib.Path(os.environ.get("REALO_ROS2_BIN", ROOT / "target/release/realo-ros2"))
DORA = os.environ.get("REALO_DORA", str(pathlib.Path(sys.executable).with_name("dora")))
DOMAIN = 77
ENV = os.environ | {
    "ROS_DOMAIN_ID": str(DOMAIN),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "CYCLONEDDS_URI": "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces><AllowMulticast>false</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>",
}


def node(*args):
    return subprocess.Popen([sys.executable, str(NODES), *map(str, args)], env=ENV, stdout=subprocess.PIPE, text=True)


def said(process, seconds=180):
    out, _ = process.communicate(timeout=seconds)
    assert process.returncode == 0, f"{process.args} ended with {process.returncode}"
    return json.loads(out)


class Graph:
    """A graph on dora, in a folder of its own with links beside it as the examples have them."""

    def __init__(self, folder, text, map_file):
        # Models are beside the folder of a graph.
        self.folder = pathlib.Path(folder) / "graph"
        self.folder.mkdir()
        (self.folder.parent / "models").symlink_to(ROOT / "models")
        for name in ("modules", "types"):
            (self.folder / name).symlink_to(ROOT / "dataflows" / name)
        (self.folder / "bin").mkdir()
        (self.folder / "bin/realo").symlink_to(REALO)
        (self.folder / "bin/realo-ros2").symlink_to(ROS2)
        (self.folder / "ros2.yml").write_text(map_file)
        self.file = self.folder / "graph.yml"
        self.file.write_text(text.replace("../../target/release/realo-ros2", "bin/realo-ros2").replace("../../target/realo/", "out/results/"))

    def start(self):
        subprocess.run([DORA, "validate", "--strict-types", str(self.file)], check=True, stdout=subprocess.DEVNULL)
        subprocess.run([REALO, "validate", str(self.file)], check=True, stdout=subprocess.DEVNULL)
        self.log = open(self.folder / "dora.log", "w+")
        self.process = subprocess.Popen([DORA, "run", str(self.file)], env=ENV, stdout=self.log, stderr=self.log, start_new_session=True)

    def end(self, seconds=240):
        try:
            code = self.process.wait(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            code = "a timeout"
        self.log.close()
        text = (self.folder / "dora.log").read_text()
        assert code == 0, f"dora ended with {code}:\n{text[-6000:]}"
        results = list((self.folder / "out/results").rglob("result.json"))
        return json.loads(results[0].read_text()), text


SENSORS = """
strict_types: true
nodes:
  - id: sensors
    path: bin/realo
    args: program bin/realo-ros2 sensors map=ros2.yml localhost=true seconds=SECONDS
    outputs: [ego_clouds, ego_poses]
    output_types: { ego_clouds: realo/v1/PointCloud, ego_poses: realo/v1/AgentState }
  - id: recorder
    path: bin/realo
    args: node recorder path=out/results/recording.mcap
    inputs: { ego_clouds: sensors/ego_clouds }
  - id: results
    path: bin/realo
    args: node results out=out/results/x
    inputs: { ego_state: sensors/ego_poses }
"""

STANDS = "agents:\n  mast: { kind: roadside, clouds: /many, frame: base_link, height: 5, pose: [1, 2, 5, 0.3] }\n"
SECONDS = float(os.environ.get("REALO_ROS2_SECONDS", "20"))


class Live(unittest.TestCase):
    def setUp(self):
        self.folder = tempfile.TemporaryDirectory()
        self.addCleanup(self.folder.cleanup)

    def test_ten_clouds_of_100_000_points_a_second_arrive_and_none_is_lost(self):
        graph = Graph(self.folder.name, SENSORS.replace("SECONDS", str(SECONDS + 40)), STANDS)
        graph.start()
        listener = node("echo", SECONDS + 30, "/many")
        publisher = node("points", 100_000, 10, SECONDS, "/many")
        published = said(publisher)["published"]
        theirs = said(listener)
        result, log = graph.end()
        sensors = result["nodes"]["sensors"]
        print(f"\npublished {published}; rclpy: {theirs}")
        print([line[line.index("ros2-sensors: ") :] for line in log.splitlines() if "ros2-sensors: /many" in line])
        self.assertEqual(sensors["counters"]["clouds"], published, sensors)
        self.assertEqual(sensors["sent"]["ego_clouds"], published)
        self.assertNotIn("lost", sensors.get("losses", {}))
        self.assertNotIn("overrun", sensors.get("losses", {}))
        self.assertNotIn("without_times", sensors["counters"])

    def test_boxes_come_back_with_the_stamps_of_their_clouds(self):
        text = (GRAPHS / "no_fusion.ros2.yml").read_text().replace("sensors map=ros2.yml", "sensors map=ros2.yml localhost=true seconds=50")
        text = text.replace("realo-ros2 boxes", "realo-ros2 boxes localhost=true")
        graph = Graph(self.folder.name, text, (GRAPHS / "ros2.yml").read_text())
        graph.start()
        markers = node("markers", 50, "/realo/markers")
        cyclone = subprocess.Popen([sys.executable, str(NODES.with_name("cyclone.py")), "boxes", "50"], env=ENV, stdout=subprocess.PIPE, text=True)
        stamps = said(node("replay", ROOT / "target/realo/demo.mcap", "cav1", 20))["stamps"]
        arrays, others = said(markers)["arrays"], said(cyclone)
        result, _ = graph.end()
        self.assertGreater(len(arrays), 0, result["nodes"])
        self.assertLessEqual({stamp for stamp, _, _ in arrays}, set(stamps))
        self.assertEqual({frame for _, frame, _ in arrays}, {"map"})
        self.assertGreater(sum(boxes for _, _, boxes in arrays), 0)
        by_stamp = {stamp: boxes for stamp, _, boxes in arrays}
        for form in ("detections", "objects"):
            found = others[form]
            self.assertGreater(len(found), 0, form)
            for stamp, frame, boxes in found:
                self.assertIn(stamp, stamps)
                self.assertEqual(frame, "map")
                if stamp in by_stamp:
                    self.assertEqual(len(boxes), by_stamp[stamp])
            for class_or_label, score, size in (box for _, _, boxes in found for box in boxes):
                self.assertIn(class_or_label, ("vehicle", "truck", "pedestrian", 1, 2, 7))
                self.assertTrue(0 < score <= 1 and all(0 < side < 30 for side in size), (score, size))
        self.assertEqual(result["frames"]["processed"], result["nodes"]["ego.nms"]["sent"]["boxes"])
        print(f"\n{len(stamps)} clouds, {len(arrays)} arrays of markers, {len(others['detections'])} of detections")

    def test_nodes_and_topics_are_those_of_ros(self):
        publisher = node("points", 10, 10, 1, "/few")
        try:
            deadline, found = time.time() + 60, ""
            while "/few" not in found and time.time() < deadline:
                done = subprocess.run([ROS2, "topics", "localhost=true", f"domain={DOMAIN}", "seconds=3"], capture_output=True, text=True)
                found = done.stdout
            self.assertRegex(found, r"/few +sensor_msgs/PointCloud2 +best effort")
            ours = subprocess.Popen([ROS2, "topics", "localhost=true", f"domain={DOMAIN}", "seconds=40"], stdout=subprocess.DEVNULL)
            self.assertIn("realo_topics", said(node("names", 40, "realo_topics")))
            ours.kill()
            ours.wait()
        finally:
            publisher.kill()
            publisher.communicate()

    def test_poses_come_from_transforms_and_from_odometry(self):
        map_file = (
            "agents:\n  car: { clouds: /car/points, frame: base_link, height: 0.5, pose: tf }\n"
            "  van: { clouds: /van/points, frame: van, height: 0, pose: /van/odometry }\n"
        )
        text = SENSORS.replace("SECONDS", "25 ego=car").replace("[ego_clouds, ego_poses]", "[ego_clouds, ego_poses, clouds, poses]")
        text = text.replace("AgentState }", "AgentState, clouds: realo/v1/PointCloud, poses: realo/v1/AgentState }")
        text = text.replace("recording.mcap", "recording.mcap clouds=true")
        text = text.replace("{ ego_clouds: sensors/ego_clouds }", "{ ego_clouds: sensors/ego_clouds, clouds: sensors/clouds, ego_state: sensors/ego_poses, states: sensors/poses }")
        graph = Graph(self.folder.name, text, map_file)
        graph.start()
        others = [subprocess.Popen([sys.executable, str(NODES.with_name("cyclone.py")), "transforms", "28"], env=ENV), node("drive", 28)]
        result, log = graph.end()
        for process in others:
            process.wait(timeout=60)
        counters = result["nodes"]["sensors"]["counters"]
        print({name: counters.get(name) for name in ("clouds", "poses")})
        from mcap.reader import make_reader

        found = {}
        with open(next((graph.folder / "out/results").rglob("recording.mcap")), "rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                found.setdefault((channel.topic, schema.name), []).append(message.data)
        self.assertTrue(any("PointCloud2" in kind for _, kind in found), found.keys())
        poses = {topic: payloads for (topic, kind), payloads in found.items() if "Pose" in kind}
        self.assertEqual(len(poses), 2, found.keys())
        for topic, payloads in poses.items():
            name_bytes = int.from_bytes(payloads[-1][12:16], "little")
            at = (12 + name_bytes + 7) // 8 * 8
            x, y, z = struct.unpack_from("<3d", payloads[-1], 4 + at)
            if "car" in topic:
                self.assertTrue(100 <= x <= 130 and abs(y) < 1e-9 and abs(z) < 1e-9, (topic, x, y, z))
            else:
                self.assertEqual((x, y, z), (7.0, 0.0, 0.0))
        clouds = {topic: payloads[-1] for (topic, kind), payloads in found.items() if "PointCloud2" in kind}
        car = next(payload for topic, payload in clouds.items() if "car" in topic)
        # The only point, at the origin of the LiDAR: 1.5 m ahead and 2 m above base_link, which is 0.5 m over the ground.
        self.assertIn(struct.pack("<3f", 1.5, 0.0, 2.5), car)

    def test_settings_that_cannot_be_are_refused_before_anything_starts(self):
        for args, map_file, expected in [
            ("sensors mapp=ros2.yml", STANDS, "unknown setting `mapp` (did you mean `map`?)"),
            ("sensors domain=233", STANDS, "expected 0 to 232, found `233`"),
            ("sensors ego=van", STANDS, "expected an agent of the map file (mast), found `van`"),
            ("sensors", STANDS.replace("clouds", "cloudz"), "cloudz"),
            ("sensors", STANDS.replace("/many", "'a b'"), "expected a topic such as /lidar/points"),
            ("sensors", STANDS.replace("height: 5, ", ""), "height: expected metres"),
            ("boxes detections= markers= objects=", STANDS, "expected at least one topic"),
            ("boxes markers=/a objects=/a", STANDS, "give each a name of its own"),
        ]:
            with self.subTest(args=args), tempfile.TemporaryDirectory() as folder:
                (pathlib.Path(folder) / "ros2.yml").write_text(map_file)
                done = subprocess.run([ROS2, *args.split()], cwd=folder, env=ENV | {"REALO_DRIVER": "pipe"}, stdin=subprocess.DEVNULL, capture_output=True)
                self.assertNotEqual(done.returncode, 0)
                # It tells whoever started it, over the pipe.
                self.assertIn(expected, done.stdout.decode(errors="replace"))

    def test_what_is_wrong_with_what_comes_is_said_and_counted(self):
        map_file = "agents:\n  car: { clouds: /zero, frame: base_link, height: 0, pose: /odometry }\n"
        graph = Graph(self.folder.name, SENSORS.replace("SECONDS", "30 silent_s=2"), map_file)
        graph.start()
        faulty = subprocess.Popen([sys.executable, str(NODES.with_name("faulty.py")), "25"], env=ENV)
        result, log = graph.end()
        faulty.wait(timeout=60)
        losses = result["nodes"]["sensors"].get("losses", {})
        self.assertGreater(losses["stamps_zero"]["agents"]["car"]["count"], 0, losses)
        self.assertGreater(losses["stamps_off"]["agents"]["car"]["count"], 0, losses)
        self.assertGreater(losses["no_pose"]["agents"]["car"]["count"], 0, losses)
        self.assertIn("/odometry: expected poses (nav_msgs/Odometry", log)
        self.assertIn("found sensor_msgs/NavSatFix", log)
        self.assertIn("the stamp in its header is 0", log)
        notes = " ".join(result["notes"])
        self.assertIn("clock: log", notes)


if __name__ == "__main__":
    unittest.main(verbosity=2)

"""Nodes of a real ROS 2 (rclpy) that the tests start, each as a process of its own.

    nodes.py points N HZ SECONDS TOPIC     publishes clouds of N random points
    nodes.py echo SECONDS TOPIC            says what of them arrives in another node of rclpy, as JSON
    nodes.py replay LOG AGENT SECONDS      publishes an agent's clouds and poses of a log of realo, at wall time
    nodes.py markers SECONDS TOPIC         says what of a MarkerArray arrives, as JSON
    nodes.py drive SECONDS                 publishes clouds of a car and a van, and the odometry of the van
    nodes.py names SECONDS NODE            waits until a node is known, and says which there are, as JSON
"""

import json
import sys
import time

import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

SENSOR = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=10)


def nanos(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def points(n, hz, seconds, topic):
    import os

    from sensor_msgs.msg import PointCloud2, PointField

    node = rclpy.create_node("lidar")
    publisher = node.create_publisher(PointCloud2, topic, SENSOR)
    cloud = PointCloud2(height=1, width=n, point_step=20, row_step=20 * n, is_dense=True)
    cloud.header.frame_id = "base_link"
    cloud.fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, name in enumerate("xyz")]
    cloud.fields.append(PointField(name="intensity", offset=12, datatype=PointField.UINT8, count=1))
    cloud.fields.append(PointField(name="t", offset=16, datatype=PointField.UINT32, count=1))
    data = bytearray(os.urandom(20 * n))
    for i in range(n):
        data[20 * i : 20 * i + 12] = b"\0\0\x20\x41" * 3  # 10 m
        data[20 * i + 16 : 20 * i + 20] = (99_000_000 * i // n).to_bytes(4, "little")
    cloud.data = bytes(data)
    while publisher.get_subscription_count() < 2:
        time.sleep(0.05)
    time.sleep(3)
    began = time.time()
    for k in range(int(hz * seconds)):
        time.sleep(max(0.0, began + k / hz - time.time()))
        cloud.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(cloud)
    time.sleep(1)
    print(json.dumps({"published": int(hz * seconds)}))


def heard(seconds, topic, kind, take):
    node = rclpy.create_node("listener")
    node.create_subscription(kind, topic, take, SENSOR)
    end = time.time() + seconds
    while time.time() < end:
        rclpy.spin_once(node, timeout_sec=0.1)


def echo(seconds, topic):
    from sensor_msgs.msg import PointCloud2

    delays = []
    heard(seconds, topic, PointCloud2, lambda cloud: delays.append(time.time() - 1e-9 * nanos(cloud.header.stamp)))
    delays.sort()
    share = lambda part: 1e3 * delays[int(part * (len(delays) - 1))] if delays else None
    print(json.dumps({"received": len(delays), "p50_ms": share(0.5), "p99_ms": share(0.99)}))


def markers(seconds, topic):
    from visualization_msgs.msg import MarkerArray

    arrays = []
    heard(
        seconds,
        topic,
        MarkerArray,
        lambda array: arrays.append((nanos(array.markers[0].header.stamp), array.markers[0].header.frame_id, len(array.markers) - 1)),
    )
    print(json.dumps({"arrays": arrays}))


def replay(log, agent, seconds):
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from mcap.reader import make_reader
    from sensor_msgs.msg import PointCloud2

    node = rclpy.create_node("replay")
    clouds = node.create_publisher(PointCloud2, "/lidar/points", SENSOR)
    poses = node.create_publisher(PoseWithCovarianceStamped, "/localization/pose", SENSOR)
    topics = {f"/{agent}/points": clouds, f"/{agent}/pose": poses}
    with open(log, "rb") as file:
        messages = [(channel.topic, message.log_time, message.data) for _, channel, message in make_reader(file).iter_messages(topics=list(topics))]
    while clouds.get_subscription_count() < 1 or poses.get_subscription_count() < 1:
        time.sleep(0.05)
    first = messages[0][1]
    shift = time.time_ns() + 500_000_000 - first
    stamps = []
    for topic, log_time, data in messages:
        if log_time - first > 1e9 * seconds:
            break
        time.sleep(max(0.0, 1e-9 * (log_time + shift - time.time_ns())))
        # The payload as it is, with another stamp: after the head of 4 bytes.
        stamp = int.from_bytes(data[4:8], "little") * 1_000_000_000 + int.from_bytes(data[8:12], "little") + shift
        moved = data[:4] + (stamp // 1_000_000_000).to_bytes(4, "little") + (stamp % 1_000_000_000).to_bytes(4, "little") + data[12:]
        if topic.endswith("points"):
            stamps.append(stamp)
            end = 12 + 4 + int.from_bytes(data[12:16], "little")
            name = b"base_link\0"
            own = len(data[16:end])
            if own != len(name):
                raise SystemExit(f"the frame takes {own} bytes, expected {len(name)}: bytes behind it would move")
            moved = moved[:16] + name + moved[end:]
        topics[topic].publish(moved)
    time.sleep(1)
    print(json.dumps({"stamps": stamps}))


def drive(seconds):
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import PointCloud2, PointField

    node = rclpy.create_node("drive")
    clouds = {frame: node.create_publisher(PointCloud2, topic, SENSOR) for frame, topic in (("lidar_top", "/car/points"), ("van", "/van/points"))}
    odometry = node.create_publisher(Odometry, "/van/odometry", 10)
    cloud = PointCloud2(height=1, width=1, point_step=12, row_step=12, is_dense=True, data=bytes(12))
    cloud.fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, name in enumerate("xyz")]
    end, k = time.time() + seconds, 0
    while time.time() < end:
        stamp = node.get_clock().now().to_msg()
        pose = Odometry(child_frame_id="van")
        pose.header.stamp, pose.header.frame_id = stamp, "map"
        pose.pose.pose.position.x, pose.pose.pose.orientation.w = 7.0, 1.0
        odometry.publish(pose)
        for frame, publisher in clouds.items():
            cloud.header.stamp, cloud.header.frame_id = stamp, frame
            if k % 5 == 0:
                publisher.publish(cloud)
        time.sleep(0.02)
        k += 1


def names(seconds, wanted):
    node = rclpy.create_node("names")
    found, end = [], time.time() + seconds
    while wanted not in found and time.time() < end:
        rclpy.spin_once(node, timeout_sec=0.2)
        found = node.get_node_names()
    print(json.dumps(found))


if __name__ == "__main__":
    rclpy.init()
    kinds = {"points": (points, int, float, float, str), "echo": (echo, float, str), "replay": (replay, str, str, float), "markers": (markers, float, str), "drive": (drive, float), "names": (names, float, str)}
    act, *types = kinds[sys.argv[1]]
    act(*(kind(text) for kind, text in zip(types, sys.argv[2:])))

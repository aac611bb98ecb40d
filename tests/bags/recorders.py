"""Writes a bag by a recorder that others made: `recorders.py RECORDER COMPRESSION OUT`.

RECORDER is `rosbag` (that of ROS 1, as Debian has it), or `rosbags1`, `rosbags2-sqlite3`, `rosbags2-mcap` (the Python package rosbags).
The test has the same points.
"""

import struct
import sys
from pathlib import Path

SWEEPS, POINTS = 12, 1000
START, PERIOD = 1_600_000_000_000_000_000, 100_000_000


def points(sweep: int) -> bytes:
    """x, y, z and intensity, all of which a float holds exactly."""
    numbers = []
    for i in range(POINTS):
        numbers += [(i * 37 + sweep) % 2003 / 16 - 60, (i * 53) % 1009 / 16 - 30, i % 64 / 32, float(i % 256)]
    return struct.pack(f"<{len(numbers)}f", *numbers)


def messages():
    """Topic, time, and what makes the message of a module of types."""
    for sweep in range(SWEEPS):
        yield "/points", START + sweep * PERIOD, sweep
        yield "/odom", START + sweep * PERIOD, sweep


def rosbag(compression: str, out: Path) -> None:
    import genpy
    import rosbag as recorder
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import PointCloud2, PointField

    with recorder.Bag(str(out), "w", compression=compression) as bag:
        for topic, stamp, sweep in messages():
            at = genpy.Time(stamp // 1_000_000_000, stamp % 1_000_000_000)
            if topic == "/points":
                message = PointCloud2(height=1, width=POINTS, point_step=16, row_step=16 * POINTS, is_dense=True, data=points(sweep))
                message.fields = [PointField(name, 4 * k, PointField.FLOAT32, 1) for k, name in enumerate(["x", "y", "z", "intensity"])]
                message.header.frame_id = "base_link"
            else:
                message = Odometry(child_frame_id="base_link")
                message.header.frame_id = "map"
                message.pose.pose.position.x = 2.0 * sweep
                message.pose.pose.orientation.w = 1.0
            message.header.stamp = at
            bag.write(topic, message, at)


def rosbags(storage: str, compression: str, out: Path) -> None:
    import numpy
    from rosbags.typesys import Stores, get_typestore

    is_first = storage == "rosbags1"
    store = get_typestore(Stores.ROS1_NOETIC if is_first else Stores.ROS2_HUMBLE)
    packages = ["std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs"]
    named = {name: of for name, of in store.types.items() if name.split("/")[0] in packages}
    types = {name.split("/")[-1]: of for name, of in named.items()} | {"Time": store.types["builtin_interfaces/msg/Time"]}
    serialize = store.serialize_ros1 if is_first else store.serialize_cdr

    def header(stamp: int, frame: str):
        time = types["Time"](sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)
        more = {"seq": 0} if is_first else {}
        return types["Header"](stamp=time, frame_id=frame, **more)

    def message(topic: str, stamp: int, sweep: int):
        if topic == "/points":
            fields = [types["PointField"](name=name, offset=4 * k, datatype=7, count=1) for k, name in enumerate(["x", "y", "z", "intensity"])]
            data = numpy.frombuffer(points(sweep), dtype=numpy.uint8)
            return types["PointCloud2"](
                header=header(stamp, "base_link"), height=1, width=POINTS, fields=fields, is_bigendian=False, point_step=16,
                row_step=16 * POINTS, data=data, is_dense=True,
            )
        zero = types["Vector3"](x=0.0, y=0.0, z=0.0)
        pose = types["Pose"](
            position=types["Point"](x=2.0 * sweep, y=0.0, z=0.0), orientation=types["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        )
        return types["Odometry"](
            header=header(stamp, "map"), child_frame_id="base_link",
            pose=types["PoseWithCovariance"](pose=pose, covariance=numpy.zeros(36)),
            twist=types["TwistWithCovariance"](twist=types["Twist"](linear=zero, angular=zero), covariance=numpy.zeros(36)),
        )

    if is_first:
        from rosbags.rosbag1 import Writer

        writer = Writer(out)
        if compression != "none":
            writer.set_compression(Writer.CompressionFormat[compression.upper()])
    else:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        writer = Writer(out, version=9, storage_plugin=StoragePlugin[storage.split("-")[1].upper()])
        if compression != "none":
            writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    names = {"/points": "sensor_msgs/msg/PointCloud2", "/odom": "nav_msgs/msg/Odometry"}
    with writer:
        connections = {topic: writer.add_connection(topic, name, typestore=store) for topic, name in names.items()}
        for topic, stamp, sweep in messages():
            writer.write(connections[topic], stamp, serialize(message(topic, stamp, sweep), names[topic]))


if __name__ == "__main__":
    recorder, compression, out = sys.argv[1], sys.argv[2], Path(sys.argv[3])
    rosbag(compression, out) if recorder == "rosbag" else rosbags(recorder, compression, out)

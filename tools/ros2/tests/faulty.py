"""Publishes what a driver should not: stamps of zero and of another clock, and positions where poses are expected."""

import sys
import time

import rclpy
from sensor_msgs.msg import NavSatFix, PointCloud2, PointField

from nodes import SENSOR

rclpy.init()
node = rclpy.create_node("faulty")
clouds = node.create_publisher(PointCloud2, "/zero", SENSOR)
fixes = node.create_publisher(NavSatFix, "/odometry", SENSOR)
cloud = PointCloud2(height=1, width=1, point_step=12, row_step=12, is_dense=True, data=bytes(12))
cloud.header.frame_id = "base_link"
cloud.fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, name in enumerate("xyz")]
end, k = time.time() + float(sys.argv[1]), 0
while time.time() < end:
    now = time.time_ns()
    # Zero, 37 s early as GPS time is, and right.
    stamp = [0, now - 37_000_000_000, now][k % 3]
    cloud.header.stamp.sec, cloud.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    clouds.publish(cloud)
    fixes.publish(NavSatFix())
    time.sleep(0.1)
    k += 1

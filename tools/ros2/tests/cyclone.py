"""Cyclone, a second DDS, with types written after their definitions: the packages of rclpy do not have these.

    cyclone.py boxes SECONDS         says what boxes came, as JSON: by message its stamp, frame, and class (or label), score and size of each
    cyclone.py transforms SECONDS    publishes transforms: map > odom > base_link, which drives, and a LiDAR on it
"""

import json
import os
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Point32(IdlStruct, typename="geometry_msgs::msg::dds_::Point32_"):
    x: float32
    y: float32
    z: float32


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Vector3
    orientation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    linear: Vector3
    angular: Vector3
    covariance: array[float64, 36]


@dataclass
class Hypothesis(IdlStruct, typename="vision_msgs::msg::dds_::ObjectHypothesisWithPose_"):
    class_id: str
    score: float64
    pose: PoseWithCovariance


@dataclass
class Detection3D(IdlStruct, typename="vision_msgs::msg::dds_::Detection3D_"):
    header: Header
    results: sequence[Hypothesis]
    center: Pose
    size: Vector3
    id: str


@dataclass
class Detection3DArray(IdlStruct, typename="vision_msgs::msg::dds_::Detection3DArray_"):
    header: Header
    detections: sequence[Detection3D]


@dataclass
class Classification(IdlStruct, typename="autoware_perception_msgs::msg::dds_::ObjectClassification_"):
    label: uint8
    probability: float32


@dataclass
class DetectedObject(IdlStruct, typename="autoware_perception_msgs::msg::dds_::DetectedObject_"):
    existence_probability: float32
    classification: sequence[Classification]
    pose_with_covariance: PoseWithCovariance
    has_position_covariance: bool
    orientation_availability: uint8
    twist_with_covariance: TwistWithCovariance
    has_twist: bool
    has_twist_covariance: bool
    shape: uint8
    footprint: sequence[Point32]
    dimensions: Vector3


@dataclass
class DetectedObjects(IdlStruct, typename="autoware_perception_msgs::msg::dds_::DetectedObjects_"):
    header: Header
    objects: sequence[DetectedObject]


def size(vector):
    return [vector.x, vector.y, vector.z]


def boxes_of(participant, seconds):
    qos = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(100))
    reader = lambda topic, kind: DataReader(participant, Topic(participant, f"rt{topic}", kind, qos=qos), qos=qos)
    readers = {"detections": reader("/realo/detections", Detection3DArray), "objects": reader("/realo/objects", DetectedObjects)}
    boxes = {
        "detections": lambda array: [(box.results[0].class_id, box.results[0].score, size(box.size)) for box in array.detections],
        "objects": lambda array: [(box.classification[0].label, box.existence_probability, size(box.dimensions)) for box in array.objects],
    }
    found = {form: [] for form in readers}
    end = time.time() + seconds
    while time.time() < end:
        for form, known in readers.items():
            for array_ in known.take(100):
                header = getattr(array_, "header", None)
                if header is not None:
                    found[form].append((header.stamp.sec * 1_000_000_000 + header.stamp.nanosec, header.frame_id, boxes[form](array_)))
        time.sleep(0.02)
    print(json.dumps(found))


def transforms(participant, seconds):
    reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
    latched = Qos(reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
    moving = Qos(reliable, Policy.History.KeepLast(100))
    writer = lambda topic, qos: DataWriter(participant, Topic(participant, f"rt{topic}", TFMessage, qos=qos), qos=qos)
    fixed, moves = writer("/tf_static", latched), writer("/tf", moving)

    def transform(parent, child, x, z=0.0):
        header = Header(Time(*divmod(time.time_ns(), 1_000_000_000)), parent)
        return TransformStamped(header, child, Vector3(x, 0.0, z), Quaternion(0.0, 0.0, 0.0, 1.0))

    fixed.write(TFMessage([transform("base_link", "lidar_top", 1.5, 2.0)]))
    end, k = time.time() + seconds, 0
    while time.time() < end:
        if k % 5 == 0:
            moves.write(TFMessage([transform("map", "odom", 100.0)]))
        moves.write(TFMessage([transform("odom", "base_link", 0.02 * k, 0.5)]))
        time.sleep(0.02)
        k += 1


def main():
    participant = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", "0")))
    {"boxes": boxes_of, "transforms": transforms}[sys.argv[1]](participant, float(sys.argv[2]))


main()

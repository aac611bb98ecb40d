#!/usr/bin/env bash
# Builds realo-ros2 and tests it beside a real ROS 2 from the Python registry, in an environment of its own under target/.
# That takes REALO_ROS2_LIVE=1, some minutes and a machine that is not busy: DDS loses what nobody takes in time. Without it or without the
# packages it says SKIPPED, loudly.
set -euo pipefail
cd "$(dirname "$0")/../../.."

packages="ros-rclpy ros-sensor-msgs ros-geometry-msgs ros-nav-msgs ros-visualization-msgs ros-rmw-fastrtps-cpp cyclonedds mcap zstandard lz4 numpy"
cargo build --release --locked --manifest-path tools/ros2/Cargo.toml --target-dir target
cargo test --release --locked --manifest-path tools/ros2/Cargo.toml --target-dir target
if [ "${REALO_ROS2_LIVE:-0}" != 1 ]; then
  echo 'SKIPPED: realo-ros2 was built and not tested beside ROS 2; REALO_ROS2_LIVE=1 does that' >&2
  exit 0
fi
python3 -m venv target/ros2-venv
# shellcheck disable=SC2086
if target/ros2-venv/bin/python -m pip install --quiet --disable-pip-version-check $packages &&
   target/ros2-venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps 'dora-rs-cli==1.1.0'; then
  [ -e target/realo/demo.mcap ] || target/release/realo run no_fusion --recorded-detections --mode virtual --out target/realo/ros2-demo >/dev/null
  target/ros2-venv/bin/python -B tools/ros2/tests/test_live.py
else
  echo 'SKIPPED: realo-ros2 was built and not tested beside ROS 2: pip cannot install rclpy, Cyclone DDS or dora here' >&2
fi

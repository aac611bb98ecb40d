//! Simulated logs, written in each layout, imported again, and compared message by message.

mod bad_input;
mod cpm;
mod kitti;
mod opv2v;
mod reading;
mod rosbag2;
mod world;

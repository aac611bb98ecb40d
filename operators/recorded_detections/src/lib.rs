//! The detections that a log recorded, in place of a detector.
//!
//! Boxes that no object can have, such as those without extent or more than 10 km away, are dropped and counted (`invalid_boxes`).

mod operator;

pub use operator::{RecordedDetections, Settings, sound};

//! The detections that a log recorded, in place of a detector.
//!
//! | port | direction | types | meaning |
//! |---|---|---|---|
//! | `clouds` | in, latest, set `sweep` | PointCloud | localised sweeps |
//! | `recorded` | in, latest, set `sweep` | Boxes | what the log says was detected in the sweep |
//! | `boxes` | out | Boxes | the same with the sweep's header and pose |
//!
//! Boxes that no object can have, such as those without extent or more than 10 km away, are dropped and counted (`invalid_boxes`).

mod operator;

pub use operator::{RecordedDetections, Settings, sound};

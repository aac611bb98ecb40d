//! Geometry of frames and boxes: poses in f64, x forward, y left, z up, yaw from +x towards +y.

mod boxes;
mod cloud;
mod deskew;
mod motion;
mod region;
mod rotated;
mod view;

pub use boxes::{
    FARTHEST_M, LARGEST_M, PLAUSIBLE_BOX, bottom_corners, box_fault, detection_fault, footprint_contains, is_plausible,
    is_valid, level_from_body, normalize_yaw, relative, tilt_degrees, transform_box, transform_boxes, yaw_of,
};
pub use cloud::transform_cloud;
pub use deskew::Motion;
pub use motion::{PoseTrack, interpolate};
pub use region::Region;
pub use rotated::{Footprint, intersection_area, iou, iou_exceeds};
pub use view::View;

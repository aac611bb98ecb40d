//! What the networks compute besides their layers, as V2X-Real does: [`anchors`] and [`points`].

pub mod anchors;
pub mod points;

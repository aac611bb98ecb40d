//! From points to the canvas: pillars, and the layer that reads their points.

pub mod pillar_net;
pub mod pillars;

//! A network in an ONNX file as a stage of a graph.
//!
//! | role | reads | gives | takes the place of |
//! |---|---|---|---|
//! | `encoder` | PointCloud | FeatureMap | `encoder` of a lane |
//! | `fusion` | FeatureMap of the ego, Selection of others' | FeatureMap | `fusion` of `fuse.features.yml` |
//! | `head` | FeatureMap | Boxes | `head` of `fuse.features.yml` |
//! | `detector` | PointCloud | Boxes | `encoder` and `head` of a lane |
//!
//! [`network`] binds a file's inputs and outputs by name and checks them when it is loaded; [`cloud`] makes tensors of points,
//! [`maps`] of BEV maps, [`boxes`] reads detections.

pub mod boxes;
pub mod cloud;
mod identity;
pub mod maps;
pub mod network;
mod role;
mod stages;
mod whole;

pub use role::Role;
pub use stages::{Detector, Encoder, Fusion, Head};

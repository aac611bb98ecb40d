//! The shipped stages that every strategy is built of: they compute no network and fuse nothing.
//!
//! A program takes them from here by name, and the networks and fusions of its choice beside them.

pub use realo_evaluator::Evaluator;
pub use realo_feature_bank::FeatureBank;
pub use realo_fusion_guard::FusionGuard;
pub use realo_liar::Liar;
pub use realo_link::{self as link, Link};
pub use realo_localization::Localization;
pub use realo_nms::Nms;
pub use realo_projector::{Project, Projector};
pub use realo_recorded_detections::RecordedDetections;
pub use realo_sync::{Settings as SyncSettings, Sync};
pub use realo_tracker::Tracker;
pub use realo_transmission::{TransmissionDecoder, TransmissionEncoder};

//! Boxes in motion: gives the boxes of each agent's stream velocities and identities.
//!
//! - [`Motion`] is the extended Kalman filter of one object: position, velocity and turn rate on the ground plane of `map`.
//! - [`Tracks`] are the objects of one stream: predicted to each sweep, paired with its boxes, corrected, forgotten.
//! - [`Tracker`] is the stage: one [`Tracks`] for each agent.
//!
//! # What it does
//! Boxes are brought to `map` by the pose in the message's header, so the sender's own motion is no motion of theirs. Tracks
//! are paired with boxes so that the sum of their distances on the ground is the smallest (`realo-assignment`); a pair is
//! possible up to `gate` standard deviations (Mahalanobis) and `max_distance_m`, between boxes of one class or of alike
//! lengths. A paired box gets the identity of its track, and its velocity and centre once the track has been seen in
//! `min_hits` sweeps. A box without a track begins one. Size, heading, height, score and class of boxes stay as they came.
//!
//! # Time
//! Stamps decide, not arrival. Tracks that are not seen for `max_gap_ms` end. A message of the last stamp again, or of an
//! earlier one, passes unchanged and is counted; a stamp more than `max_gap_ms` before the last begins anew, as a clock was
//! set back.

mod motion;
mod operator;
mod tracks;

pub use motion::{Motion, Noise, Seen};
pub use operator::{Input, Output, Settings, Tracker};
pub use tracks::{Limits, Order, Outcome, Tracks};

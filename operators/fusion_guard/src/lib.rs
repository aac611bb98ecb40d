//! Keeps a fusion from harm: stands between `feature-bank` and a fusion, and compares what collaborators say with what the ego sees.
//!
//! - [`Scene`] are the objects of the ego and of one collaborator; [`search`] finds the motion that brings theirs to the ego's, [`fit`] its
//!   least squares, [`lay_over`] the same of an agent that says no pose. [`ahead_s`] finds how far a clock is off.
//! - In a BEV map the guard compares the boxes that the model's heads find in that map alone.
//! - [`View`] is what the ego's own sweep shows: free ground, things that stand, places that it cannot see.
//! - [`judge`] sorts a collaborator's boxes by both, and says what is kept; [`Record`] is what is known of it from before.
//! - [`FusionGuard`] is the stage.
//!
//! # What it does
//! A pose is corrected only if the objects ask for it more than chance does, so exact poses stay as they are. Boxes where the ego sees that
//! nothing stands are dropped. A message that contradicts the ego more than it agrees with it is left out, and so is one of an agent that
//! often did, or whose poses were wrong and cannot be corrected now. What the ego cannot see counts by the trust in its sender and by the
//! covariance of its place: its score is multiplied by both.
//!
//! # What it cannot see
//! Whoever agrees with the ego wherever it sees, and lies about what is hidden, is believed. So are agents that lie alike.
//!
//! # Sources
//! Poses from pairs of boxes: Lu et al. 2023 (CoAlign), Song et al. 2023 (VIPS); without any pose: Lei et al. 2024 (FreeAlign). Votes for
//! motions: Ballard 1981. Robust weights: Cauchy's.

mod boxes;
mod cells;
mod clock;
mod constellation;
mod counters;
mod entry;
mod fit;
mod map_boxes;
mod objects;
mod operator;
mod overlay;
mod record;
mod search;
mod shift;
mod sight;
mod verdict;
mod view;

pub use boxes::{Ego, Judgement, Known, Limits, Origin, Said, judge};
pub use cells::{Ground, Overlay, standing};
pub use clock::ahead_s;
pub use constellation::lay_over;
pub use fit::{Fit, GATE_M, Noise, Scene, Stated, fit};
pub use objects::{Object, objects};
pub use operator::{FusionGuard, GuardError, Input, Output, Settings};
pub use record::Record;
pub use search::{Found, Reach, search};
pub use shift::{Shift, half_turn, turned, variance_at};
pub use verdict::{Reason, Shares, weigh_pose, weigh_trust};
pub use view::{Seen, View};

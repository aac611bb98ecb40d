//! Where each agent is at each sweep.
//!
//! What motion sensors measured comes on an optional port; it is checked and counted, by agent.
//!
//! Nothing is estimated yet: the pose that the player took from the log passes, recorded or true. An estimator will
//! take the same ports: the sweep, and the state as its prior.
//!
//! # Noise
//! `position_noise_m` and `heading_noise_deg` are standard deviations of normal errors of x, y and z, and of the heading: what
//! an agent then believes, uses and sends. `noise=each` draws them for each agent and sweep, by `seed`, agent and number of the
//! sweep alone; `noise=same` gives every agent and sweep the one error that V2X-Real's test gives them for its `seed`. The ego
//! and the others have lanes of their own, so `others.sense.localization.position_noise_m=0.2` leaves the ego's poses as they
//! are, as V2X-Real does. A true pose with noise is a recorded one.

mod mersenne;
mod motion;
mod noise;
mod operator;

pub use mersenne::Mersenne;
pub use noise::{PoseError, PoseNoise};
pub use operator::{Localization, NoiseDraws, Settings, Source, localize};

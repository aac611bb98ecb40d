//! Where each agent is at each sweep.
//!
//! With `source=recorded` or `true` the pose that the player took from the log passes. With `source=gnss` or `map` it is estimated by an
//! error-state Kalman filter ([`realo_state_estimation`]) from what motion sensors measured, which comes on the optional port `motion`:
//! IMU, GNSS and wheels. With a map each sweep is also looked for on it ([`realo_registration`]): tracked from the filter's pose, searched
//! for around it after a loss, and in all directions where no heading is known. Its pose goes to the filter at the sweep's stamp, however
//! late, behind a gate. Nothing of the recorded pose is used but how a roadside unit is turned, with `source=gnss`.
//!
//! An estimated state has a status: `init`, `tracking`, `dead_reckoning` or `lost`. In `init` and `lost` sweeps go on without a pose: an
//! agent detects what it sees itself, fuses nothing of others, and its encoder sends nothing.
//!
//! # Noise
//! `position_noise_m` and `heading_noise_deg` are standard deviations of normal errors of x, y and z, and of the heading: what
//! an agent then believes, uses and sends. `noise=each` draws them for each agent and sweep, by `seed`, agent and number of the
//! sweep alone; `noise=same` gives every agent and sweep the one error that V2X-Real's test gives them for its `seed`. The ego
//! and the others have lanes of their own, so `others.sense.localization.position_noise_m=0.2` leaves the ego's poses as they
//! are, as V2X-Real does. A true pose with noise is a recorded one.

mod agent;
mod clock;
mod faults;
mod mersenne;
mod motion;
mod noise;
mod operator;
mod place;
#[cfg(test)]
mod tests;

pub use mersenne::Mersenne;
pub use noise::{PoseError, PoseNoise};
pub use operator::{Localization, LocalizationError, NoiseDraws, Settings, Source, UnitChoice, localize};
pub use place::PlaceError;

//! Where each agent is at each sweep.
//!
//! | port | direction | types | meaning |
//! |---|---|---|---|
//! | `clouds` | in, latest, set `sweep` | PointCloud | sweeps in the body frame at their stamp |
//! | `states` | in, latest, set `sweep` | EgoState | what is known of pose and motion at the sweep's stamp |
//! | `clouds` | out | PointCloud | the sweeps with the estimated pose |
//! | `state` | out | EgoState | the estimated pose and motion at the sweep's stamp |
//!
//! Nothing is estimated yet: the pose that the player took from the log passes, recorded or true. An estimator will
//! take the same ports: the sweep, and the state as its prior.

mod operator;

pub use operator::{Localization, LocalizationConfig, Source, localize};

//! The architectures: what a model's `arch` may be, each with its layers in a file of its own.

mod pointpillars;

#[cfg(test)]
pub(crate) use pointpillars::heads;
use serde::{Deserialize, Serialize};

use crate::layers::Layers;
use crate::model::{Model, Problems};

/// How a model's layers are put together, with the settings that only this architecture has.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum Arch {
    /// Pillars, backbone, shrink layers and heads of one agent (PointPillars, Lang et al. 2019, as in V2X-Real).
    PointPillars {},
}

impl Default for Arch {
    fn default() -> Self {
        Arch::PointPillars {}
    }
}

impl Arch {
    /// Whether it is the one that a model has which names none.
    pub(crate) fn is_default(&self) -> bool {
        *self == Arch::default()
    }

    /// What of a model, whose parts are within their bounds, does not fit together.
    pub(crate) fn check(&self, model: &Model, problems: &mut Problems) {
        match self {
            Arch::PointPillars {} => pointpillars::check(model, problems),
        }
    }

    /// The layers of a model that has been checked.
    pub(crate) fn layers(&self, model: &Model) -> Layers {
        match self {
            Arch::PointPillars {} => pointpillars::layers(model),
        }
    }
}

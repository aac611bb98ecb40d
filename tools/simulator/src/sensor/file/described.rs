//! A sensor as its file says it, and the checks of its numbers.

use serde::Deserialize;

use super::error::SensorError;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Description {
    pub model: String,
    /// Beam table beside the file, or built in.
    pub table: Option<String>,
    #[serde(default)]
    pub bands: Vec<Band>,
    pub columns: usize,
    /// Width of the field ahead; a whole turn without.
    pub field_deg: Option<f64>,
    pub unanswered: f64,
    pub mount: MountText,
    pub optics: OpticsText,
}

/// Beams at even steps.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Band {
    pub from_deg: f64,
    pub to_deg: f64,
    pub step_deg: f64,
    /// They fire in every n-th column.
    #[serde(default = "one")]
    pub every: usize,
}

pub(super) fn one() -> usize {
    1
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MountText {
    pub height_m: f64,
    /// Positive looks down.
    #[serde(default)]
    pub pitch_deg: f64,
    #[serde(default)]
    pub roll_deg: f64,
    /// Positive looks left.
    #[serde(default)]
    pub yaw_deg: f64,
    #[serde(default)]
    pub misalignment_deg: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct OpticsText {
    pub reach_m: f64,
    pub reach_reflectivity: f64,
    pub nearest_m: f64,
    pub farthest_m: f64,
    pub range_step_m: f64,
    pub noise_floor_m: f64,
    pub noise_slope_m: f64,
    pub noise_ceiling_m: f64,
}

/// Says what is wrong where.
pub(super) struct Checker<'a> {
    pub path: &'a str,
}

impl Checker<'_> {
    pub(super) fn need(
        &self,
        holds: bool,
        field: &str,
        expected: &str,
        found: impl ToString,
    ) -> Result<(), SensorError> {
        if holds {
            return Ok(());
        }
        Err(SensorError::Field {
            path: self.path.into(),
            field: field.into(),
            expected: expected.into(),
            found: found.to_string(),
        })
    }

    pub(super) fn within(&self, field: &str, value: f64, [low, high]: [f64; 2]) -> Result<(), SensorError> {
        let holds = (low..=high).contains(&value);
        self.need(holds, field, &format!("a number within [{low}, {high}]"), value)
    }
}

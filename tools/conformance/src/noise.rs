//! Pose noise and delays, as localization and the link make them of the reference's generator.

use std::collections::BTreeMap;

use realo_link::{Jitter, Model, delay};
use realo_localization::{Mersenne, PoseNoise};
use realo_schemas::Nanos;
use serde::Deserialize;

use crate::Kind;
use crate::reference::pose_of;
use crate::vector::{Vector, compare, equal};

pub(crate) const KINDS: &[Kind] = &[Kind::new(&["localisation"], noise)];

#[derive(Deserialize)]
struct Document {
    localisation: Vec<Localized>,
    #[serde(default)]
    delay_sim: Vec<Fixed>,
    #[serde(default)]
    delay_real: Vec<Drawn>,
    #[serde(default)]
    generator_stream: BTreeMap<u32, Stream>,
}

#[derive(Deserialize)]
struct Localized {
    seed: u32,
    xyz_std: f64,
    ryp_std: f64,
    pose: [f64; 6],
    noisy_pose: [f64; 6],
    xyz_draw: [f64; 3],
    ryp_draw: [f64; 3],
}

#[derive(Deserialize)]
struct Fixed {
    overhead_ms: f64,
    delay_frames: i64,
}

#[derive(Deserialize)]
struct Drawn {
    seed: u32,
    overhead_ms: f64,
    data_size_mb: f64,
    speed_mbps: f64,
    backbone_ms: f64,
    delay_frames: Vec<i64>,
}

#[derive(Deserialize)]
struct Stream {
    #[serde(rename = "standard_normal_x20", default)]
    normal: Vec<f64>,
    #[serde(rename = "uniform_x10_after", default)]
    uniform_after: Vec<f64>,
}

/// Time from one sweep to the next, ms.
const FRAME_MS: f64 = 100.0;

fn noise(vector: &Vector) -> Result<(), String> {
    let Document {
        localisation,
        delay_sim,
        delay_real,
        generator_stream,
    } = vector.json(None)?;
    let t = vector.tolerance()?;
    for (index, case) in localisation.iter().enumerate() {
        localized(case, t).map_err(|difference| format!("localisation[{index}]: {difference}"))?;
    }
    for (seed, stream) in &generator_stream {
        let mut generator = Mersenne::new(*seed);
        let normal: Vec<f64> = stream.normal.iter().map(|_| generator.normal()).collect();
        let uniform: Vec<f64> = stream.uniform_after.iter().map(|_| generator.uniform()).collect();
        let of = |what: &str| format!("generator_stream.{seed}: {what}");
        compare(&of("normal"), &normal, &stream.normal, t)?;
        compare(&of("uniform"), &uniform, &stream.uniform_after, t)?;
    }
    let fixed = delay_sim
        .iter()
        .map(|case| in_whole_frames(delay_of_overhead(case.overhead_ms)));
    let expected: Vec<i64> = delay_sim.iter().map(|case| case.delay_frames).collect();
    equal("delay_sim", &fixed.collect::<Vec<_>>(), &expected)?;
    for (index, case) in delay_real.iter().enumerate() {
        equal(&format!("delay_real[{index}]"), &drawn(case), &case.delay_frames)?;
    }
    Ok(())
}

fn localized(case: &Localized, t: f64) -> Result<(), String> {
    let noise = PoseNoise {
        position_m: case.xyz_std,
        heading_deg: case.ryp_std,
    };
    let error = noise.reference(case.seed);
    compare("xyz_draw", &error.shift, &case.xyz_draw, t)?;
    compare("ryp_draw", &[error.turn_deg], &case.ryp_draw[1..2], t)?;
    let (found, expected) = (error.of(&pose_of(case.pose)), pose_of(case.noisy_pose));
    let numbers = |pose: nalgebra::Isometry3<f64>| pose.to_homogeneous().as_slice().to_vec();
    compare("noisy_pose", &numbers(found), &numbers(expected), t)
}

/// A link whose delays are whole frames.
fn in_frames() -> Model {
    Model {
        step_ms: FRAME_MS,
        ..Model::default()
    }
}

/// The delay of a constant number of ms over a link whose delays are whole frames, ns.
pub(crate) fn delay_of_overhead(overhead_ms: f64) -> Nanos {
    let model = Model {
        fixed_ms: overhead_ms,
        ..in_frames()
    };
    delay(&model, 0, 0.0, 0.0)
}

/// Delays of a constant part, one for the bytes, and one up to `overhead_ms` at random.
fn drawn(case: &Drawn) -> Vec<i64> {
    let half = case.overhead_ms / 2.0;
    let model = Model {
        fixed_ms: case.backbone_ms + half,
        bits_per_second: Some((case.speed_mbps * 1e6).round() as u64),
        jitter: Jitter {
            uniform_ms: half,
            gaussian_ms: 0.0,
        },
        ..in_frames()
    };
    let bytes = (case.data_size_mb * 1e6 / 8.0).round() as usize;
    let mut generator = Mersenne::new(case.seed);
    let draws = case.delay_frames.iter().map(|_| generator.uniform());
    draws.map(|uniform| frames(&model, bytes, uniform)).collect()
}

fn frames(model: &Model, bytes: usize, uniform: f64) -> i64 {
    in_whole_frames(delay(model, bytes, uniform, 0.0))
}

fn in_whole_frames(delay: Nanos) -> i64 {
    (delay as f64 / (FRAME_MS * 1e6)) as i64
}

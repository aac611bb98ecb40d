use nalgebra::Isometry3;
use realo_nms::{Config, keep};
use realo_nn::anchors::Anchors;
use realo_nn::decode::{Detection, candidates};
use realo_schemas::geometry::{Corners, corners_inside, transform_corners};

use crate::Check;
use crate::boxes::{cells_of, cuboid, flat, isometry};
use crate::iou_nms::footprints;
use crate::vector::{Tensors, Vector, compare, equal};

pub(crate) fn check(name: &str) -> Option<Check> {
    match name {
        "single_agent" | "single_agent_dense" => Some(single_agent),
        "late_fusion_3agents" => Some(late_fusion),
        _ => None,
    }
}

/// Boxes of any number of agents in the ego's frame.
#[derive(Default)]
struct Found {
    corners: Vec<Corners>,
    scores: Vec<f32>,
    labels: Vec<f64>,
}

impl Found {
    fn add(&mut self, ego_from_agent: &Isometry3<f64>, detections: &[Detection]) {
        for Detection { class, score, hwl } in detections {
            let corners = cuboid(&hwl.map(f64::from)).corners();
            self.corners.push(transform_corners(ego_from_agent, &corners));
            self.scores.push(*score);
            self.labels.push(*class as f64 + 1.0);
        }
    }

    /// Suppresses duplicates, drops what is not wholly in the region of evaluation, and compares.
    fn check(&self, vector: &Vector, tensors: &Tensors) -> Result<(), String> {
        let config = Config {
            threshold: vector.number("nms_threshold")?,
            ..Config::default()
        };
        let kept = keep(&footprints(&self.corners), &self.scores, &config);
        let (least, most) = ([-100.0, -40.0, f64::NEG_INFINITY], [100.0, 40.0, f64::INFINITY]);
        let kept = kept.into_iter().map(|index| index as usize);
        let kept: Vec<usize> = kept
            .filter(|i| corners_inside(&self.corners[*i], least, most) == 8)
            .collect();

        let t = vector.tolerance()?;
        let labels: Vec<f64> = kept.iter().map(|i| self.labels[*i]).collect();
        equal("labels", &labels, &tensors.numbers("out.labels")?)?;
        let scores: Vec<f64> = kept.iter().map(|i| f64::from(self.scores[*i])).collect();
        compare("scores", &scores, &tensors.numbers("out.scores")?, t)?;
        let corners: Vec<Corners> = kept.iter().map(|i| self.corners[*i]).collect();
        compare(
            "corners",
            &flat(corners.as_flattened()),
            &tensors.numbers("out.corners")?,
            t,
        )
    }
}

/// The candidates of an agent; `suffix` of its tensors' names.
fn detections(vector: &Vector, tensors: &Tensors, suffix: &str) -> Result<Vec<Detection>, String> {
    let anchors = Anchors::v2x_real(cells_of(vector.setting("range")?));
    let (scores, _) = tensors.channels_last(&format!("in.psm{suffix}"))?;
    let (deltas, _) = tensors.channels_last(&format!("in.rm{suffix}"))?;
    if (scores.len(), deltas.len()) != (anchors.count() * 3, anchors.count() * 7) {
        return Err(format!("expected maps of {} anchors", anchors.count()));
    }
    let threshold = vector.number("score_threshold")? as f32;
    Ok(candidates(&anchors, &scores, &deltas, threshold, 1000).detections)
}

fn single_agent(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let detections = detections(vector, &tensors, "")?;
    let expected = vector.number("candidates")?;
    compare("number of candidates", &[detections.len() as f64], &[expected], 0.0)?;
    let mut found = Found::default();
    found.add(&Isometry3::identity(), &detections);
    found.check(vector, &tensors)
}

fn late_fusion(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let mut found = Found::default();
    for agent in 0..3 {
        let ego_from_agent = isometry(&tensors.numbers(&format!("in.matrix_{agent}"))?)?;
        found.add(&ego_from_agent, &detections(vector, &tensors, &format!("_{agent}"))?);
    }
    found.check(vector, &tensors)
}

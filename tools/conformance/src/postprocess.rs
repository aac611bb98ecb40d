use nalgebra::Isometry3;
use realo_bev::Decoder;
use realo_nms::{Config, nms};
use realo_schemas::Box3;
use realo_schemas::geometry::transform_box;
use realo_scoring::Protocol;

use crate::Kind;
use crate::boxes::compare_boxes;
use crate::reference::{anchors_of, transform_of};
use crate::vector::{Tensors, Vector, compare, equal};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["in.psm", "in.rm", "out.corners"], single_agent),
    Kind::new(&["in.psm_0", "in.rm_0", "in.matrix_0", "out.corners"], late_fusion),
];

/// Suppresses duplicates, drops what the evaluation does not look at, and compares.
fn check(vector: &Vector, tensors: &Tensors, boxes: &[Box3]) -> Result<(), String> {
    let protocol = Protocol::load("default").map_err(|error| error.to_string())?;
    let config = Config {
        threshold: vector.number("nms_threshold")?,
        ..Config::default()
    };
    let kept = nms(boxes, &config, None).kept;
    let kept = kept.into_iter().map(|index| boxes[index as usize].clone());
    let kept: Vec<Box3> = kept.filter(|object| protocol.takes_in(object)).collect();

    let t = vector.tolerance()?;
    let label = |object: &Box3| {
        protocol
            .class_of(&object.class)
            .map_or(f64::NAN, |class| f64::from(class) + 1.0)
    };
    let labels: Vec<f64> = kept.iter().map(label).collect();
    equal("labels", &labels, &tensors.numbers("out.labels")?)?;
    let scores: Vec<f64> = kept.iter().map(|object| f64::from(object.score)).collect();
    compare("scores", &scores, &tensors.numbers("out.scores")?, t)?;
    compare_boxes("boxes", &kept, &tensors.corners("out.corners")?, t)
}

/// The boxes of an agent; `suffix` of its tensors' names.
fn decoded(vector: &Vector, tensors: &Tensors, suffix: &str) -> Result<Vec<Box3>, String> {
    let anchors = anchors_of(vector.setting("range")?)?;
    let (scores, _) = tensors.channels_last(&format!("in.psm{suffix}"))?;
    let (deltas, _) = tensors.channels_last(&format!("in.rm{suffix}"))?;
    if (scores.len(), deltas.len()) != (anchors.count() * anchors.classes.len(), anchors.count() * 7) {
        return Err(format!("expected maps of {} anchors", anchors.count()));
    }
    let threshold = vector.number("score_threshold")? as f32;
    Ok(Decoder::new(anchors, threshold).decode(&scores, &deltas).boxes)
}

fn single_agent(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let boxes = decoded(vector, &tensors, "")?;
    let expected = vector.number("candidates")?;
    compare("number of candidates", &[boxes.len() as f64], &[expected], 0.0)?;
    check(vector, &tensors, &boxes)
}

fn late_fusion(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let mut boxes = Vec::new();
    for agent in 0..tensors.names("in.matrix_")?.len() {
        let ego_from_agent: Isometry3<f64> = transform_of(&tensors.numbers(&format!("in.matrix_{agent}"))?)?;
        let own = decoded(vector, &tensors, &format!("_{agent}"))?;
        boxes.extend(own.iter().map(|object| transform_box(&ego_from_agent, object)));
    }
    check(vector, &tensors, &boxes)
}

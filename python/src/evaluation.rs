//! The evaluator on arrays.

use std::collections::BTreeMap;

use arrow_array::Array;
use arrow_array::types::{Int64Type, UInt32Type};
use pyo3::prelude::*;
use realo_results::scoring::{Collector, Protocol};
use realo_results::{Run, Settings};
use realo_schemas::geometry::View;
use realo_schemas::{Box3, Boxes, GroundTruth, Header, Kind, Name, Nanos, OwnLabels};

use crate::boxes::{Numbers, message_of_boxes, numbers};
use crate::run::RunFiles;
use crate::{Row, refused};

/// A sweep of the ego.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct FrameRow {
    seq: u64,
    stamp: Nanos,
    key: bool,
    processed: bool,
    ego_footprint: Option<[f64; 4]>,
    views: Vec<[f64; View::NUMBERS]>,
    own_key: Option<bool>,
    own_views: Vec<[f64; View::NUMBERS]>,
}

/// Boxes of all frames: the message, the frame of each box, and the points that all agents and the ego have on it, -1 where they are
/// not known.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct FrameBoxes {
    boxes: Row,
    frame: Numbers,
    points: Numbers,
    own_points: Numbers,
}

/// Boxes of one frame and the points on each.
type Labelled = (Vec<Box3>, Option<Vec<[u32; 2]>>);

impl FrameBoxes {
    /// By frame.
    fn split(self, argument: &str, frames: usize) -> PyResult<BTreeMap<usize, Labelled>> {
        let (_, boxes) = message_of_boxes(argument, self.boxes)?;
        let places = numbers::<UInt32Type>(argument, self.frame)?;
        let points = [self.points, self.own_points].map(|points| numbers::<Int64Type>(argument, points));
        let [all, own] = points;
        let (all, own) = (all?, own?);
        if [places.len(), all.len(), own.len()].iter().any(|len| *len != boxes.len()) {
            let reason = format!("expected {} numbers a column, one a box", boxes.len());
            return Err(refused(argument, reason));
        }
        let mut split: BTreeMap<usize, Labelled> = BTreeMap::new();
        for (at, object) in boxes.into_iter().enumerate() {
            let frame = places.value(at) as usize;
            if frame >= frames {
                return Err(refused(argument, format!("expected frames below {frames}, found {frame}")));
            }
            let (boxes, points) = split.entry(frame).or_insert_with(|| (Vec::new(), Some(Vec::new())));
            boxes.push(object);
            let counts = (all.value(at), own.value(at));
            *points = match (points.take(), u32::try_from(counts.0), u32::try_from(counts.1)) {
                (Some(mut known), Ok(all), Ok(own)) => {
                    known.push([own, all.saturating_sub(own)]);
                    Some(known)
                }
                _ => None,
            };
        }
        Ok(split)
    }
}

fn views(argument: &str, numbers: &[[f64; View::NUMBERS]]) -> PyResult<Vec<View>> {
    let views = numbers.iter().map(View::from_numbers);
    views.collect::<Result<_, _>>().map_err(|reason| refused(argument, reason))
}

/// The protocol of a name or a file.
fn protocol_of(name: &str) -> PyResult<Protocol> {
    Protocol::load(name).map_err(|error| refused("protocol", error))
}

/// Names of a protocol's super-classes, and all names that belong to one.
#[pyfunction]
pub fn classes_of(protocol: &str, asked: Vec<String>) -> PyResult<(Vec<String>, Vec<Option<u8>>)> {
    let protocol = protocol_of(protocol)?;
    let numbers = asked.iter().map(|name| protocol.class_of(name)).collect();
    Ok((protocol.classes.into_iter().map(|class| class.name).collect(), numbers))
}

/// Scores boxes against truth: what `realo evaluate` does with a recording and a log.
#[pyfunction]
#[pyo3(signature = (protocol, frames, predictions, truth, own, name, ego))]
pub fn evaluate(
    py: Python,
    protocol: &str,
    frames: Vec<FrameRow>,
    predictions: FrameBoxes,
    truth: FrameBoxes,
    own: FrameBoxes,
    name: &str,
    ego: &str,
) -> PyResult<RunFiles> {
    let protocol = protocol_of(protocol)?;
    let mut predictions = predictions.split("predictions", frames.len())?;
    let mut truths = truth.split("truth", frames.len())?;
    let mut owns = own.split("truth", frames.len())?;
    let mut collector = Collector::new(protocol);
    let agents: Vec<Name> = vec![ego.into(), "others".into()];
    for (at, frame) in frames.iter().enumerate() {
        let header = |kind| Header::origin(&"arrays".into(), &agents[0], kind, frame.seq, frame.stamp, frame.stamp);
        let (boxes, points) = truths.remove(&at).unwrap_or_default();
        let own = frame.own_key.map(|key| (key, owns.remove(&at).unwrap_or_default()));
        let own = own.map(|(key, (boxes, points))| {
            let points = points.unwrap_or_default().iter().map(|[own, _]| *own).collect();
            views("truth", &frame.own_views).map(|views| OwnLabels { boxes, points, key, views })
        });
        let truth = GroundTruth {
            boxes,
            agents: agents.clone(),
            points: points.unwrap_or_default().into_flattened(),
            ego_footprint: frame.ego_footprint,
            key: frame.key,
            views: views("truth", &frame.views)?,
            own: own.transpose()?,
        };
        let unscored = |error| refused("truth", error);
        collector.add_truth(&header(Kind::Truth), &truth).map_err(unscored)?;
        if frame.processed {
            let (found, _) = predictions.remove(&at).unwrap_or_default();
            let unscored = |error| refused("predictions", error);
            collector.add_boxes(&header(Kind::Boxes), Boxes(found)).map_err(unscored)?;
        }
    }
    let run = py.detach(|| {
        let mut evaluation = collector.finish();
        evaluation.scenes.iter_mut().for_each(|scene| scene.name = name.into());
        let settings = Settings {
            graph: "recording".into(),
            ego: ego.into(),
            ..Settings::default()
        };
        Run::of_evaluation(settings, evaluation, [])
    });
    Ok(RunFiles::of(run))
}

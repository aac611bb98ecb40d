//! The evaluator on arrays.

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

/// What is scored against what.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Sides {
    predictions: FrameBoxes,
    truth: FrameBoxes,
    own: FrameBoxes,
}

/// Boxes of one frame and the points on each.
type Labelled = (Vec<Box3>, Option<Vec<[u32; 2]>>);

impl FrameBoxes {
    /// By frame.
    fn split(self, argument: &str, frames: usize) -> PyResult<Vec<Labelled>> {
        let (_, boxes) = message_of_boxes(argument, self.boxes)?;
        let places = numbers::<UInt32Type>(argument, self.frame)?;
        let [all, own] = [self.points, self.own_points].map(|points| numbers::<Int64Type>(argument, points));
        let (all, own) = (all?, own?);
        if [places.len(), all.len(), own.len()]
            .iter()
            .any(|len| *len != boxes.len())
        {
            let reason = format!("expected {} numbers a column, one a box", boxes.len());
            return Err(refused(argument, reason));
        }
        let mut split: Vec<Labelled> = (0..frames).map(|_| (Vec::new(), Some(Vec::new()))).collect();
        for (at, object) in boxes.into_iter().enumerate() {
            let Some((boxes, points)) = split.get_mut(places.value(at) as usize) else {
                let reason = format!("expected frames below {frames}, found {}", places.value(at));
                return Err(refused(argument, reason));
            };
            boxes.push(object);
            let counts = (u32::try_from(all.value(at)), u32::try_from(own.value(at)));
            match (points.as_mut(), counts) {
                (Some(known), (Ok(all), Ok(own))) => known.push([own, all.saturating_sub(own)]),
                _ => *points = None,
            }
        }
        Ok(split)
    }
}

fn views(argument: &str, numbers: &[[f64; View::NUMBERS]]) -> PyResult<Vec<View>> {
    let views = numbers.iter().map(View::from_numbers);
    views
        .collect::<Result<_, _>>()
        .map_err(|reason| refused(argument, reason))
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

impl FrameRow {
    fn header(&self, ego: &Name, kind: Kind) -> Header {
        Header::origin(&"arrays".into(), ego, kind, self.seq, self.stamp, self.stamp)
    }

    /// The truth of the frame; `agents` are the ego and, as one, all others.
    fn truth(&self, agents: &[Name], objects: Labelled, own: Labelled) -> PyResult<GroundTruth> {
        let ((boxes, points), (own_boxes, own_points)) = (objects, own);
        let own = self.own_key.map(|key| {
            let points = own_points.unwrap_or_default();
            PyResult::Ok(OwnLabels {
                boxes: own_boxes,
                points: points.iter().map(|[own, _]| *own).collect(),
                key,
                views: views("truth", &self.own_views)?,
            })
        });
        Ok(GroundTruth {
            boxes,
            agents: agents.to_vec(),
            points: points.unwrap_or_default().into_flattened(),
            ego_footprint: self.ego_footprint,
            other_footprints: Vec::new(),
            key: self.key,
            views: views("truth", &self.views)?,
            own: own.transpose()?.map(Box::new),
        })
    }
}

/// Scores boxes against truth: what `realo evaluate` does with a recording and a log.
#[pyfunction]
pub fn evaluate(
    py: Python,
    protocol: &str,
    frames: Vec<FrameRow>,
    sides: Sides,
    name: &str,
    ego: &str,
) -> PyResult<RunFiles> {
    let mut collector = Collector::new(protocol_of(protocol)?);
    let predictions = sides.predictions.split("predictions", frames.len())?;
    let truths = sides.truth.split("truth", frames.len())?;
    let owns = sides.own.split("truth", frames.len())?;
    let agents: Vec<Name> = vec![ego.into(), "others".into()];
    for (((frame, (found, _)), objects), own) in frames.iter().zip(predictions).zip(truths).zip(owns) {
        let truth = frame.truth(&agents, objects, own)?;
        let added = collector.add_truth(&frame.header(&agents[0], Kind::Truth), &truth);
        added.map_err(|error| refused("truth", error))?;
        if frame.processed {
            let added = collector.add_boxes(&frame.header(&agents[0], Kind::Boxes), Boxes(found));
            added.map_err(|error| refused("predictions", error))?;
        }
    }
    Ok(RunFiles::of(py.detach(|| scored(collector, name, ego))))
}

/// The run that `realo evaluate` makes of what was collected.
fn scored(collector: Collector, name: &str, ego: &str) -> Run {
    let mut evaluation = collector.finish();
    evaluation.scenes.iter_mut().for_each(|scene| scene.name = name.into());
    let settings = Settings {
        graph: "recording".into(),
        ego: ego.into(),
        ..Settings::default()
    };
    Run::of_evaluation(settings, evaluation, [])
}

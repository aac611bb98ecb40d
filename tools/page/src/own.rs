//! Whether a recording is the one of the run whose results lie beside it.

use std::path::Path;

use realo_results::Run;
use realo_scoring::{Detection, Frame, Protocol};

use crate::judged::counted;
use crate::recorded::{Recorded, Sweep};
use crate::{OtherRecording, PageError};

/// Sweeps that are compared at most, evenly over the recording.
const MOST: usize = 64;
/// Scores of results are text; they may be so much off.
const NEAR: f32 = 1e-6;

/// Compares the boxes of scored sweeps with those that the results count.
///
/// # Errors
/// [`PageError::OtherRecording`] where they differ.
pub fn check(recording: &Path, run: &Run, recorded: &Recorded) -> Result<(), PageError> {
    let Some(evaluation) = &run.samples.evaluation else {
        return Ok(());
    };
    let ego = &run.result.settings.ego;
    let is_own = |name: &str, of: &str| of == ego && run.result.logs.iter().any(|log| log == name);
    let scenes = evaluation.scenes.iter().filter(|scene| is_own(&scene.name, &scene.ego));
    let frames: Vec<&Frame> = scenes
        .flat_map(|scene| &scene.frames)
        .filter(|frame| frame.key && frame.processed && recorded.sweeps.contains_key(&frame.seq))
        .collect();
    for frame in frames.iter().step_by(frames.len().div_ceil(MOST).max(1)) {
        if let Some([expected, found]) = differs(frame, &recorded.sweeps[&frame.seq], &evaluation.protocol)? {
            return Err(PageError::OtherRecording(Box::new(OtherRecording {
                recording: recording.into(),
                ego: ego.clone(),
                seq: frame.seq,
                expected,
                found,
            })));
        }
    }
    Ok(())
}

/// What is expected of a sweep and what was found, where they differ. What a recording lacks may be cut off.
fn differs(frame: &Frame, sweep: &Sweep, protocol: &Protocol) -> Result<Option<[String; 2]>, PageError> {
    let (Some(truth), Some(boxes)) = (&sweep.truth, &sweep.boxes) else {
        return Ok(None);
    };
    if frame.stamp != truth.0.stamp {
        return Ok(Some(
            [frame.stamp, truth.0.stamp].map(|stamp| format!("the stamp {stamp} ns")),
        ));
    }
    let found = counted(truth, boxes, protocol)?;
    let expected = &frame.detections;
    // Without the ego's outline boxes on itself are among those that are found.
    let same = match truth.1.ego_footprint {
        Some(_) => found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| is_same(a, b)),
        None => expected.iter().all(|a| found.iter().any(|b| is_same(a, b))),
    };
    let words = |detections: &[Detection]| {
        let best = detections.iter().map(|one| one.score).max_by(f32::total_cmp);
        let best = best.map_or(String::new(), |score| format!(", the best of score {score:.4}"));
        format!("{} detections{best}", detections.len())
    };
    Ok((!same).then(|| {
        let [expected, found] = [words(expected), words(&found)];
        match expected == found {
            true => [expected, "as many at other places".into()],
            false => [expected, found],
        }
    }))
}

fn is_same(a: &Detection, b: &Detection) -> bool {
    a.class == b.class && (a.score - b.score).abs() <= NEAR && a.outline == b.outline
}

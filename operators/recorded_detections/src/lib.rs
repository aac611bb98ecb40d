//! The detections that a log recorded, in place of a detector.
//!
//! Boxes that no object can have, such as those without extent or more than 10 km away, are dropped and counted (`invalid_boxes`).

use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::{Box3, Boxes, Header, Kind, PointCloud, geometry};
use serde::{Deserialize, Serialize};

const INVALID_BOXES: Counter = Counter::log_fault(
    "invalid_boxes",
    "boxes dropped: not finite, without extent or above 100 m, more than 10 km away, or with a score outside [0, 1]",
    "recorded detections were left out, because no object can have such numbers",
    realo_schemas::plausible_box!("correct the program that wrote them"),
);

/// Recorded detections have no settings.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {}

/// The boxes that a detector could have found, in their order: those without a [`geometry::detection_fault`].
pub fn sound(boxes: Boxes) -> Boxes {
    let is_sound = |object: &Box3| geometry::detection_fault(object).is_none();
    Boxes(boxes.0.into_iter().filter(is_sound).collect())
}

/// Boxes that belong to no sweep.
#[derive(Debug, thiserror::Error)]
pub enum RecordedError {
    /// They come alone.
    #[error("recorded boxes whose sweep did not come before them")]
    NoSweep,
    /// They are of another time or frame than the sweep of their number.
    #[error("recorded boxes: expected the sweep's {expected}, found {found}")]
    Other {
        /// The sweep's stamp and frame.
        expected: String,
        /// Theirs.
        found: String,
    },
}

/// Replays the detections that the log recorded for each sweep, in place of a detector.
#[derive(Describe)]
#[stage(counters(INVALID_BOXES))]
pub struct RecordedDetections {
    /// Header of the sweep whose boxes come next.
    sweep: Option<Header>,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// Localised sweeps.
    #[port(latest, joined("sweep"))]
    Clouds(Header, PointCloud),
    /// What the log says was detected.
    #[port(latest, joined("sweep"))]
    Recorded(Header, Boxes),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The recorded boxes with the sweep's header and pose.
    Proposals(Header, Boxes),
}

impl Operator for RecordedDetections {
    fn build(_settings: Settings) -> Result<Self, Error> {
        Ok(RecordedDetections { sweep: None })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        match input {
            Input::Clouds(header, _) => self.sweep = Some(header),
            Input::Recorded(recorded, boxes) => {
                let sweep = self.sweep.take();
                let same = |sweep: &Header| (&sweep.agent, sweep.seq) == (&recorded.agent, recorded.seq);
                let sweep = sweep.filter(same).ok_or(RecordedError::NoSweep)?;
                if (recorded.stamp, &recorded.frame) != (sweep.stamp, &sweep.frame) {
                    let expected = format!("stamp {} ns and frame {}", sweep.stamp, sweep.frame);
                    let found = format!("stamp {} ns and frame {}", recorded.stamp, recorded.frame);
                    return Err(RecordedError::Other { expected, found }.into());
                }
                let (before, fault) = (boxes.0.len(), boxes.0.iter().find_map(geometry::detection_fault));
                let boxes = sound(boxes);
                let invalid = (before - boxes.0.len()) as u64;
                out.count_of(&INVALID_BOXES, &recorded.agent, invalid, before as u64);
                if let Some(fault) = fault {
                    out.found(&INVALID_BOXES, &recorded.agent, || format!("the first has {fault}"));
                }
                let header = Header {
                    kind: Kind::Boxes,
                    ..sweep
                };
                out.send(Output::Proposals(header, boxes));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::{Message, Pose};

    use super::*;

    fn header(kind: Kind, seq: u64, stamp: i64) -> Header {
        Header::origin(&"run".into(), &"cav1".into(), kind, seq, stamp, stamp + 50)
    }

    fn object(x: f64) -> Box3 {
        Box3 {
            center: [x, 0.0, 0.0],
            length: 4.0,
            width: 2.0,
            height: 1.5,
            yaw: 0.1,
            velocity: None,
            class: "Car".into(),
            score: 1.0,
            track: None,
            covariance: None,
        }
    }

    fn sweep() -> Message {
        let pose = Pose::from_parts([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]);
        Message::new(
            Header {
                pose,
                ..header(Kind::Points, 4, 100)
            },
            PointCloud::empty(),
        )
    }

    #[test]
    fn recorded_boxes_get_the_sweeps_header_and_bad_ones_are_dropped() {
        let flat = Box3 {
            height: 0.0,
            ..object(1.0)
        };
        let nan = Box3 {
            yaw: f64::NAN,
            ..object(1.0)
        };
        let fast = Box3 {
            velocity: Some([f64::NAN; 3]),
            ..object(1.0)
        };
        let certain = Box3 {
            score: f32::NAN,
            ..object(1.0)
        };
        let far = object(1e30);
        let recorded = Boxes(vec![flat, object(2.0), nan, fast, certain, object(3.0), far]);
        let mut operator = RecordedDetections::new(Settings {}).unwrap();
        let mut out = Outputs::at(150);
        operator.on_message(Input::CLOUDS, sweep(), &mut out).unwrap();
        operator
            .on_message(
                Input::RECORDED,
                Message::new(header(Kind::Boxes, 4, 100), recorded),
                &mut out,
            )
            .unwrap();
        let expected = Header {
            kind: Kind::Boxes,
            ..sweep().header
        };
        assert_eq!(
            out.take_sent(),
            [(
                Output::PROPOSALS,
                Message::new(expected, Boxes(vec![object(2.0), object(3.0)]))
            )]
        );
        assert_eq!(out.counted("invalid_boxes"), 5);
    }

    #[test]
    fn refuses_boxes_of_another_sweep() {
        let mut operator = RecordedDetections::new(Settings {}).unwrap();
        let mut out = Outputs::at(150);
        let boxes = |seq, stamp| Message::new(header(Kind::Boxes, seq, stamp), Boxes::default());
        assert!(operator.on_message(Input::RECORDED, boxes(4, 100), &mut out).is_err());
        operator.on_message(Input::CLOUDS, sweep(), &mut out).unwrap();
        assert!(operator.on_message(Input::RECORDED, boxes(5, 100), &mut out).is_err());
        operator.on_message(Input::CLOUDS, sweep(), &mut out).unwrap();
        let error = operator
            .on_message(Input::RECORDED, boxes(4, 101), &mut out)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("stamp 100 ns") && error.contains("stamp 101 ns"),
            "{error}"
        );
        assert_eq!(out.take_sent(), []);
    }
}

//! From BEV maps to boxes: the heads of a PointPillars model, decoded.

use std::path::PathBuf;

use realo_bev::counters::OVER_LIMIT_BOXES;
use realo_bev::{Computing, Decoder, Engine, Maps};
use realo_nn::anchors::Anchors;
use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::{Boxes, Elements, FeatureMap, Header, Kind};
use serde::{Deserialize, Serialize};

/// Settings of [`DetectionHead`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// The model file; its weights are in the same folder.
    #[setting(default = "../models/lite.toml", role = "model", filled)]
    pub model: PathBuf,
    /// Min score of a box; null: the model's.
    #[setting(range = 0.0..=1.0)]
    pub score_threshold: Option<f32>,
    /// How the network is computed.
    #[setting(flatten)]
    #[serde(flatten)]
    pub computing: Computing,
}

/// Finds boxes in BEV maps: the heads of a PointPillars model, decoded.
#[derive(Describe)]
#[stage(counters(OVER_LIMIT_BOXES, INVALID_BOXES))]
pub struct DetectionHead {
    engine: Engine,
    decoder: Decoder,
    maps: Maps,
}

const INVALID_BOXES: Counter = Counter::loss(
    "invalid_boxes",
    "decoded boxes dropped: not finite, without extent or above 100 m, or with a score outside [0, 1]",
    "decoded boxes were left out, because they are not finite, or have no size or one above 100 m",
    "the network makes such boxes: look at its weights, or train it again",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// BEV maps of the model.
    #[port(latest)]
    Features(Header, FeatureMap),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// Detections, best first.
    Proposals(Header, Boxes),
}

impl Operator for DetectionHead {
    fn build(settings: Settings) -> Result<Self, Error> {
        let loaded = settings.computing.load(&settings.model)?;
        let threshold = settings.score_threshold.unwrap_or(loaded.model.score_threshold);
        Ok(DetectionHead {
            decoder: Decoder::new(Anchors::of(&loaded.model), threshold),
            maps: Maps::of(&loaded),
            engine: Engine::new(loaded, settings.computing.device, Elements::F32)?,
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Input::Features(header, map) = input;
        let heads = self.engine.heads(self.maps.read(&map)?.view(), out.steps())?;
        let found = self.decoder.decode(&heads.scores, &heads.deltas);
        let all = found.boxes.len() as u64 + found.over_limit + found.invalid;
        out.count(&OVER_LIMIT_BOXES, &header.agent, found.over_limit);
        out.count_of(&INVALID_BOXES, &header.agent, found.invalid, all);
        let boxes = found.boxes;
        let header = Header {
            kind: Kind::Boxes,
            ..header
        };
        out.send(Output::Proposals(header, Boxes(boxes)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use realo_schemas::geometry::is_valid;
    use realo_schemas::{Box3, DType, Message};

    const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/lite.toml");

    fn head(score_threshold: Option<f32>) -> Result<DetectionHead, Error> {
        DetectionHead::new(Settings {
            model: MODEL.into(),
            score_threshold,
            ..Settings::default()
        })
    }

    /// A map of the model with one value in all cells.
    fn map(value: f32) -> FeatureMap {
        let [rows, columns, channels] = [100, 256, 64];
        let values = vec![value; rows * columns * channels];
        FeatureMap {
            rows: rows as u32,
            columns: columns as u32,
            channels: channels as u32,
            cell: 0.8,
            origin: [-102.4, -40.0],
            dtype: DType::F32,
            data: values
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect::<Vec<u8>>()
                .into(),
            model: realo_methods::load(MODEL.as_ref(), realo_methods::Kernels::auto(1))
                .unwrap()
                .identity
                .as_str()
                .into(),
            confidence: None,
        }
    }

    fn detected(head: &mut DetectionHead, map: FeatureMap) -> Result<(Vec<Box3>, u64), Error> {
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Features, 7, 11, 13);
        let mut out = Outputs::at(13);
        head.on_message(Input::FEATURES, Message::new(header, map), &mut out)?;
        let over = out.counted("over_limit_boxes");
        let (port, message) = out.take_sent().remove(0);
        let (header, boxes): (Header, Boxes) = message.into_parts().unwrap();
        assert_eq!(
            (port, header.kind, header.seq, header.stamp),
            (Output::PROPOSALS, Kind::Boxes, 7, 11)
        );
        Ok((boxes.0, over))
    }

    #[test]
    fn boxes_come_best_first_and_at_most_so_many() {
        let (boxes, over) = detected(&mut head(Some(0.0)).unwrap(), map(0.0)).unwrap();
        assert_eq!(boxes.len(), Decoder::MOST);
        assert_eq!(
            over,
            100 * 256 * 6 - Decoder::MOST as u64,
            "six anchors in each cell, all above 0"
        );
        assert!(boxes.windows(2).all(|pair| pair[0].score >= pair[1].score));
        assert!(boxes.iter().all(is_valid));
        let (boxes, over) = detected(&mut head(Some(0.999)).unwrap(), map(0.0)).unwrap();
        assert_eq!((boxes.len(), over), (0, 0), "an even map shows nothing");
    }

    #[test]
    fn maps_that_do_not_fit_are_refused_with_what_is_expected() {
        let mut head = head(None).unwrap();
        let other = FeatureMap {
            model: "other-0".into(),
            ..map(0.0)
        };
        let error = detected(&mut head, other).unwrap_err().to_string();
        assert!(error.contains("lite-") && error.contains("other-0"), "{error}");
        let half = FeatureMap {
            dtype: DType::F16,
            ..map(0.0)
        };
        let error = detected(&mut head, half).unwrap_err().to_string();
        assert!(error.contains("expected a map of f32"), "{error}");
        let narrow = FeatureMap {
            columns: 128,
            data: map(0.0).data.slice_with_length(0, 100 * 128 * 64 * 4),
            ..map(0.0)
        };
        let error = detected(&mut head, narrow).unwrap_err().to_string();
        assert!(error.contains("128 columns"), "{error}");
        assert!(
            detected(&mut head, map(f32::NAN)).unwrap().0.is_empty(),
            "what is no number is no box"
        );
    }

    #[test]
    fn a_threshold_that_no_score_has_is_refused() {
        let error = head(Some(1.5)).err().expect("refused").to_string();
        assert!(error.contains("`score_threshold`") && error.contains("1.5"), "{error}");
        assert!(head(Some(1.0)).is_ok(), "the end of the range is in it");
    }
}

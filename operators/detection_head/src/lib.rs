//! From BEV maps to boxes: the heads of a PointPillars model, decoded.
//!
//! | port | direction | types | meaning |
//! |---|---|---|---|
//! | `features` | in, latest | FeatureMap | BEV maps of the same model, f32 |
//! | `boxes` | out | Boxes | what scores more than the threshold, best first, in the map's frame; duplicates stay for `nms` |
//!
//! | counter | meaning |
//! |---|---|
//! | `over_limit_boxes` | boxes above the threshold beyond the 1,000 best |
//! | `invalid_boxes` | decoded boxes with numbers that are not finite |

use std::path::PathBuf;

use realo_bev::{Decoder, Device, Engine, Maps};
use realo_methods::Kernels;
use realo_nn::anchors::Anchors;
use realo_operator::{
    Argument, Counter, Decided, Describe, Error, Operator, Outputs, Port, PortId, unexpected, wrong_port,
};
use realo_schemas::{Boxes, Elements, FeatureMap, Header, Kind, Message, PayloadType};
use serde::{Deserialize, Serialize};

/// Settings of [`DetectionHead`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The model file; its weights lie beside it.
    pub model: PathBuf,
    /// Smallest score; `None`: the model's.
    pub score_threshold: Option<f32>,
    /// Kernels: `auto`, or one of [`realo_kernels::conv::Isa`] that this processor has.
    pub isa: String,
    /// Number type: `auto` for the model's, or one of [`realo_nn::model::Precision`].
    pub precision: String,
    /// Threads of the convolutions; 0: one for each processor.
    pub threads: usize,
    /// What computes the network.
    pub device: Device,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            model: "../models/lite.toml".into(),
            score_threshold: None,
            isa: realo_methods::AUTO.into(),
            precision: realo_methods::AUTO.into(),
            threads: 0,
            device: Device::default(),
        }
    }
}

/// The operator `detection-head`.
pub struct DetectionHead {
    engine: Engine,
    decoder: Decoder,
    maps: Maps,
}

const FEATURES: PortId = PortId(0);
const BOXES: PortId = PortId(0);

const OVER_LIMIT_BOXES: Counter = Counter::plain(
    "over_limit_boxes",
    "detections above the min score, but not among the best 1,000",
);
const INVALID_BOXES: Counter = Counter::loss(
    "invalid_boxes",
    "decoded boxes dropped: not finite, without extent or above 100 m, or with a score outside [0, 1]",
    "decoded boxes were left out, because they are not finite, or have no size or one above 100 m",
    "the network makes such boxes: look at its weights, or train it again",
);

impl Describe for DetectionHead {
    type Config = Config;
    const NAME: &'static str = "detection-head";
    const ABOUT: &'static str = "From BEV maps to boxes: the heads of a PointPillars model, decoded";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "model",
            about: "the model file; its weights lie beside it",
        },
        Argument {
            name: "score_threshold",
            about: "min score of a box; null: the model's",
        },
        realo_bev::ISA,
        realo_bev::PRECISION,
        realo_bev::THREADS,
        realo_bev::DEVICE,
    ];
    const INPUTS: &'static [Port] =
        &[Port::new("features", &[PayloadType::FeatureMap], "BEV maps of the model").latest()];
    const OUTPUTS: &'static [Port] = &[Port::new("proposals", &[PayloadType::Boxes], "detections, best first")];
    const COUNTERS: &'static [Counter] = &[OVER_LIMIT_BOXES, INVALID_BOXES];
    const DECIDED: &'static [(Decided, &'static str)] = &[
        (Decided::Model, "model"),
        (Decided::Isa, "isa"),
        (Decided::Precision, "precision"),
        (Decided::Device, "device"),
    ];
}

impl Operator for DetectionHead {
    fn new(config: Config) -> Result<Self, Error> {
        let kernels = Kernels {
            isa: &config.isa,
            precision: &config.precision,
            threads: config.threads,
        };
        let loaded = realo_methods::load(&config.model, kernels)?;
        let threshold = config.score_threshold.unwrap_or(loaded.model.score_threshold);
        if !(0.0..1.0).contains(&threshold) {
            return Err(format!("argument `score_threshold`: expected 0 to 1, found {threshold}").into());
        }
        Ok(DetectionHead {
            decoder: Decoder::new(Anchors::of(&loaded.model), threshold),
            maps: Maps::of(&loaded),
            engine: Engine::new(loaded, config.device, Elements::F32)?,
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        if port != FEATURES {
            return Err(wrong_port(Self::INPUTS, port));
        }
        let (header, map): (Header, FeatureMap) = message.into_parts().map_err(unexpected)?;
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
        out.send(BOXES, Message::new(header, Boxes(boxes)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use realo_schemas::geometry::is_valid;
    use realo_schemas::{Box3, DType};

    const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/lite.toml");

    fn head(score_threshold: Option<f32>) -> Result<DetectionHead, Error> {
        DetectionHead::new(Config {
            model: MODEL.into(),
            score_threshold,
            ..Config::default()
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
            model: realo_methods::load(MODEL.as_ref(), Kernels::auto(1))
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
        head.on_input(FEATURES, Message::new(header, map), &mut out)?;
        let over = out.counted("over_limit_boxes");
        let (port, message) = out.take_sent().remove(0);
        let (header, boxes): (Header, Boxes) = message.into_parts().unwrap();
        assert_eq!(
            (port, header.kind, header.seq, header.stamp),
            (BOXES, Kind::Boxes, 7, 11)
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
    fn arguments_are_checked_and_are_the_keys_of_the_configuration() {
        let error = head(Some(1.5)).err().expect("refused").to_string();
        assert!(error.contains("`score_threshold`") && error.contains("1.5"), "{error}");
        let keys: Vec<String> = realo_operator::config::defaults::<Config>().keys().cloned().collect();
        let reported: Vec<&str> = DetectionHead::ARGUMENTS.iter().map(|argument| argument.name).collect();
        assert_eq!(keys, reported);
    }
}

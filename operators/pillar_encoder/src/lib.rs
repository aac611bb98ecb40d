//! From sweeps to BEV maps: pillars, the pillar net and the backbone of a PointPillars model.
//!
//! An agent's own fusion takes `own`. Others get `features`, which is the same map unless the model compresses what crosses and fuses the
//! agent's own map whole (`arch.compress_own = false`).
//!
//! With `confidence=true` the model's head reads the map as well, and what it thinks of each cell goes with the map: a
//! `transmission-encoder` may then send the cells that matter.
//!
//! A sweep without points in range gives the map of an empty canvas.

use std::path::PathBuf;

use realo_bev::counters::{EMPTY_SWEEPS, OVER_POINTS, count_empty};
use realo_bev::{Computing, Engine, Maps, known_map};
use realo_kernels::bev::BevView;
use realo_methods::Pillarer;
use realo_methods::detect::pillars::{Dropped, Points};
use realo_operator::{Counter, Describe, Error, Inputs, KnownMap, Operator, Outputs, Settings, Steps};
use realo_schemas::{Elements, FeatureMap, Header, Kind, PointCloud};
use serde::{Deserialize, Serialize};

/// Settings of [`PillarEncoder`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// The model file; its weights are in the same folder.
    #[setting(default = "../models/lite.toml", role = "model", filled)]
    pub model: PathBuf,
    /// How the network is computed.
    #[setting(flatten)]
    #[serde(flatten)]
    pub computing: Computing,
    /// Whether maps hold the confidence of each cell, by which `transmission-encoder` can choose.
    pub confidence: bool,
    /// What numbers of an agent's own maps leave a GPU as, from which compressed ones are made: `f32`, `f16`, or `int8` with a scale for each channel of each map.
    pub copied: Elements,
}

/// Makes BEV maps of sweeps: pillars, pillar net and backbone of a PointPillars model.
#[derive(Describe)]
#[stage(counters(EMPTY_SWEEPS, NAN_POINTS, OUT_OF_RANGE_POINTS, OVER_POINTS, OVER_PILLARS), maps = maps)]
pub struct PillarEncoder {
    pillarer: Pillarer,
    engine: Engine,
    maps: Maps,
    confidence: bool,
}

const NAN_POINTS: Counter = Counter::plain("nan_points", "points left out: not finite");
const OUT_OF_RANGE_POINTS: Counter = Counter::plain("out_of_range_points", "points left out: outside the model's grid");
const OVER_PILLARS: Counter = Counter::loss(
    "over_pillars",
    "points left out: of pillars beyond the max number of pillars",
    "points were left out, because the model takes no more pillars (`pillars.pillars` of its file)",
    "take a model file with more pillars, or fewer collaborators (`max_collaborators` of a fusion of points)",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// Sweeps in the agent's body frame.
    #[port(latest)]
    Clouds(Header, PointCloud),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// BEV maps as agents share them.
    Features(Header, FeatureMap),
    /// BEV maps for the agent's own fusion.
    Own(Header, FeatureMap),
}

/// The sizes of the maps that it sends.
fn maps(settings: &Settings) -> Vec<(&'static str, KnownMap)> {
    let own = known_map(&settings.model, |layers| layers.kept);
    let shared = known_map(&settings.model, |layers| layers.features);
    let named = [("own", own), ("features", shared)].into_iter();
    named.filter_map(|(name, map)| Some((name, map?))).collect()
}

impl Operator for PillarEncoder {
    fn build(settings: Settings) -> Result<Self, Error> {
        let loaded = settings.computing.load(&settings.model)?;
        loaded.model.check_frame(&settings.model)?;
        Ok(PillarEncoder {
            maps: Maps::of(&loaded),
            confidence: settings.confidence,
            pillarer: Pillarer::beside(&loaded.network, &loaded.model, &loaded.weights),
            engine: Engine::new(loaded, settings.computing.device, settings.copied)?,
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Input::Clouds(header, cloud) = input;
        let (Encoded { own, shared }, dropped) = self.encode(&cloud, out.steps())?;
        let agent = header.agent.clone();
        let unusable = dropped.not_finite + dropped.out_of_range;
        let is_empty = unusable == cloud.len() as u64;
        count_empty(out, &agent, cloud.len(), is_empty);
        out.count(&NAN_POINTS, &agent, dropped.not_finite);
        out.count(&OUT_OF_RANGE_POINTS, &agent, dropped.out_of_range);
        out.count(&OVER_POINTS, &agent, dropped.over_points);
        out.count_of(&OVER_PILLARS, &agent, dropped.over_pillars, cloud.len() as u64);
        let header = Header {
            kind: Kind::Features,
            ..header
        };
        out.send(Output::Own(header.clone(), own));
        out.send(Output::Features(header, shared));
        Ok(())
    }
}

/// Maps of one sweep.
struct Encoded {
    own: FeatureMap,
    shared: FeatureMap,
}

impl PillarEncoder {
    /// The BEV maps of a cloud in the agent's body frame, and which points they leave out.
    fn encode(&mut self, cloud: &PointCloud, steps: &mut Steps) -> Result<(Encoded, Dropped), Error> {
        let intensity: Option<Vec<f32>> = self
            .pillarer
            .wants_intensity()
            .then(|| cloud.intensity.iter().map(|value| f32::from(*value) / 255.0).collect());
        let points = Points {
            x: &cloud.x,
            y: &cloud.y,
            z: &cloud.z,
            intensity: intensity.as_deref(),
        };
        let (canvas, dropped) = self.pillarer.run(&points);
        let own = self.engine.encode_own(canvas, steps)?;
        let confidence = match self.confidence {
            true => Some(self.engine.confidence(BevView::from(&own), steps)?.into()),
            false => None,
        };
        let shared = self.engine.share(BevView::from(&own), steps)?;
        let written = |map| FeatureMap {
            confidence: confidence.clone(),
            ..self.maps.write(map)
        };
        let own = written(own);
        let shared = shared.map_or_else(|| own.clone(), written);
        Ok((Encoded { own, shared }, dropped))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use realo_operator::PortId;
    use realo_schemas::Message;

    fn encoder() -> PillarEncoder {
        let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/lite.toml");
        PillarEncoder::new(Settings {
            model: model.into(),
            ..Settings::default()
        })
        .unwrap()
    }

    /// The map of points and the counts of those left out: nan, out of range, over points.
    fn encoded(encoder: &mut PillarEncoder, points: &[[f32; 3]]) -> (Header, FeatureMap, [u64; 3]) {
        let axis = |i: usize| points.iter().map(|point| point[i]).collect::<Vec<_>>();
        let n = points.len();
        let cloud = PointCloud::new(axis(0), axis(1), axis(2), vec![0; n], vec![0; n], vec![0; n]).unwrap();
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Points, 7, 11, 13);
        let mut out = Outputs::at(13);
        encoder
            .on_message(Input::CLOUDS, Message::new(header, cloud), &mut out)
            .unwrap();
        let counted = ["nan_points", "out_of_range_points", "over_points"].map(|counter| out.counted(counter));
        let mut sent = out.take_sent().into_iter();
        let mut next = |expected: PortId| -> (Header, FeatureMap) {
            let (port, message) = sent.next().unwrap();
            assert_eq!(port, expected);
            message.into_parts().unwrap()
        };
        let (own, (header, map)) = (next(Output::OWN), next(Output::FEATURES));
        assert!(own == (header.clone(), map.clone()), "nothing is compressed");
        (header, map, counted)
    }

    #[test]
    fn an_empty_sweep_and_one_without_usable_points_give_the_map_of_an_empty_canvas() {
        let mut encoder = encoder();
        let (header, empty, counted) = encoded(&mut encoder, &[]);
        assert_eq!((header.kind, header.seq, header.stamp), (Kind::Features, 7, 11));
        assert_eq!(
            (empty.rows, empty.columns, empty.channels, empty.cell),
            (100, 256, 64, 0.8)
        );
        assert_eq!((empty.origin, counted), ([-102.4, -40.0], [0; 3]));

        // Left out: 102.4 is outside already.
        let (_, map, counted) = encoded(&mut encoder, &[[f32::NAN, 0.0, 0.0], [102.4, 0.0, 0.0]]);
        assert_eq!((map == empty, counted), (true, [1, 1, 0]));

        let (_, map, counted) = encoded(&mut encoder, &[[5.1, 0.1, 0.5]; 40]);
        assert_eq!((map == empty, counted), (false, [0, 0, 8]), "a pillar takes 32 points");
        assert!(
            encoded(&mut encoder, &[]).1 == empty,
            "nothing stays of the sweep before"
        );
    }

    #[test]
    fn how_sure_it_is_goes_with_the_map_where_it_is_asked_for() {
        let points: Vec<[f32; 3]> = (0..400)
            .map(|k| [10.0 + 0.22 * (k % 20) as f32, 4.0, 0.1 + 0.07 * (k / 20) as f32])
            .collect();
        let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/lite.toml");
        let mut asked = PillarEncoder::new(Settings {
            model: model.into(),
            confidence: true,
            ..Settings::default()
        })
        .unwrap();
        let (_, silent, _) = encoded(&mut encoder(), &points);
        let (_, map, _) = encoded(&mut asked, &points);
        assert_eq!((silent.confidence.is_none(), &silent.data), (true, &map.data));
        let confidence = map.confidence.expect("asked for");
        assert_eq!(confidence.len(), 100 * 256);
        assert!(
            confidence
                .iter()
                .all(|confidence| *confidence > 0.0 && *confidence < 1.0)
        );
        let surest = (0..confidence.len()).max_by(|a, b| confidence[*a].total_cmp(&confidence[*b]));
        let surest = surest.expect("cells");
        let place = [surest % 256, surest / 256].map(|cell| (cell as f64 + 0.5) * map.cell);
        let near = (place[0] + map.origin[0] - 12.0).abs() < 4.0 && (place[1] + map.origin[1] - 4.0).abs() < 3.0;
        assert!(near, "{place:?} of a wall of points from 10 to 14 m, 4 m to the left");
    }

    #[test]
    fn refuses_other_inputs_and_kernels_that_are_unknown() {
        let features = encoded(&mut encoder(), &[]);
        let message = Message::new(features.0, features.1);
        assert!(
            encoder()
                .on_message(Input::CLOUDS, message.clone(), &mut Outputs::at(0))
                .is_err()
        );
        assert!(encoder().on_message(PortId(1), message, &mut Outputs::at(0)).is_err());
        let error = PillarEncoder::new(Settings {
            computing: Computing {
                isa: "sse9".into(),
                ..Computing::default()
            },
            ..Settings::default()
        });
        assert!(error.is_err());
    }

    #[test]
    fn settings_name_all_instructions_and_number_types() {
        let isas = realo_kernels::conv::Isa::ALL.map(|isa| isa.to_string());
        let precisions = realo_nn::model::Precision::ALL.map(|precision| precision.to_string());
        for (setting, names) in [("isa", &isas[..]), ("precision", &precisions[..])] {
            let mut settings = <Settings as realo_operator::StageSettings>::SETTINGS.iter();
            let about = settings.find(|known| known.name == setting).expect("is there").about;
            for name in names {
                assert!(about.contains(&format!("`{name}`")), "{about}: {name}");
            }
        }
    }
}

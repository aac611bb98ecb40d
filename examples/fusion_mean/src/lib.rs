//! Intermediate fusion: in each cell the mean of the agents' features, weighted by how strong they are.

use realo_fusion::{Input, Maps, Pairing};
use realo_operator::{Describe, Error, Operator, Outputs, Settings};
use realo_schemas::{FeatureMap, Header};
use serde::{Deserialize, Serialize};

/// Settings of [`FusionMean`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Power of the length of a cell's features; it is an agent's weight there; 0: all count alike.
    #[setting(default = 4.0, range = 0.0..=16.0)]
    pub power: f64,
}

/// The mean of each cell's features over the agents whose maps cover it, `[rows, columns, channels]`.
pub fn mean(maps: &Maps, power: f64) -> Vec<f32> {
    let [_, columns, channels] = maps.size;
    let weight = |features: &[f32]| {
        let energy: f64 = features.iter().map(|feature| f64::from(*feature).powi(2)).sum();
        energy.powf(0.5 * power)
    };
    let (mut fused, mut theirs) = (maps.ego.to_vec(), vec![0.0; channels]);
    for (cell, to) in fused.chunks_exact_mut(channels).enumerate() {
        let mut sum = weight(to);
        for map in &maps.others {
            if !map.features_at(cell / columns, cell % columns, &mut theirs) {
                continue;
            }
            let added = weight(&theirs);
            sum += added;
            // Nothing anywhere leaves nothing.
            let share = if sum > 0.0 { (added / sum) as f32 } else { 0.0 };
            to.iter_mut()
                .zip(&theirs)
                .for_each(|(to, feature)| *to += (feature - *to) * share);
        }
    }
    fused
}

/// Intermediate fusion: the mean of features, weighted by how strong they are.
#[derive(Describe)]
#[stage(input = Input<FeatureMap>, counters = realo_fusion::COUNTERS)]
pub struct FusionMean {
    power: f64,
    pairing: Pairing<FeatureMap>,
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// One map for the head.
    Features(Header, FeatureMap),
}

impl Operator for FusionMean {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(FusionMean {
            power: settings.power,
            pairing: Pairing::default(),
        })
    }

    fn on_input(&mut self, input: Input<FeatureMap>, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Some(mut set) = self.pairing.take(input, None)? else {
            return Ok(());
        };
        let fused = mean(&set.maps()?, self.power);
        let fused = set.ego.with_numbers(fused);
        set.send(Output::Features, fused, out);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use realo_engine::testkit::FusionCase;
    use realo_schemas::{DType, Kind, Message, Pose};

    use super::*;

    fn map(features: [f32; 2]) -> FeatureMap {
        let one = FeatureMap {
            rows: 3,
            columns: 4,
            channels: 2,
            cell: 1.0,
            origin: [-2.0, -1.5],
            dtype: DType::F32,
            data: Vec::<u8>::new().into(),
            model: "lite-1".into(),
            confidence: None,
        };
        one.with_numbers(features.repeat(12))
    }

    /// A message of an agent so many metres ahead of the ego.
    fn message(agent: &str, ahead: f64, features: [f32; 2]) -> Message {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Features, 0, 50, 80);
        header.pose = Pose::from_parts([ahead, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]);
        Message::new(header, map(features))
    }

    #[test]
    fn holds_what_every_fusion_owes_its_graph() {
        let case = FusionCase {
            args: vec!["power=2".into()],
            ego: message("cav1", 0.0, [1.0, 0.5]),
            entries: vec![message("cav2", 1.0, [0.3, 0.1]), message("rsu1", -0.4, [0.0, 2.0])],
            alone: map([1.0, 0.5]).into(),
        };
        case.check::<FusionMean>();
    }

    #[test]
    fn the_stronger_features_count_more_where_both_see() {
        let fused = |power: f64| {
            let mut pairing = Pairing::default();
            let ego = message("cav1", 0.0, [3.0, 4.0]);
            let selection = realo_schemas::Selection {
                query: 0,
                entries: vec![message("cav2", 2.0, [10.0, 0.0])],
            };
            let selection = Input::Selections(ego.header.clone(), selection);
            let (header, own) = ego.into_parts::<FeatureMap>().unwrap();
            assert!(pairing.take(Input::Ego(header, own), None).unwrap().is_none());
            let mut set = pairing.take(selection, None).unwrap().unwrap();
            mean(&set.maps().unwrap(), power)
        };
        let cells = |of: [f32; 2]| [[3.0, 4.0], [3.0, 4.0], of, of].concat().repeat(3);
        assert_eq!(fused(0.0), cells([6.5, 2.0]), "all alike");
        let found = fused(2.0);
        let expected = cells([3.0 + 7.0 * 0.8, 4.0 - 4.0 * 0.8]);
        assert!(
            found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5),
            "{found:?}"
        );
    }

    #[test]
    fn refuses_a_power_that_is_none() {
        let error = |power| FusionMean::new(Settings { power }).err().map(|error| error.to_string());
        assert_eq!(error(16.0), None);
        for power in [-1.0, 17.0, f64::NAN] {
            assert!(error(power).unwrap().contains("expected 0 to 16, found"), "{power}");
        }
    }
}

//! Intermediate fusion: brings the BEV maps of selected collaborators to the ego's and fuses them, as the model's `arch`
//! says.
//!
//! Maps of another model, size or place, and maps with numbers that are none are rejected, with an error that says why; the
//! others are fused. A collaborator's map is turned
//! and shifted as the ground moves from its frame at its stamp to the ego's at the ego's; in cells that it does not cover
//! the collaborator takes no part, nor in those that it left out (`confidence`). V2X-ViT also looks at who is a roadside unit and at how many whole frames of 0.1 s a map
//! is old. The motion of objects between the stamps is not removed.

use std::path::PathBuf;

use nalgebra::Isometry3;
use realo_bev::{Computing, Engine, Maps, Read, known_map};
use realo_fusion::{Collaborator, Input, Pairing};
use realo_kernels::agents::Agent;
use realo_kernels::warp::Warp;
use realo_nn::layers::Layers;
use realo_operator::{Describe, Error, KnownMap, Operator, Outputs, Settings};
use realo_schemas::{Elements, FeatureMap, Header, Name, Nanos};
use serde::{Deserialize, Serialize};

/// Settings of [`FusionFeatures`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// The model file, whose arch fuses; its weights are in the same folder.
    #[setting(default = "../models/lite-attfuse.toml", role = "model", filled)]
    pub model: PathBuf,
    /// Collaborators that a fusion takes, the nearest to the ego; null = as many as the model takes.
    pub max_collaborators: Option<usize>,
    /// Agents that are roadside units, by name, separated by commas; others are vehicles.
    #[setting(role = "roadside")]
    pub roadside: String,
    /// How the network is computed.
    #[setting(flatten)]
    #[serde(flatten)]
    pub computing: Computing,
}

/// Why feature maps are not fused.
#[derive(Debug, thiserror::Error)]
pub enum FeatureError {
    /// The model is of one agent.
    #[error(
        "{}: `arch`: expected one that fuses, found `{arch}`: take a graph without fusion-features, or a model that extends this one \
         with another `arch`, as models/lite-attfuse.toml does", .model.display()
    )]
    Alone {
        /// Its file.
        model: PathBuf,
        /// Its method.
        arch: String,
    },
    /// More collaborators than the model takes.
    #[error(
        "setting `max_collaborators`: expected at most {most}, as many as `arch.agents` of {} leaves, found {found}",
        .model.display()
    )]
    Limit {
        /// Its file.
        model: PathBuf,
        /// As many as it takes.
        most: usize,
        /// As many as were asked for.
        found: usize,
    },
    /// Maps of collaborators that do not fit; the others were fused.
    #[error("{0}")]
    Refused(String),
}

/// Intermediate fusion: brings collaborators' BEV maps to the ego's and fuses them.
#[derive(Describe)]
#[stage(input = Input<FeatureMap>, counters = realo_fusion::COUNTERS, maps = maps)]
pub struct FusionFeatures {
    engine: Engine,
    maps: Maps,
    /// Rows, columns and channels of the maps that agents share.
    shared: [usize; 3],
    /// Collaborators that a fusion takes.
    limit: usize,
    roadside: Vec<Name>,
    pairing: Pairing<FeatureMap>,
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// One map for the heads, in the ego's frame.
    Features(Header, FeatureMap),
}

/// The size of the map that it sends.
fn maps(settings: &Settings) -> Vec<(&'static str, KnownMap)> {
    let fused = known_map(&settings.model, |layers| layers.fused);
    fused.into_iter().map(|map| ("features", map)).collect()
}

impl Operator for FusionFeatures {
    fn build(settings: Settings) -> Result<Self, Error> {
        let loaded = settings.computing.load(&settings.model)?;
        let most = loaded.model.arch.agents() - 1;
        if !loaded.model.arch.fuses() {
            return Err(FeatureError::Alone {
                model: settings.model,
                arch: loaded.model.arch.to_string(),
            }
            .into());
        }
        let limit = settings.max_collaborators.unwrap_or(most);
        if limit > most {
            return Err(FeatureError::Limit {
                model: settings.model,
                most,
                found: limit,
            }
            .into());
        }
        let layers = Layers::of(&loaded.model);
        Ok(FusionFeatures {
            maps: Maps::of(&loaded),
            shared: layers.size(layers.features),
            engine: Engine::new(loaded, settings.computing.device, Elements::F32)?,
            limit,
            roadside: settings
                .roadside
                .split(',')
                .filter(|name| !name.is_empty())
                .map(Name::from)
                .collect(),
            pairing: Pairing::default(),
        })
    }

    fn on_input(&mut self, input: Input<FeatureMap>, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Some(mut set) = self.pairing.take(input, Some(self.limit))? else {
            return Ok(());
        };
        let mut refused = Vec::new();
        set.reject(|collaborator| {
            let reason = self.refusal(&collaborator.payload);
            refused.extend(reason.iter().map(|reason| format!("{}: {reason}", collaborator.header)));
            reason.is_some()
        });
        let ego = self.maps.read(&set.ego)?;
        let others = set.collaborators.iter();
        let others: Vec<(&Collaborator<FeatureMap>, Read)> = others
            .filter_map(|collaborator| Some((collaborator, self.maps.read(&collaborator.payload).ok()?)))
            .collect();
        let mut agents = vec![Agent {
            roadside: self.roadside.contains(&set.header.agent),
            ..Agent::beside(ego.view())
        }];
        agents.extend(others.iter().map(|(collaborator, map)| Agent {
            map: map.view(),
            confidence: map.confidence(),
            warp: self.warp(collaborator),
            roadside: self.roadside.contains(&collaborator.header.agent),
            delay: frames(set.header.stamp - collaborator.header.stamp),
        }));
        let fused = self.maps.write(self.engine.fuse(&agents, out.steps())?);
        set.send(Output::Features, fused, out);
        if !refused.is_empty() {
            return Err(FeatureError::Refused(refused.join("; ")).into());
        }
        Ok(())
    }
}

impl FusionFeatures {
    /// Why a collaborator's map cannot be fused; `None` if it can.
    fn refusal(&self, map: &FeatureMap) -> Option<String> {
        let map = match self.maps.read(map) {
            Ok(map) => map,
            Err(error) => return Some(error.to_string()),
        };
        let (expected, found) = (self.shared, map.size());
        if found != expected {
            return Some(format!(
                "expected {expected:?} rows, columns and channels, as maps of this model have that agents share, found {found:?}"
            ));
        }
        (!map.is_sound())
            .then(|| "expected numbers as a network makes them, found one that is none, or beyond 1e15".into())
    }

    fn warp(&self, collaborator: &Collaborator<FeatureMap>) -> Warp {
        let ground = ground(&collaborator.ego_from_sender.inverse());
        Warp::of_ground(ground, self.maps.origin, self.maps.cell)
    }
}

/// Whole frames of 0.1 s; none for what lies ahead.
fn frames(time: Nanos) -> usize {
    usize::try_from(time / FRAME).unwrap_or(0)
}

const FRAME: Nanos = 100_000_000;

/// How a transform moves the ground, z = 0, seen from above.
fn ground(transform: &Isometry3<f64>) -> [[f64; 3]; 2] {
    let matrix = transform.to_homogeneous();
    [0, 1].map(|row| [matrix[(row, 0)], matrix[(row, 1)], matrix[(row, 3)]])
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use nalgebra::{Translation3, UnitQuaternion};
    use realo_engine::testkit::FusionCase;
    use realo_kernels::bev::BevMap;
    use realo_schemas::report::Fate;
    use realo_schemas::{Kind, Message, Pose, Selection};

    use super::*;

    const MS: Nanos = 1_000_000;
    const SIZE: [usize; 3] = [100, 256, 64];

    fn model(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../../models/{name}.toml"))
    }

    fn operator(name: &str) -> FusionFeatures {
        FusionFeatures::new(settings(name)).unwrap()
    }

    fn settings(name: &str) -> Settings {
        Settings {
            model: model(name),
            ..Settings::default()
        }
    }

    /// A map of the model whose cell (row, column) has features that tell the cell.
    fn map(operator: &FusionFeatures, of: impl Fn(usize, usize) -> f32) -> FeatureMap {
        let [rows, columns, channels] = SIZE;
        let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        let data = cells.flat_map(|(row, column)| std::iter::repeat_n(of(row, column), channels));
        operator.maps.write(BevMap {
            rows,
            columns,
            channels,
            data: data.collect(),
        })
    }

    /// A pose 100 km from the map's origin, so many metres ahead of the ego.
    fn header(agent: &str, ahead: f64) -> Header {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Features, 7, 100 * MS, 150 * MS);
        let pose = Isometry3::from_parts(Translation3::new(1e5 + ahead, -1e5, 12.0), UnitQuaternion::identity());
        (header.pose, header.to) = (Some(Pose::exact(pose)), Some("cav1".into()));
        header
    }

    fn fuse(
        operator: &mut FusionFeatures,
        ego: FeatureMap,
        entries: Vec<Message>,
    ) -> (FeatureMap, Vec<(String, Fate)>) {
        let (fused, reported, error) = try_to_fuse(operator, ego, entries);
        assert_eq!(error, "");
        (fused, reported)
    }

    /// The fused map, what became of whom, and the error.
    fn try_to_fuse(
        operator: &mut FusionFeatures,
        ego: FeatureMap,
        entries: Vec<Message>,
    ) -> (FeatureMap, Vec<(String, Fate)>, String) {
        let asked = header("cav1", 0.0);
        let mut out = Outputs::at(200 * MS);
        operator
            .on_message(Input::<FeatureMap>::EGO, Message::new(asked.clone(), ego), &mut out)
            .unwrap();
        let selection = Message::new(asked, Selection { query: 7, entries });
        let error = operator
            .on_message(Input::<FeatureMap>::SELECTIONS, selection, &mut out)
            .err();
        let (port, fused) = out.take_sent().remove(0);
        assert_eq!(
            (port, fused.header.kind, fused.header.seq),
            (Output::FEATURES, Kind::Features, 7)
        );
        let reported = out.take_fates().into_iter();
        let reported = reported.map(|fated| (fated.message.from, fated.fate)).collect();
        let error = error.map(|error| error.to_string()).unwrap_or_default();
        (fused.into_parts().unwrap().1, reported, error)
    }

    fn feature(map: &FeatureMap, row: usize, column: usize) -> f32 {
        let [_, columns, channels] = SIZE;
        map.data.typed_data::<f32>()[(row * columns + column) * channels]
    }

    #[test]
    fn a_collaborators_features_come_to_the_egos_cells() {
        let mut operator = operator("lite-fcooper");
        let other = map(&operator, |row, column| 10.0 + (row * 256 + column) as f32);
        let ego = map(&operator, |_, _| 1.0);
        // 10 cells ahead: its column 0 is the ego's column 10.
        let entry = Message::new(header("cav2", 8.0), other.clone());
        let (fused, reported) = fuse(&mut operator, ego, vec![entry]);
        assert_eq!(reported, [("cav2".to_string(), Fate::Used)]);
        assert_eq!(feature(&fused, 40, 9), 1.0, "it does not reach there");
        for column in [10, 100, 255] {
            assert!((feature(&fused, 40, column) - feature(&other, 40, column - 10)).abs() < 1e-2);
        }
        assert_eq!(
            (fused.cell, fused.origin, &fused.model),
            (other.cell, other.origin, &other.model)
        );
    }

    #[test]
    fn who_fuses_by_own_means_finds_the_same_features() {
        let mut operator = operator("lite-fcooper");
        let own = map(&operator, |_, _| -5.0);
        let all = map(&operator, |row, column| {
            (row as f32 * 0.7).sin() + (column as f32 * 0.3).cos()
        });
        // In spots, between which nothing is there.
        let spot = |cell: usize| ((cell / SIZE[1]) % 7 + (cell % SIZE[1]) % 5 < 6) as u8;
        let spots = (0..SIZE[0] * SIZE[1]).map(|cell| 0.5 * f32::from(spot(cell)));
        let some = FeatureMap {
            confidence: Some(spots.collect::<Vec<f32>>().into()),
            ..all.clone()
        };
        let covered = [all, some].map(|theirs| covered_alike(&mut operator, &own, theirs));
        assert!(covered[0] < SIZE[0] * SIZE[1] - 1000 && 1000 < covered[1]);
        assert!(covered[1] < covered[0] - 1000, "{covered:?}");
    }

    /// Cells of the ego's that a collaborator's map covers, which the operator and a fusion by own means fuse alike.
    fn covered_alike(operator: &mut FusionFeatures, own: &FeatureMap, theirs: FeatureMap) -> usize {
        let mut moved = header("cav2", 11.3);
        let turned = UnitQuaternion::from_euler_angles(0.01, -0.02, 2.1);
        if let Some(pose) = &mut moved.pose {
            pose.map_from_frame.rotation = turned;
        }
        let entry = Message::new(moved.clone(), theirs.clone());
        let (fused, _) = fuse(operator, own.clone(), vec![entry]);
        let asked = Message::new(header("cav1", 0.0), own.clone());
        let entries = vec![Message::new(moved, theirs)];
        let mut pairing = Pairing::default();
        let selection = Input::Selections(asked.header.clone(), Selection { query: 7, entries });
        let (header, own) = asked.into_parts::<FeatureMap>().unwrap();
        assert!(pairing.take(Input::Ego(header, own), None).unwrap().is_none());
        let mut set = pairing.take(selection, None).unwrap().unwrap();
        let maps = set.maps().unwrap();
        let (mut covered, mut found) = (0, [0.0; SIZE[2]]);
        for (row, column) in (0..SIZE[0]).flat_map(|row| (0..SIZE[1]).map(move |column| (row, column))) {
            let covers = maps.others[0].features_at(row, column, &mut found);
            covered += usize::from(covers);
            let expected = if covers { found[0] } else { -5.0 };
            let there = feature(&fused, row, column);
            assert!(
                (there - expected).abs() < 1e-4,
                "{row} {column}: {there}, expected {expected}"
            );
        }
        covered
    }

    #[test]
    fn maps_that_cannot_be_fused_are_rejected_and_the_others_stay() {
        let mut operator = operator("lite-attfuse");
        let good = map(&operator, |_, _| 2.0);
        let poisoned = map(&operator, |row, _| if row == 3 { f32::NAN } else { 0.0 });
        let other_model = FeatureMap {
            model: "lite-0".into(),
            ..good.clone()
        };
        let narrow = FeatureMap {
            columns: 128,
            data: good.data.slice_with_length(0, 100 * 128 * 64 * 4),
            ..good.clone()
        };
        let cut = FeatureMap {
            data: good.data.slice_with_length(0, 1000),
            ..good.clone()
        };
        let elsewhere = FeatureMap {
            origin: [0.0, 0.0],
            ..good.clone()
        };
        let maps = [("a", poisoned), ("b", other_model), ("c", good.clone())];
        let entries = maps.map(|(agent, map)| Message::new(header(agent, 0.0), map));
        let (fused, reported, error) = try_to_fuse(&mut operator, good.clone(), entries.to_vec());
        for reason in [
            "numbers as a network makes them",
            "found one of lite-0: name one model file in both",
        ] {
            assert!(error.contains(reason), "{error}");
        }
        assert_eq!(fused, good, "the ego's and the one that is the same");
        let expected = [("c", Fate::Used), ("a", Fate::Rejected), ("b", Fate::Rejected)];
        assert_eq!(reported, expected.map(|(agent, fate)| (agent.to_string(), fate)));
        let maps = [("a", narrow), ("b", cut), ("c", elsewhere)];
        let entries = maps.map(|(agent, map)| Message::new(header(agent, 0.0), map));
        let (alone, reported, error) = try_to_fuse(&mut operator, good.clone(), entries.to_vec());
        for reason in [
            "found [100, 128, 64]",
            "expected 4 bytes for each number",
            "from [0.0, 0.0] on",
        ] {
            assert!(error.contains(reason), "{error}");
        }
        assert_eq!(alone, good);
        assert!(
            reported.len() == 3 && reported.iter().all(|(_, fate)| *fate == Fate::Rejected),
            "{reported:?}"
        );
    }

    #[test]
    fn who_is_more_than_the_model_takes_is_over_the_limit() {
        let mut operator = operator("lite-attfuse");
        let all = map(&operator, |_, _| 2.0);
        let entry = |k: usize| Message::new(header(&format!("cav{k}"), 0.0), all.clone());
        let (_, reported) = fuse(&mut operator, all.clone(), (2..7).map(entry).collect());
        let used = reported.iter().filter(|(_, fate)| *fate == Fate::Used).count();
        let over = reported.iter().filter(|(_, fate)| *fate == Fate::OverLimit).count();
        assert_eq!((used, over), (3, 2));
    }

    #[test]
    fn age_counts_in_whole_frames() {
        assert_eq!([-30, 0, 99, 100, 260].map(|age| frames(age * MS)), [0, 0, 0, 1, 2]);
    }

    #[test]
    fn holds_what_every_fusion_owes_its_graph() {
        let maps = operator("lite-attfuse");
        let own = map(&maps, |row, _| row as f32 * 0.01);
        let at = |agent, ahead| Message::new(header(agent, ahead), map(&maps, |_, column| column as f32 * 0.01));
        let case = FusionCase {
            args: vec![format!("model={}", model("lite-attfuse").display())],
            ego: Message::new(header("cav1", 0.0), own.clone()),
            entries: vec![at("rsu1", 20.0), at("cav2", -7.0)],
            alone: own.into(),
        };
        case.check::<FusionFeatures>();
    }

    #[test]
    fn models_and_limits_that_do_not_fit_are_refused() {
        let error = |settings: Settings| FusionFeatures::new(settings).err().expect("refused").to_string();
        let single = error(settings("lite"));
        assert!(
            single.contains("expected one that fuses, found `pointpillars`"),
            "{single}"
        );
        let limit = error(Settings {
            max_collaborators: Some(4),
            ..settings("lite-attfuse")
        });
        assert!(limit.contains("`max_collaborators`: expected at most 3"), "{limit}");
    }
}

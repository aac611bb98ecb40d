//! Says what is not so in the name of some agents: for tests and sweeps of what receivers do against it (`fusion-guard`).
//!
//! It stands between what an agent detects and its sender, so that what it makes is signed, in order and in time. Nothing in a vehicle
//! needs it.

use std::collections::BTreeMap;

use nalgebra::Vector2;
use realo_operator::{Counter, Describe, Draws, Error, Inputs, Operator, Outputs, Settings, StreamKey};
use realo_schemas::{Box3, Boxes, FeatureMap, Header, Kind, Message, Payload, PointCloud, from_seconds};
use serde::{Deserialize, Serialize};

/// Settings of [`Liar`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Who lies, by name, separated by commas; empty: nobody.
    pub agents: String,
    /// Its boxes or points are moved by so much, m, in one direction.
    #[setting(range = 0.0..=1000.0)]
    pub shift_m: f64,
    /// Each of its boxes is moved by a normal error of this standard deviation along x and y, m.
    #[setting(range = 0.0..=1000.0)]
    pub scatter_m: f64,
    /// Cars that are not there, in each message.
    #[setting(range = 0..=100_000)]
    pub ghosts: u32,
    /// How far away ghosts are at most, m.
    #[setting(default = 50.0, range = 1.0..=1000.0)]
    pub ghosts_m: f64,
    /// The score of all that it says; null: that of the detector, and 0.99 of ghosts.
    #[setting(range = 0.0..=1.0)]
    pub score: Option<f32>,
    /// Standard deviation of what replaces its features, in the place of them; 0: they stay.
    #[setting(range = 0.0..=1000.0)]
    pub feature_noise: f64,
    /// Its clock is ahead by so much, ms: stamps say it, poses do not.
    #[setting(range = -60_000..=60_000)]
    pub clock_ms: i32,
    /// Seed of scatter, ghosts and noise.
    #[setting(role = "seed")]
    pub seed: u64,
}

const ABSENT_LIARS: Counter = Counter::loss(
    "absent_liars",
    "names in `agents` of whom no message came: the ego, or nobody",
    "names stand in `agents` of {node} of whom no message came, so nobody lied in their names: the ego itself, or nobody",
    "`--set {node}.agents=…` with the names of others than the ego; `realo info LOG` lists them",
);
const FALSIFIED_MESSAGES: Counter = Counter::plain("falsified_messages", "messages that say what is not so");

/// Says what is not so in the name of some agents.
#[derive(Describe)]
#[stage(counters(FALSIFIED_MESSAGES, ABSENT_LIARS))]
pub struct Liar {
    settings: Settings,
    /// Who lies, and whether it was heard.
    agents: BTreeMap<String, bool>,
    key: StreamKey,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// What agents say.
    #[port(latest, any_of(PointCloud, FeatureMap, Boxes))]
    Messages(Message),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The same, of those who lie with what is not so.
    #[port(any_of(PointCloud, FeatureMap, Boxes))]
    Messages(Message),
}

impl Operator for Liar {
    fn build(settings: Settings) -> Result<Self, Error> {
        let names = settings.agents.split(',').map(str::trim);
        let agents: BTreeMap<String, bool> = names
            .filter(|name| !name.is_empty())
            .map(|name| (name.to_string(), false))
            .collect();
        if let (true, Some(lie)) = (agents.is_empty(), settings.first_lie()) {
            return Err(format!(
                "`agents`: expected the names of those who lie, as `{lie}` is set, found none; `realo info LOG` lists agents"
            )
            .into());
        }
        Ok(Liar {
            agents,
            key: StreamKey::new(settings.seed, "liar"),
            settings,
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Input::Messages(mut message) = input;
        if let Some(was_heard) = self.agents.get_mut(&*message.header.agent) {
            *was_heard = true;
            out.count(&FALSIFIED_MESSAGES, &message.header.agent, 1);
            self.falsify(&mut message)?;
        }
        out.send(Output::Messages(message));
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        for (name, _) in self.agents.iter().filter(|(_, was_heard)| !**was_heard) {
            out.count(&ABSENT_LIARS, name, 1);
        }
        Ok(())
    }
}

impl Settings {
    /// The first setting that makes a lie, if one does.
    fn first_lie(&self) -> Option<&'static str> {
        let lies = [
            ("shift_m", self.shift_m > 0.0),
            ("scatter_m", self.scatter_m > 0.0),
            ("ghosts", self.ghosts > 0),
            ("score", self.score.is_some()),
            ("feature_noise", self.feature_noise > 0.0),
            ("clock_ms", self.clock_ms != 0),
        ];
        lies.into_iter().find(|(_, is_set)| *is_set).map(|(name, _)| name)
    }
}

impl Liar {
    fn falsify(&self, message: &mut Message) -> Result<(), Error> {
        let Header { agent, seq, .. } = &message.header;
        let draws = self.key.draws(agent, "", Kind::Boxes, *seq);
        let ahead = from_seconds(f64::from(self.settings.clock_ms) / 1000.0);
        message.header.stamp = message.header.stamp.saturating_add(ahead);
        message.payload = match std::mem::replace(&mut message.payload, Boxes(Vec::new()).into()) {
            Payload::Boxes(Boxes(boxes)) => Boxes(self.boxes(boxes, draws)).into(),
            Payload::PointCloud(cloud) => self.points(cloud, draws).into(),
            Payload::FeatureMap(map) => self.features(map, draws)?.into(),
            other => other,
        };
        Ok(())
    }

    fn boxes(&self, boxes: Vec<Box3>, draws: Draws) -> Vec<Box3> {
        let settings = &self.settings;
        let mut said: Vec<Box3> = boxes;
        for (object, place) in said.iter_mut().zip(0u64..) {
            object.center[0] += settings.shift_m + settings.scatter_m * draws.gaussian(4 * place);
            object.center[1] += settings.scatter_m * draws.gaussian(4 * place + 2);
        }
        said.extend(self.ghosts(draws).map(|(at, yaw)| Box3 {
            score: 0.99,
            ..Box3::new("Car", [at.x, at.y, 0.8], [4.5, 1.9, 1.6], yaw)
        }));
        if let Some(score) = settings.score {
            said.iter_mut().for_each(|object| object.score = score);
        }
        said
    }

    /// Places and headings of cars that are not there.
    fn ghosts(&self, draws: Draws) -> impl Iterator<Item = (Vector2<f64>, f64)> {
        let reach = self.settings.ghosts_m;
        (0..u64::from(self.settings.ghosts)).map(move |ghost| {
            // Beyond the draws of boxes.
            let draw = |index: u64| 2.0 * draws.uniform((1 << 32) + 3 * ghost + index) - 1.0;
            (Vector2::new(draw(0), draw(1)) * reach, std::f64::consts::PI * draw(2))
        })
    }

    fn points(&self, cloud: PointCloud, draws: Draws) -> PointCloud {
        let mut x: Vec<f32> = cloud.x.iter().map(|x| x + self.settings.shift_m as f32).collect();
        let [mut y, mut z] = [cloud.y.to_vec(), cloud.z.to_vec()];
        for (at, _) in self.ghosts(draws) {
            // The side of a car, as a LiDAR sees it.
            for column in 0..30 {
                for row in 0..8 {
                    x.push(at.x as f32 + 0.15 * column as f32);
                    y.push(at.y as f32);
                    z.push(0.2 + 0.18 * row as f32);
                }
            }
        }
        let longer = x.len() - cloud.len();
        let and = |more: usize| std::iter::repeat_n(0, more);
        PointCloud {
            intensity: cloud
                .intensity
                .iter()
                .copied()
                .chain(and(longer).map(|_| 40))
                .collect::<Vec<u8>>()
                .into(),
            time: cloud
                .time
                .iter()
                .copied()
                .chain(and(longer).map(|_| 0))
                .collect::<Vec<i32>>()
                .into(),
            ring: cloud
                .ring
                .iter()
                .copied()
                .chain(and(longer).map(|_| 0))
                .collect::<Vec<u16>>()
                .into(),
            x: x.into(),
            y: y.into(),
            z: z.into(),
        }
    }

    fn features(&self, map: FeatureMap, draws: Draws) -> Result<FeatureMap, Error> {
        let deviation = self.settings.feature_noise;
        if deviation == 0.0 {
            return Ok(map);
        }
        let all = map.numbers()?.len();
        let noise = (0..all as u64).map(|at| (deviation * draws.gaussian(2 * at)) as f32);
        Ok(map.with_numbers(noise.collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(settings: Settings, agent: &str, payload: impl Into<Payload>) -> Message {
        let mut liar = Liar::new(settings).unwrap();
        let mut out = Outputs::at(0);
        let header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, 3, 100, 100);
        liar.on_message(Input::MESSAGES, Message::new(header, payload), &mut out)
            .unwrap();
        out.take_sent().remove(0).1
    }

    fn car(x: f64) -> Box3 {
        Box3 {
            score: 0.6,
            ..Box3::new("Car", [x, 1.0, 0.8], [4.5, 1.9, 1.6], 0.1)
        }
    }

    fn boxes(settings: Settings, agent: &str) -> Vec<Box3> {
        let message = said(settings, agent, Boxes(vec![car(5.0), car(20.0)]));
        message.into_parts::<Boxes>().unwrap().1.0
    }

    #[test]
    fn who_is_not_named_says_what_is_so() {
        let settings = Settings {
            agents: "cav2, rsu1".into(),
            shift_m: 3.0,
            ghosts: 5,
            ..Settings::default()
        };
        assert_eq!(boxes(settings.clone(), "cav3"), [car(5.0), car(20.0)]);
        assert_eq!(boxes(settings.clone(), "rsu1").len(), 7);
        assert_eq!(
            boxes(settings.clone(), "rsu1"),
            boxes(settings, "rsu1"),
            "lies are drawn by name"
        );
    }

    #[test]
    fn a_lie_without_a_liar_is_refused_and_one_of_whom_nothing_comes_is_named() {
        let lie = |agents: &str| Settings {
            agents: agents.into(),
            ghosts: 3,
            ..Settings::default()
        };
        let error = Liar::new(lie(" ,")).err().expect("nobody lies").to_string();
        assert!(error.contains("`agents`") && error.contains("`ghosts`"), "{error}");
        assert!(Liar::new(Settings::default()).is_ok(), "nobody lies");
        let mut liar = Liar::new(lie("cav2,cav7")).unwrap();
        let mut out = Outputs::at(0);
        let header = Header::origin(&"run".into(), &"cav2".into(), Kind::Boxes, 3, 100, 100);
        liar.on_message(Input::MESSAGES, Message::new(header, Boxes(vec![])), &mut out)
            .unwrap();
        liar.on_end(&mut out).unwrap();
        assert_eq!((out.counted("falsified_messages"), out.counted("absent_liars")), (1, 1));
    }

    #[test]
    fn boxes_move_scatter_and_have_company() {
        let of = |settings: Settings| {
            let agents = "cav2".into();
            boxes(Settings { agents, ..settings }, "cav2")
        };
        let moved = of(Settings {
            shift_m: 3.0,
            ..Settings::default()
        });
        assert_eq!(moved, [car(8.0), car(23.0)]);
        let scattered = of(Settings {
            scatter_m: 2.0,
            ..Settings::default()
        });
        let off = |at: usize, x: f64| scattered[at].center[0] - x;
        assert!(off(0, 5.0) != off(1, 20.0) && off(0, 5.0).abs() < 10.0);
        let ghosts = of(Settings {
            ghosts: 30,
            score: Some(0.5),
            ..Settings::default()
        });
        assert!(ghosts.len() == 32 && ghosts.iter().all(|object| object.score == 0.5));
        assert!(ghosts.iter().all(|object| object.center[0].abs() <= 50.0));
    }

    #[test]
    fn clocks_are_ahead_in_stamps_alone() {
        let settings = Settings {
            agents: "cav2".into(),
            clock_ms: 250,
            ..Settings::default()
        };
        assert_eq!(said(settings, "cav2", Boxes(vec![])).header.stamp, 100 + 250_000_000);
    }

    #[test]
    fn clouds_have_ghosts_too() {
        let cloud = PointCloud::new(vec![1.0], vec![2.0], vec![0.5], vec![7u8], vec![3], vec![4u16]).unwrap();
        let settings = Settings {
            agents: "cav2".into(),
            ghosts: 2,
            shift_m: 1.0,
            ..Settings::default()
        };
        let (_, lied) = said(settings, "cav2", cloud).into_parts::<PointCloud>().unwrap();
        assert_eq!(
            (lied.len(), lied.x[0], lied.ring.len()),
            (1 + 2 * 240, 2.0, 1 + 2 * 240)
        );
    }
}

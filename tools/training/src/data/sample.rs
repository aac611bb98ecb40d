//! From a frame to what a network learns from: an ego, its collaborators, their merged cloud, augmented, as pillars with
//! targets.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use realo_nn::anchors::Anchors;
use realo_nn::model::{Grid, Model};
use realo_nn::pillars::{Pillariser, Points};
use realo_nn::targets::{Object, Targets, assign};
use serde::{Deserialize, Serialize};

use super::frame::{AgentSweep, Frame};
use crate::layers::PillarFrame;
use crate::random::Stream;

/// How far collaborators are from the ego at most, m.
const REACH: f64 = 70.0;

/// Points of all who take part that an object needs to be one.
const LEAST_POINTS: f64 = 5.0;

/// How samples are drawn and changed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Augmentation {
    /// Probability that the ego is a roadside unit.
    pub roadside_ego: f64,
    /// Probability that the ego is alone.
    pub alone: f64,
    /// Probability that everybody within 70 m takes part; else everybody does by a coin of his own.
    pub everybody: f64,
    /// Greatest rotation, rad. The reference takes 45 degrees on a grid of the same shape; then the road, along which
    /// the grid is longest, leaves it after 55 m, and half of the far objects that count in evaluation are never seen.
    /// At 20 degrees it leaves after 115 m; crossing roads give the other headings.
    pub rotation: f64,
    /// Least and greatest scale.
    pub scale: [f64; 2],
    /// Probability of mirroring left and right, and front and rear.
    pub mirror: f64,
    /// Probability that points are dropped.
    pub drop: f64,
    /// Least share of points that is kept then.
    pub keep: f64,
    /// Deviations of a collaborator's position (m) and heading (rad), as two independent GNSS/INS have.
    pub pose_noise: [f64; 2],
}

impl Default for Augmentation {
    fn default() -> Self {
        Augmentation {
            roadside_ego: 0.2,
            alone: 0.5,
            everybody: 0.3,
            rotation: 20f64.to_radians(),
            scale: [0.95, 1.05],
            mirror: 0.5,
            drop: 0.3,
            keep: 0.5,
            pose_noise: [0.03, 0.002],
        }
    }
}

impl Augmentation {
    /// Frames as they are.
    pub fn none() -> Self {
        Augmentation {
            rotation: 0.0,
            scale: [1.0, 1.0],
            mirror: 0.0,
            drop: 0.0,
            keep: 1.0,
            pose_noise: [0.0; 2],
            ..Augmentation::default()
        }
    }

    /// For a fusion: the others' poses err, and most egos have company.
    pub fn of_fusion() -> Self {
        Augmentation {
            alone: 0.1,
            everybody: 0.6,
            pose_noise: Augmentation::default().pose_noise,
            ..Augmentation::none()
        }
    }

    /// How far a collaborator believes itself from where it is, as `true_from_believed`.
    pub(crate) fn pose_error(&self, draws: &mut Stream) -> Isometry3<f64> {
        let [position, heading] = self.pose_noise;
        let off = Vector3::from_fn(|_, _| position * draws.normal());
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading * draws.normal());
        Isometry3::from_parts(off.into(), turn)
    }
}

/// A sample of a batch.
#[derive(Clone, Debug)]
pub struct Sample {
    /// What the network sees.
    pub pillars: PillarFrame,
    /// What its heads should answer.
    pub targets: Targets,
    /// The objects.
    pub objects: Vec<Object>,
    /// The ego's own points on each object.
    pub ego_points: Vec<u32>,
}

/// An ego and those whose clouds are merged into its own, as indices of a frame's agents.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cast {
    /// The ego.
    pub ego: usize,
    /// The others.
    pub others: Vec<usize>,
}

impl Cast {
    /// Draws who takes part.
    pub(crate) fn draw(frame: &Frame, how: &Augmentation, draws: &mut Stream) -> Self {
        let of_kind = |roadside: bool| {
            let agents = frame.agents.iter().enumerate();
            agents
                .filter(|(_, agent)| agent.roadside == roadside)
                .map(|(index, _)| index)
                .collect::<Vec<_>>()
        };
        let [vehicles, units] = [false, true].map(of_kind);
        let roadside = vehicles.is_empty() || !units.is_empty() && draws.chance(how.roadside_ego);
        let egos = if roadside { units } else { vehicles };
        let ego = egos[draws.below(egos.len())];
        let luck = draws.unit();
        let mut others = near(frame, ego);
        if luck < how.alone {
            others.clear();
        } else if luck >= how.alone + how.everybody {
            others.retain(|_| draws.chance(0.5));
        }
        Cast { ego, others }
    }
}

/// The agents within 70 m of one.
pub(crate) fn near(frame: &Frame, ego: usize) -> Vec<usize> {
    let position = |agent: &AgentSweep| agent.map_from_body.translation.vector.xy();
    let center = position(&frame.agents[ego]);
    let all = frame.agents.iter().enumerate().filter(|(index, _)| *index != ego);
    all.filter(|(_, agent)| (position(agent) - center).norm() <= REACH)
        .map(|(index, _)| index)
        .collect()
}

/// A merged cloud with the objects in it, in the ego's body frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Scene {
    columns: [Vec<f32>; 3],
    pub objects: Vec<Object>,
    pub ego_points: Vec<u32>,
}

/// The classes of frames as classes of a model; `None` where the model lacks one.
pub(crate) fn classes_in(model: &Model, classes: &[String]) -> Vec<Option<usize>> {
    classes
        .iter()
        .map(|name| model.classes.iter().position(|class| class.name == *name))
        .collect()
}

impl Scene {
    /// Merges the clouds of a cast, the ego's first.
    pub fn new(frame: &Frame, cast: &Cast, model: &Model, how: &Augmentation, draws: &mut Stream) -> Self {
        let ego = &frame.agents[cast.ego];
        let keep = if draws.chance(how.drop) {
            draws.between(how.keep, 1.0)
        } else {
            1.0
        };
        let mut scene = Scene::default();
        scene.add_points(ego, &Isometry3::identity(), keep, draws);
        let map_from_ego = ego.map_from_body;
        let others: Vec<&AgentSweep> = cast.others.iter().map(|other| &frame.agents[*other]).collect();
        for other in &others {
            let ego_from_other = map_from_ego.inverse() * other.map_from_body * how.pose_error(draws);
            scene.add_points(other, &ego_from_other, keep, draws);
        }
        scene.add_objects(frame, ego, &others, model, keep);
        scene
    }

    /// Adds the objects around an ego of which a share of its own and others' points is enough.
    pub fn add_objects(&mut self, frame: &Frame, ego: &AgentSweep, others: &[&AgentSweep], model: &Model, keep: f64) {
        let classes = classes_in(model, &frame.classes);
        for object in &ego.objects {
            let of = |agent: &&AgentSweep| {
                let known = agent.objects.iter().find(|known| known.track == object.track);
                known.map_or(0, |known| known.points)
            };
            let others: u32 = others.iter().map(of).sum();
            let Some(class) = classes[object.class] else { continue };
            if f64::from(object.points + others) * keep >= LEAST_POINTS {
                let [x, y, z, length, width, height, yaw] = object.lwh;
                self.objects.push(Object {
                    class,
                    hwl: [x, y, z, height, width, length, yaw],
                });
                self.ego_points.push(object.points);
            }
        }
    }

    /// Adds a share of an agent's points.
    pub fn add_points(&mut self, agent: &AgentSweep, ego_from_agent: &Isometry3<f64>, keep: f64, draws: &mut Stream) {
        let rotation = ego_from_agent.rotation.to_rotation_matrix();
        let (r, t) = (
            rotation.matrix().cast::<f32>(),
            ego_from_agent.translation.vector.cast::<f32>(),
        );
        let still = *ego_from_agent == Isometry3::identity();
        let threshold = (keep * f64::from(1 << 24)) as u32;
        // A cheap generator of its own: one draw for each of 10^5 points.
        let mut state = (draws.unit() * f64::from(u32::MAX)) as u32 | 1;
        for [x, y, z] in agent.metres() {
            state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
            if state >> 8 >= threshold {
                continue;
            }
            let moved = match still {
                true => [x, y, z],
                false => std::array::from_fn(|i| r[(i, 0)] * x + r[(i, 1)] * y + r[(i, 2)] * z + t[i]),
            };
            self.columns
                .iter_mut()
                .zip(moved)
                .for_each(|(column, value)| column.push(value));
        }
    }

    /// Mirrors, turns and scales points and objects together, in this order.
    pub fn augment(&mut self, how: &Augmentation, draws: &mut Stream) {
        let mirror = [(); 2].map(|()| if draws.chance(how.mirror) { -1.0 } else { 1.0 });
        let (angle, scale) = (
            draws.between(-how.rotation, how.rotation),
            draws.between(how.scale[0], how.scale[1]),
        );
        let (sin, cos) = angle.sin_cos();
        let turn = |[x, y]: [f64; 2]| {
            let (x, y) = (x * mirror[0], y * mirror[1]);
            [scale * (x * cos - y * sin), scale * (x * sin + y * cos)]
        };
        let matrix = [turn([1.0, 0.0]), turn([0.0, 1.0])].map(|column| column.map(|v| v as f32));
        let [x, y, z] = &mut self.columns;
        for ((x, y), z) in x.iter_mut().zip(y).zip(z) {
            let (a, b) = (*x, *y);
            *x = matrix[0][0] * a + matrix[1][0] * b;
            *y = matrix[0][1] * a + matrix[1][1] * b;
            *z *= scale as f32;
        }
        for Object { hwl, .. } in &mut self.objects {
            let [x, y] = turn([hwl[0], hwl[1]]);
            let [ahead, left] = [hwl[6].cos() * mirror[0], hwl[6].sin() * mirror[1]];
            (hwl[0], hwl[1], hwl[2]) = (x, y, hwl[2] * scale);
            hwl[3..6].iter_mut().for_each(|side| *side *= scale);
            hwl[6] = realo_schemas::geometry::normalize_yaw(left.atan2(ahead) + angle);
        }
    }

    /// The merged cloud, in the ego's frame.
    pub fn points(&self) -> Points<'_> {
        let [x, y, z] = &self.columns;
        Points {
            x,
            y,
            z,
            intensity: None,
        }
    }

    /// The scene as a network of a grid sees it.
    pub fn sample(self, model: &Model) -> Sample {
        let mut pillariser = Pillariser::new(&model.grid, model.pillars.points, model.pillars.pillars);
        let pillars = pillariser.run(&self.points());
        let pillars = PillarFrame::new(&model.grid, pillars, &model.pillars);
        let (objects, ego_points) = self.objects_within(&model.grid);
        Sample {
            pillars,
            targets: assign(&Anchors::of(model), &objects),
            objects,
            ego_points,
        }
    }

    /// The objects whose centres lie on a grid, and the ego's own points on each.
    pub fn objects_within(self, grid: &Grid) -> (Vec<Object>, Vec<u32>) {
        let within = |hwl: &[f64; 7]| {
            let inside = |value: f64, [from, to]: [f64; 2]| (from..to).contains(&value);
            inside(hwl[0], grid.x) && inside(hwl[1], grid.y)
        };
        let both = self.objects.into_iter().zip(self.ego_points);
        both.filter(|(object, _)| within(&object.hwl)).unzip()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;

    use super::super::frame::Seen;
    use super::*;

    fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        Isometry3::from_parts(Translation3::new(x, y, 0.0), turn)
    }

    fn model() -> Model {
        Model::read(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/lite.toml")).unwrap()
    }

    /// The corners of a box's ground plane, a little inside, again and again.
    fn corners([x, y, z, length, width, _, yaw]: [f64; 7], count: usize) -> Vec<[f32; 3]> {
        let (sin, cos) = yaw.sin_cos();
        let signs = [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]];
        let corner = |[a, b]: [f64; 2]| {
            let (a, b) = (a * length * 0.49, b * width * 0.49);
            [x + a * cos - b * sin, y + a * sin + b * cos, z].map(|v| v as f32)
        };
        signs.into_iter().map(corner).cycle().take(count).collect()
    }

    fn agent(name: &str, pose: Isometry3<f64>, lwh: [f64; 7], points: usize) -> AgentSweep {
        let seen = Seen {
            track: 3,
            class: 0,
            lwh,
            points: points as u32,
        };
        AgentSweep::new(name, false, pose, corners(lwh, points).into_iter(), vec![seen])
    }

    /// One car, of which either vehicle alone has fewer points than count.
    fn frame() -> Frame {
        Frame {
            classes: vec!["vehicle".into()],
            agents: vec![
                agent("cav1", pose(5.0, 1.0, 0.3), [20.0, 4.0, 0.8, 4.5, 1.9, 1.6, 0.7], 4),
                agent("cav2", pose(60.0, 9.0, 2.0), SECOND, 4),
            ],
            earlier: None,
        }
    }

    /// The same car as the second vehicle sees it.
    const SECOND: [f64; 7] = [17.003_465_951_4, 32.991_858_981_6, 0.8, 4.5, 1.9, 1.6, -1.0];

    fn scene(others: Vec<usize>, how: &Augmentation, number: u64) -> Scene {
        let mut draws = Stream::new(1, "test", number);
        let mut scene = Scene::new(&frame(), &Cast { ego: 0, others }, &model(), how, &mut draws);
        scene.augment(how, &mut draws);
        scene
    }

    #[test]
    fn points_of_all_make_an_object() {
        let how = Augmentation::none();
        assert_eq!(scene(vec![], &how, 0).objects, []);
        let both = scene(vec![1], &how, 0);
        let [object] = &both.objects[..] else {
            panic!("4 + 4 points: {:?}", both.objects)
        };
        assert_eq!((object.class, &both.ego_points[..]), (0, &[4][..]));
        assert_eq!(both.columns[0].len(), 8);
    }

    #[test]
    fn points_stay_in_their_objects_whatever_is_changed() {
        let how = Augmentation {
            drop: 0.0,
            pose_noise: [0.0; 2],
            ..Augmentation::default()
        };
        let mut headings = Vec::new();
        for number in 0..100 {
            let scene = scene(vec![1], &how, number);
            let [object] = &scene.objects[..] else {
                panic!("one object: {:?}", scene.objects)
            };
            let [x, y, _, _, width, length, yaw] = object.hwl;
            let (sin, cos) = yaw.sin_cos();
            for (px, py) in scene.columns[0].iter().zip(&scene.columns[1]) {
                let (dx, dy) = (f64::from(*px) - x, f64::from(*py) - y);
                let (along, across) = (dx * cos + dy * sin, dy * cos - dx * sin);
                assert!(
                    along.abs() <= length / 2.0 && across.abs() <= width / 2.0,
                    "{number}: a corner at {along}, {across} of {length} x {width}"
                );
            }
            headings.push((yaw * 1e6) as i64);
        }
        headings.sort_unstable();
        headings.dedup();
        assert!(headings.len() > 90, "every draw is another: {}", headings.len());
    }
}

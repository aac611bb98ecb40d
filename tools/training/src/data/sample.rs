//! From a frame to what a network learns from: an ego, its collaborators, their merged cloud, augmented, as pillars with
//! targets.

use crate::targets::{Object, Targets, assign};
use nalgebra::{Isometry3, Matrix3, Matrix4, UnitQuaternion, Vector3};
use realo_methods::Model;
use realo_methods::detect::pillars::{Pillariser, Points};
use realo_nn::anchors::Anchors;
use realo_nn::model::Grid;
use serde::{Deserialize, Serialize};

use super::crowd::{clear, crowd};
use super::frame::{AgentSweep, Frame, Return};
use super::resize::resize;
use crate::fusing::fuses;
use crate::layers::PillarFrame;
use crate::random::Stream;

/// How far collaborators are from the ego at most, m.
pub const REACH: f64 = 70.0;

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
    /// Largest rotation of what is seen on the whole grid, rad; squares are turned by any angle. At 45 degrees the road,
    /// along which the grid is longest, would leave it after 55 m, at 20 degrees after 115 m.
    pub rotation: f64,
    /// Largest pitch and roll, rad.
    pub tilt: f64,
    /// Largest rise and fall, m.
    pub lift: f64,
    /// Probability that what is seen is neither tilted nor lifted: frames are levelled before they reach a network, and from afar
    /// their heights alone tell vans from cars.
    pub level: f64,
    /// Min and max scale.
    pub scale: [f64; 2],
    /// Min and max factor of each object's length, width and height, with its points; recorded sizes are others than ours.
    pub resize: [f64; 2],
    /// Probability that a far object has more background around it, if the ego is a vehicle.
    pub crowd: f64,
    /// Probability that far objects have none around them, if the ego is a roadside unit.
    pub clear: f64,
    /// Probability of mirroring left and right, and front and rear.
    pub mirror: f64,
    /// Probability that an agent's beams are dropped: three of four, every second, or any by chance.
    pub drop_beams: f64,
    /// Probability that points are dropped.
    pub drop: f64,
    /// Smallest share of points that is kept then.
    pub keep: f64,
    /// Decoys that a sample has at most: background that looked like an object when the network was last validated.
    pub decoys: usize,
    /// Deviations of a collaborator's position (m) and heading (rad), as two independent GNSS/INS have.
    pub pose_noise: [f64; 2],
}

impl Default for Augmentation {
    fn default() -> Self {
        Augmentation {
            roadside_ego: 0.33,
            alone: 0.5,
            everybody: 0.3,
            rotation: 20f64.to_radians(),
            tilt: 1.5f64.to_radians(),
            lift: 0.3,
            level: 0.5,
            scale: [0.95, 1.05],
            resize: [0.94, 1.1],
            crowd: 0.75,
            clear: 0.5,
            mirror: 0.5,
            drop_beams: 0.5,
            drop: 0.3,
            keep: 0.5,
            decoys: 3,
            pose_noise: [0.03, 0.002],
        }
    }
}

impl Augmentation {
    /// Frames as they are.
    pub fn none() -> Self {
        Augmentation {
            rotation: 0.0,
            tilt: 0.0,
            lift: 0.0,
            level: 1.0,
            scale: [1.0, 1.0],
            resize: [1.0, 1.0],
            crowd: 0.0,
            clear: 0.0,
            mirror: 0.0,
            drop_beams: 0.0,
            drop: 0.0,
            keep: 1.0,
            decoys: 0,
            pose_noise: [0.0; 2],
            ..Augmentation::default()
        }
    }

    /// What a model needs.
    pub fn of(model: &Model) -> Self {
        match fuses(model) {
            true => Augmentation::of_fusion(),
            false => Augmentation::default(),
        }
    }

    /// For a fusion: most egos have company.
    pub fn of_fusion() -> Self {
        Augmentation {
            roadside_ego: 0.2,
            alone: 0.1,
            everybody: 0.25,
            decoys: 0,
            ..Augmentation::default()
        }
    }

    /// The share of points that is kept of all sweeps of a sample.
    pub(crate) fn share(&self, draws: &mut Stream) -> f64 {
        match draws.chance(self.drop) {
            true => draws.between(self.keep, 1.0),
            false => 1.0,
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

    /// The sweeps that take part, the ego's first; the others' poses err.
    pub(crate) fn parts<'a>(&self, frame: &'a Frame, how: &Augmentation, draws: &mut Stream) -> Vec<PlacedSweep<'a>> {
        let exact = |agent: usize| PlacedSweep::exact(&frame.agents[agent]);
        let others = self.others.iter().map(|other| exact(*other).astray(how, draws));
        std::iter::once(exact(self.ego)).chain(others).collect()
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

/// A beam is not dropped if so few would be left.
const FEWEST_BEAMS: usize = 16;

/// What is kept of a sweep: whole beams, and a share of their points by chance.
#[derive(Clone, Debug)]
pub(crate) struct Kept {
    /// By number of the beam; beams beyond are kept.
    beams: Vec<bool>,
    share: f64,
}

impl Kept {
    pub fn draw(agent: &AgentSweep, share: f64, how: &Augmentation, draws: &mut Stream) -> Self {
        let mut kept = Kept {
            beams: Vec::new(),
            share,
        };
        let count = agent
            .points
            .iter()
            .map(|point| point.ring)
            .max()
            .map_or(0, |last| usize::from(last) + 1);
        if !draws.chance(how.drop_beams) || count < 2 * FEWEST_BEAMS {
            return kept;
        }
        kept.beams = match (draws.below(3), count / FEWEST_BEAMS) {
            (0, 4..) => every(4, count, draws),
            (0 | 1, _) => every(2, count, draws),
            _ => {
                let share = draws.between(0.5, 1.0);
                (0..count).map(|_| draws.chance(share)).collect()
            }
        };
        kept
    }

    fn has(&self, point: &Return) -> bool {
        self.beams.get(usize::from(point.ring)).copied().unwrap_or(true)
    }

    /// Share of an agent's points that is kept.
    pub fn of(&self, agent: &AgentSweep) -> f64 {
        let kept = agent.points.iter().filter(|point| self.has(point)).count();
        self.share * kept as f64 / agent.points.len().max(1) as f64
    }
}

/// Every n-th of so many beams.
fn every(n: usize, count: usize, draws: &mut Stream) -> Vec<bool> {
    let first = draws.below(n);
    (0..count).map(|beam| beam % n == first).collect()
}

/// How a scene is changed: mirrored left and right and front and rear, turned, tilted, scaled and lifted, in this order.
#[derive(Clone, Debug)]
pub(crate) struct Change {
    matrix: Matrix3<f64>,
    lift: f64,
    mirror: [f64; 2],
    turn: f64,
    scale: f64,
}

/// A rigid motion of points.
struct Moved {
    rotation: [[f32; 3]; 3],
    shift: [f32; 3],
    still: bool,
}

impl Moved {
    fn by(motion: &Matrix4<f64>) -> Self {
        Moved {
            rotation: [0, 1, 2].map(|row| [0, 1, 2].map(|column| motion[(row, column)] as f32)),
            shift: [0, 1, 2].map(|row| motion[(row, 3)] as f32),
            still: *motion == Matrix4::identity(),
        }
    }

    fn point(&self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        match self.still {
            true => [x, y, z],
            false => std::array::from_fn(|i| {
                let [a, b, c] = self.rotation[i];
                a * x + b * y + c * z + self.shift[i]
            }),
        }
    }
}

impl Change {
    /// `rotation`: the largest, rad.
    pub fn draw(how: &Augmentation, rotation: f64, draws: &mut Stream) -> Self {
        let mirror = [(); 2].map(|()| if draws.chance(how.mirror) { -1.0 } else { 1.0 });
        let turn = draws.between(-rotation, rotation);
        let scale = draws.between(how.scale[0], how.scale[1]);
        let [tilt, lift] = if draws.chance(how.level) {
            [0.0; 2]
        } else {
            [how.tilt, how.lift]
        };
        let [roll, pitch] = [(); 2].map(|()| draws.between(-tilt, tilt));
        let tilted = UnitQuaternion::from_euler_angles(roll, pitch, 0.0);
        let turned = tilted * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
        let mirrored = Matrix3::from_diagonal(&Vector3::new(mirror[0], mirror[1], 1.0));
        Change {
            matrix: scale * turned.to_rotation_matrix().matrix() * mirrored,
            lift: draws.between(-lift, lift),
            mirror,
            turn,
            scale,
        }
    }

    /// Where a point comes to.
    pub fn point(&self, point: [f64; 3]) -> [f64; 3] {
        let [x, y, z] = (self.matrix * Vector3::from(point)).into();
        [x, y, z + self.lift]
    }

    /// A motion between two frames as it is between the changed ones.
    pub fn of_motion(&self, motion: &Matrix4<f64>) -> Matrix4<f64> {
        let mut change = self.matrix.to_homogeneous();
        change[(2, 3)] = self.lift;
        let back = change.try_inverse().expect("a change keeps volumes");
        change * motion * back
    }

    /// A box as `x, y, z, h, w, l, yaw`; it stays upright.
    fn hwl(&self, [x, y, z, h, w, l, yaw]: [f64; 7]) -> [f64; 7] {
        let [x, y, z] = self.point([x, y, z]);
        let [h, w, l] = [h, w, l].map(|side| side * self.scale);
        let mirrored = (yaw.sin() * self.mirror[1]).atan2(yaw.cos() * self.mirror[0]);
        [
            x,
            y,
            z,
            h,
            w,
            l,
            realo_schemas::geometry::normalize_yaw(mirrored + self.turn),
        ]
    }
}

/// A merged cloud with the objects in it, in the ego's body frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Scene {
    /// x, y, z of its points, m.
    pub columns: [Vec<f32>; 3],
    /// Of each point the number of the sweep that it is of.
    pub sources: Vec<u8>,
    pub objects: Vec<Object>,
    /// Objects of which too few points are kept: neither an answer that should be given nor background.
    pub faint: Vec<Object>,
    pub ego_points: Vec<u32>,
}

/// The classes of frames as classes of a model; `None` where the model lacks one.
pub(crate) fn classes_in(model: &Model, classes: &[String]) -> Vec<Option<usize>> {
    classes
        .iter()
        .map(|name| model.classes.iter().position(|class| class.name == *name))
        .collect()
}

/// A sweep that takes part in a sample, with the pose that its agent believes it has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlacedSweep<'a> {
    pub sweep: &'a AgentSweep,
    pub map_from_sweep: Isometry3<f64>,
}

impl<'a> PlacedSweep<'a> {
    /// Where it really is.
    pub fn exact(sweep: &'a AgentSweep) -> Self {
        PlacedSweep {
            sweep,
            map_from_sweep: sweep.map_from_body,
        }
    }

    /// The same with a pose that errs.
    pub fn astray(self, how: &Augmentation, draws: &mut Stream) -> Self {
        let map_from_sweep = self.map_from_sweep * how.pose_error(draws);
        PlacedSweep { map_from_sweep, ..self }
    }
}

impl Scene {
    /// Merges sweeps of a frame, the ego's first.
    pub fn new(frame: &Frame, parts: &[PlacedSweep], model: &Model, how: &Augmentation, draws: &mut Stream) -> Self {
        let ego = parts[0].sweep;
        let keep = how.share(draws);
        let mut scene = Scene::default();
        let mut shares = Vec::new();
        for (number, part) in parts.iter().enumerate() {
            let ego_from_sweep = match number {
                0 => Isometry3::identity(),
                _ => ego.map_from_body.inverse() * part.map_from_sweep,
            };
            let kept = Kept::draw(part.sweep, keep, how, draws);
            scene.add_points(part.sweep, number as u8, &ego_from_sweep, &kept, draws);
            shares.push((part.sweep, kept.of(part.sweep)));
        }
        scene.add_objects(frame, &shares, model);
        resize(&mut scene, how.resize, draws);
        match ego.roadside {
            true => clear(&mut scene, how.clear, draws),
            false => crowd(&mut scene, how.crowd, draws),
        }
        scene
    }

    /// Adds the objects around an ego that the kept shares of its own and others' points show; the ego comes first.
    pub fn add_objects(&mut self, frame: &Frame, shares: &[(&AgentSweep, f64)], model: &Model) {
        let classes = classes_in(model, &frame.classes);
        for object in shares.iter().take(1).flat_map(|(ego, _)| &ego.objects) {
            let of = |(agent, share): &(&AgentSweep, f64)| {
                let known = agent.objects.iter().find(|known| known.track == object.track);
                known.map_or(0.0, |known| f64::from(known.points) * share)
            };
            let points: f64 = shares.iter().map(of).sum();
            let Some(class) = classes[object.class] else { continue };
            let [x, y, z, length, width, height, yaw] = object.lwh;
            let hwl = [x, y, z, height, width, length, yaw];
            if points >= LEAST_POINTS {
                self.objects.push(Object { class, hwl });
                self.ego_points.push(object.points);
            } else if points > 0.0 {
                self.faint.push(Object { class, hwl });
            }
        }
    }

    /// The objects of which there is at least one point, whether or not they count.
    pub fn seen(&self) -> impl Iterator<Item = &Object> {
        self.objects.iter().chain(&self.faint)
    }

    /// Adds what is kept of a sweep's points.
    fn add_points(
        &mut self,
        agent: &AgentSweep,
        source: u8,
        ego_from_agent: &Isometry3<f64>,
        kept: &Kept,
        draws: &mut Stream,
    ) {
        let moved = Moved::by(&ego_from_agent.to_homogeneous());
        let threshold = (kept.share * f64::from(1 << 24)) as u32;
        // A cheap generator of its own: one draw for each of 10^5 points.
        let mut state = (draws.unit() * f64::from(u32::MAX)) as u32 | 1;
        for point in agent.points.iter().filter(|point| kept.has(point)) {
            state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
            if state >> 8 >= threshold {
                continue;
            }
            self.push(moved.point(point.metres()), source);
        }
    }

    /// Adds a point, m, of a sweep.
    pub fn push(&mut self, point: [f32; 3], source: u8) {
        for (column, value) in self.columns.iter_mut().zip(point) {
            column.push(value);
        }
        self.sources.push(source);
    }

    /// Keeps the points of which this is true.
    pub fn retain(&mut self, stays: impl Fn([f32; 3]) -> bool) {
        let (points, sources): (Vec<_>, Vec<_>) = self
            .iter()
            .zip(self.sources.iter().copied())
            .filter(|(point, _)| stays(*point))
            .unzip();
        self.columns = std::array::from_fn(|axis| points.iter().map(|point: &[f32; 3]| point[axis]).collect());
        self.sources = sources;
    }

    /// The points of one sweep alone, in its own frame or any other.
    pub fn part(&self, source: u8, frame_from_ego: &Matrix4<f64>) -> Scene {
        let moved = Moved::by(frame_from_ego);
        let mut part = Scene::default();
        let points = self.iter().zip(&self.sources).filter(|(_, of)| **of == source);
        points.for_each(|(point, _)| part.push(moved.point(point), source));
        part
    }

    /// Its points, m.
    pub fn iter(&self) -> impl Iterator<Item = [f32; 3]> {
        let [x, y, z] = &self.columns;
        x.iter().zip(y).zip(z).map(|((x, y), z)| [*x, *y, *z])
    }

    /// Changes points and objects together.
    pub fn change(&mut self, change: &Change) {
        let (matrix, lift) = (change.matrix.cast::<f32>(), change.lift as f32);
        let [x, y, z] = &mut self.columns;
        for ((x, y), z) in x.iter_mut().zip(y).zip(z) {
            [*x, *y, *z] = (matrix * Vector3::new(*x, *y, *z)).into();
            *z += lift;
        }
        for Object { hwl, .. } in self.objects.iter_mut().chain(&mut self.faint) {
            *hwl = change.hwl(*hwl);
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

    /// Its points as a network of a grid sees them.
    pub fn pillars(&self, model: &Model) -> PillarFrame {
        let mut pillariser = Pillariser::new(&model.grid, model.pillars.points, model.pillars.pillars);
        PillarFrame::new(&model.grid, pillariser.run(&self.points()), &model.pillars)
    }

    /// The scene as a network of a grid sees it.
    pub fn sample(self, model: &Model) -> Sample {
        let pillars = self.pillars(model);
        let targets = self.targets(model);
        let (objects, ego_points) = self.objects_within(&model.grid);
        Sample {
            pillars,
            targets,
            objects,
            ego_points,
        }
    }

    /// What the heads of a network of a grid should answer.
    pub fn targets(&self, model: &Model) -> Targets {
        let anchors = Anchors::of(model);
        let (within, mut uncounted): (Vec<Object>, Vec<Object>) = self
            .objects
            .iter()
            .copied()
            .partition(|object| is_within(&model.grid, object));
        uncounted.extend(&self.faint);
        let mut targets = assign(&anchors, &within);
        ignore(&mut targets, &assign(&anchors, &uncounted));
        targets
    }

    /// The objects whose centres lie on a grid, and the ego's own points on each.
    pub fn objects_within(self, grid: &Grid) -> (Vec<Object>, Vec<u32>) {
        let both = self.objects.into_iter().zip(self.ego_points);
        both.filter(|(object, _)| is_within(grid, object)).unzip()
    }
}

fn is_within(grid: &Grid, object: &Object) -> bool {
    let inside = |value: f64, [from, to]: [f64; 2]| (from..to).contains(&value);
    inside(object.hwl[0], grid.x) && inside(object.hwl[1], grid.y)
}

/// Background does not count where other objects are: those whose centres the grid loses, and those that are hardly seen.
fn ignore(targets: &mut Targets, others: &Targets) {
    for (label, other) in targets.labels.iter_mut().zip(&others.labels) {
        if *label == 0 && *other != 0 {
            *label = -1;
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;

    use realo_kernels::warp::Warp;

    use super::super::frame::Seen;
    use super::super::maps::{Party, Project};
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
        AgentSweep::new(name, false, pose, corners(lwh, points).into_iter().zip(0..), vec![seen])
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

    #[test]
    fn of_an_ego_that_sees_nothing_the_map_of_another_is_left() {
        let mut frame = frame();
        frame.agents[0] = agent("cav1", pose(5.0, 1.0, 0.3), [20.0, 4.0, 0.8, 4.5, 1.9, 1.6, 0.7], 30);
        frame.agents[1] = agent("cav2", pose(60.0, 9.0, 2.0), SECOND, 9);
        let looks = |blind: bool| {
            let party = Party {
                ego: 0,
                others: vec![(1, false)],
                project: Project::Sender,
                blind,
            };
            let mut draws = Stream::new(1, "test", 0);
            let view = party.view(&frame, &model(), &Augmentation::none(), &mut draws);
            assert_eq!((view.scene.objects.len(), view.scene.ego_points[0] == 0), (1, blind));
            view.looks(&model())
        };
        let counts: Vec<usize> = looks(false).iter().map(|look| look.scene.iter().count()).collect();
        assert_eq!(counts, [30, 9]);
        let [look] = &looks(true)[..] else { panic!("one map") };
        assert_eq!((look.scene.iter().count(), look.member.warp), (9, Warp::IDENTITY));
        // The other's points lie where the ego's frame has the car.
        assert!(look.scene.iter().all(|[x, y, _]| (x - 20.0).hypot(y - 4.0) < 2.6));
    }

    fn scene(others: Vec<usize>, how: &Augmentation, number: u64) -> Scene {
        let mut draws = Stream::new(1, "test", number);
        let (frame, cast) = (frame(), Cast { ego: 0, others });
        let parts = cast.parts(&frame, how, &mut draws);
        let mut scene = Scene::new(&frame, &parts, &model(), how, &mut draws);
        scene.change(&Change::draw(how, std::f64::consts::PI, &mut draws));
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
    fn an_object_with_too_few_points_is_no_background() {
        let labels = |scene: Scene| {
            let mut counts = [0; 3];
            let targets = scene.targets(&model());
            targets
                .labels
                .iter()
                .for_each(|label| counts[(label + 1) as usize] += 1);
            counts
        };
        let [ignored, _, found] = labels(scene(vec![], &Augmentation::none(), 0));
        assert!(ignored > 0 && found == 0, "{ignored} ignored, {found} found");
        assert!(labels(scene(vec![1], &Augmentation::none(), 0))[2] > 0, "4 + 4 points");
        let mut unseen = frame();
        let known = unseen.agents.iter_mut().flat_map(|agent| &mut agent.objects);
        known.for_each(|object| object.points = 0);
        let cast = Cast {
            ego: 0,
            others: vec![1],
        };
        let (how, mut draws) = (Augmentation::none(), Stream::new(1, "test", 0));
        let parts = cast.parts(&unseen, &how, &mut draws);
        let empty = Scene::new(&unseen, &parts, &model(), &how, &mut draws);
        assert_eq!(labels(empty)[0], 0, "nobody has a point of it");
    }

    #[test]
    fn points_stay_in_their_objects_whatever_is_changed() {
        let how = Augmentation {
            drop: 0.0,
            pose_noise: [0.0; 2],
            ..Augmentation::default()
        };
        let mut eighths = [0; 8];
        for number in 0..100 {
            let scene = scene(vec![1], &how, number);
            let [object] = &scene.objects[..] else {
                panic!("one object: {:?}", scene.objects)
            };
            let [x, y, z, height, width, length, yaw] = object.hwl;
            let (sin, cos) = yaw.sin_cos();
            let [xs, ys, zs] = &scene.columns;
            for ((px, py), pz) in xs.iter().zip(ys).zip(zs) {
                let (dx, dy, dz) = (f64::from(*px) - x, f64::from(*py) - y, f64::from(*pz) - z);
                let (along, across) = (dx * cos + dy * sin, dy * cos - dx * sin);
                // A box stays upright: a tilt takes what is 2.4 m from its centre 6 cm out of it.
                assert!(
                    along.abs() <= length / 2.0 && across.abs() <= width / 2.0 && dz.abs() <= 0.2 * height,
                    "{number}: a corner at {along}, {across}, {dz} of {length} x {width}"
                );
            }
            eighths[((yaw / std::f64::consts::FRAC_PI_4).floor() as i64).rem_euclid(8) as usize] += 1;
        }
        assert!(eighths.iter().all(|count| *count > 2), "all headings: {eighths:?}");
    }

    #[test]
    fn changes_are_as_large_as_is_said() {
        let how = Augmentation::default();
        let mut draws = Stream::new(4, "test", 0);
        let (mut most, mut rises) = (0.0f64, Vec::new());
        for _ in 0..500 {
            let change = Change::draw(&how, std::f64::consts::PI, &mut draws);
            let origin = change.point([0.0; 3]);
            assert!(origin[0] == 0.0 && origin[1] == 0.0);
            rises.push(origin[2]);
            let up = change.point([0.0, 0.0, 1.0]);
            let (aside, up) = (up[0].hypot(up[1]), up[2] - origin[2]);
            most = most.max(aside.atan2(up).to_degrees());
            let scale = aside.hypot(up);
            assert!((0.95..=1.05).contains(&scale), "{scale}");
        }
        // Pitch and roll of 1.5 degrees together.
        assert!((1.8..2.13).contains(&most), "{most} degrees");
        let reach = |of: fn(f64, f64) -> f64| rises.iter().copied().fold(0.0, of);
        assert!((-0.3..-0.25).contains(&reach(f64::min)) && (0.25..0.3).contains(&reach(f64::max)));
    }

    /// 4,000 points on 40 beams, 100 of each.
    fn beams() -> AgentSweep {
        let points = (0..4000).map(|i| ([i as f32 * 0.01, 1.0, 1.0], i / 100));
        AgentSweep::new("cav1", false, pose(0.0, 0.0, 0.0), points, Vec::new())
    }

    #[test]
    fn whole_beams_are_dropped_and_never_too_many() {
        let agent = beams();
        let how = Augmentation {
            drop_beams: 1.0,
            ..Augmentation::none()
        };
        let mut shares = Vec::new();
        for number in 0..60 {
            let mut draws = Stream::new(2, "test", number);
            let kept = Kept::draw(&agent, 1.0, &how, &mut draws);
            let mut scene = Scene::default();
            scene.add_points(&agent, 0, &Isometry3::identity(), &kept, &mut draws);
            let left = scene.columns[0].len();
            assert_eq!(left as f64, 4000.0 * kept.of(&agent));
            assert!(left.is_multiple_of(100) && left >= 1000, "{left} points of whole beams");
            shares.push(left);
        }
        let halves = shares.iter().filter(|left| **left == 2000).count();
        assert!(
            (25..55).contains(&halves),
            "{halves}: of 40 beams a quarter would be too few"
        );
        let some = AgentSweep::new(
            "cav1",
            false,
            pose(0.0, 0.0, 0.0),
            [([1.0; 3], 0)].into_iter(),
            Vec::new(),
        );
        let kept = Kept::draw(&some, 1.0, &how, &mut Stream::new(2, "test", 0));
        assert_eq!(kept.of(&some), 1.0, "beams that are not known are kept");
    }

    #[test]
    fn background_beside_the_grid_counts_but_where_an_object_is_cut() {
        let model = model();
        let object = |x: f64| Object {
            class: 0,
            hwl: [x, 0.0, 0.8, 1.6, 1.9, 4.5, 0.0],
        };
        let labels = |x: Option<f64>| {
            let scene = Scene {
                objects: x.map(object).into_iter().collect(),
                ego_points: x.map(|_| 9).into_iter().collect(),
                ..Scene::default()
            };
            scene.sample(&model).targets.labels
        };
        let count = |labels: &[i8], label: i8| labels.iter().filter(|found| **found == label).count();
        let empty = labels(None);
        assert_eq!(count(&empty, 0), empty.len());
        let cut = labels(Some(102.5));
        let [ignored, found] = [-1, 1].map(|label| count(&cut, label));
        assert!(
            ignored > 1 && found == 0,
            "at the edge {ignored} are ignored, {found} found"
        );
        let far = labels(Some(120.0));
        assert_eq!(count(&far, 0), far.len());
        assert!(count(&labels(Some(100.0)), 1) > 0);
    }
}

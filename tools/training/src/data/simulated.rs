//! Frames from simulator seeds.

use std::sync::Arc;

use realo_schemas::geometry::{Motion, PoseTrack};
use realo_schemas::{Box3, Nanos, PointCloud, from_seconds};
use realo_scoring::Protocol;
use realo_simulator::{AgentKind, Options, Phase, Scenario, Sensor, Simulation};
use realo_sync::{OwnBody, clean};

use super::frame::{AgentSweep, Earlier, Frame, Seen};
use crate::TrainError;
use crate::random::Stream;

/// Length of the simulations, s; frames lie in different seconds.
const SECONDS: f64 = 10.0;

/// The earlier sweeps of a frame lie at most so many before it.
const LONGEST_DELAY: u64 = 3;

/// The first places, those on a grid: their houses and sensors are like no other place's.
const ON_GRID: u64 = 2;

/// After so many seeds the places come round again, those on a grid three times.
const ROUND: u64 = Scenario::PLACES.len() as u64 + 2 * ON_GRID;

/// What vehicles carry, and roadside units, in places that are not on a grid.
const VEHICLE_SENSORS: [&str; 6] = [
    "spinning-16",
    "spinning-32",
    "pandar40p",
    "os1-64",
    "os1-128",
    "ruby-plus-128",
];
const ROADSIDE_SENSORS: [&str; 5] = ["forward-scan", "forward-scan", "os1-64", "os1-128", "ruby-plus-128"];

/// What a training seed simulates: all combinations of place and traffic, a third dense, a fifth with sweeps that do not
/// start together; on a grid with the sensors of these places and, each third time, rounded bodies, elsewhere with drawn
/// sensors.
pub fn options(seed: u64) -> Options {
    let turn = seed % ROUND;
    let scenario = match Scenario::PLACES.get(turn as usize) {
        Some(place) => *place,
        None => Scenario::PLACES[(turn % ON_GRID) as usize],
    };
    let on_grid = matches!(scenario, Scenario::Intersection | Scenario::Corridor);
    let third_time = turn >= Scenario::PLACES.len() as u64 + ON_GRID;
    let mut draws = Stream::new(seed, "sensors", 0);
    let mut pair = |names: &[&str], heights, pitches| match on_grid {
        true => Vec::new(),
        false => vec![
            sensor(names, heights, pitches, &mut draws),
            sensor(names, heights, pitches, &mut draws),
        ],
    };
    Options {
        scenario,
        dense: seed % 3 == 2,
        phase: if seed % 5 == 4 { Phase::Spread } else { Phase::Locked },
        seed,
        seconds: SECONDS,
        vehicle_sensors: pair(&VEHICLE_SENSORS, [1.6, 2.4], [-1.0, 1.5]),
        roadside_sensors: pair(&ROADSIDE_SENSORS, [4.0, 8.0], [-1.0, 5.0]),
        // What learns only from bodies that fill their boxes puts boxes behind those of recorded cars.
        rounded_bodies: !on_grid || third_time,
        ..Options::default()
    }
}

/// One of some sensors, at a height (m) and a pitch (degrees down) between two.
fn sensor(names: &[&str], heights: [f64; 2], pitches: [f64; 2], draws: &mut Stream) -> Arc<Sensor> {
    let sensor = Sensor::named(names[draws.below(names.len())]).expect("a built-in sensor");
    let [height, pitch] = [heights, pitches].map(|[from, to]| draws.between(from, to));
    Arc::new(sensor.mounted(height, pitch).expect("a usual mount"))
}

/// `count` frames of a simulation, at least a second apart; at most 10. With `earlier`, each has what was one to three sweeps
/// before as well, unless there was none.
///
/// # Errors
/// [`TrainError::Simulation`].
pub fn frames(options: &Options, count: usize, earlier: bool) -> Result<Vec<Frame>, TrainError> {
    let simulation = Simulation::new(options)?;
    let tracks: Vec<PoseTrack> = simulation
        .agents()
        .map(|agent| true_track(&simulation, &agent.name))
        .collect();
    Ok(numbers(options.seed, count)
        .into_iter()
        .map(|seq| {
            let frame = frame(&simulation, &tracks, seq);
            let before = |delay| Earlier {
                delay: delay as usize,
                agents: self::frame(&simulation, &tracks, seq - delay).agents,
            };
            Frame {
                earlier: delay(options.seed, seq).filter(|_| earlier).map(before),
                ..frame
            }
        })
        .collect())
}

/// Numbers of the sweeps: one moment in each of some seconds.
fn numbers(seed: u64, count: usize) -> Vec<u64> {
    let mut draws = Stream::new(seed, "sweeps", 0);
    let moment = draws.below(10) as u64;
    let mut seconds: Vec<u64> = (0..SECONDS as u64).collect();
    (0..count.min(seconds.len()))
        .map(|_| seconds.swap_remove(draws.below(seconds.len())) * 10 + moment)
        .collect()
}

/// How many sweeps before one the earlier ones lie; `None` for the first.
fn delay(seed: u64, seq: u64) -> Option<u64> {
    let longest = LONGEST_DELAY.min(seq);
    (longest > 0).then(|| 1 + Stream::new(seed, "delay", seq).below(longest as usize) as u64)
}

/// An agent's true poses.
fn true_track(simulation: &Simulation, agent: &str) -> PoseTrack {
    let mut track = PoseTrack::new(Nanos::MAX, from_seconds(0.02));
    for pose in simulation.poses(agent).unwrap_or_default() {
        track.insert(pose.stamp, pose.truth.map_from_body);
    }
    track
}

fn frame(simulation: &Simulation, tracks: &[PoseTrack], seq: u64) -> Frame {
    let protocol = Protocol::load("default").expect("the default protocol ships");
    let agents = simulation.agents().zip(tracks).enumerate();
    let agents = agents.map(|(index, (info, track))| {
        let (sweep, _) = simulation.sweep(index, seq);
        let covered = "poses cover every sweep";
        let pose = track.at(sweep.stamp).expect(covered);
        let counts = sweep.points.iter().copied();
        let objects = seen(&protocol, &sweep.truth, counts);
        let roadside = info.kind == AgentKind::Roadside;
        let (still, is_deskewed) = cleaned(&sweep.cloud, track, sweep.stamp, roadside);
        assert!(is_deskewed, "{covered}");
        AgentSweep::new(&info.name, roadside, pose, returns(&still), objects)
    });
    Frame {
        classes: class_names(&protocol),
        agents: agents.collect(),
        earlier: None,
    }
}

/// The points of a sweep as `sync` passes them on: in the body frame at its stamp, without a vehicle's own body; and whether the
/// track covers the sweep. Where it does not, points stay where they were recorded.
pub(crate) fn cleaned(cloud: &PointCloud, track: &PoseTrack, stamp: Nanos, roadside: bool) -> (PointCloud, bool) {
    if roadside {
        return (clean(cloud, None, None).cloud, true);
    }
    let (first, last) = cloud
        .time
        .iter()
        .fold((0, 0), |(first, last), t| (first.min(*t), last.max(*t)));
    let motion = Motion::new(track, stamp, first.into(), last.into());
    let cleaned = clean(cloud, Some(OwnBody::V2X_REAL), motion.as_ref());
    (cleaned.cloud, motion.is_some())
}

/// The points of a cloud, m, and the numbers of their beams.
pub(crate) fn returns(cloud: &PointCloud) -> impl Iterator<Item = ([f32; 3], u16)> + '_ {
    let PointCloud { x, y, z, ring, .. } = cloud;
    let points = x.iter().zip(y.iter()).zip(z.iter()).zip(ring.iter());
    points.map(|(((x, y), z), ring)| ([*x, *y, *z], *ring))
}

/// Names of a protocol's super-classes, in order.
pub(crate) fn class_names(protocol: &Protocol) -> Vec<String> {
    protocol.classes.iter().map(|class| class.name.clone()).collect()
}

/// The objects that count, with an agent's points on each.
pub(crate) fn seen(protocol: &Protocol, truth: &[Box3], points: impl Iterator<Item = u32>) -> Vec<Seen> {
    let known = truth
        .iter()
        .zip(points)
        .enumerate()
        .filter_map(|(index, (object, points))| {
            let [x, y, z] = object.center;
            Some(Seen {
                // Without identities an object is known to one agent only.
                track: object.track.unwrap_or(u64::MAX - index as u64),
                class: protocol.class_of(&object.class)?.into(),
                lwh: [x, y, z, object.length, object.width, object.height, object.yaw],
                points,
            })
        });
    known.collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn frames_of_a_seed_are_a_second_apart_and_the_same_every_time() {
        for seed in 0..50 {
            let mut all = numbers(seed, 4);
            assert_eq!(all, numbers(seed, 4));
            all.sort_unstable();
            assert!(all.windows(2).all(|pair| pair[1] >= pair[0] + 10), "{all:?}");
        }
    }

    #[test]
    fn seeds_cover_all_places_with_all_kinds_of_traffic_and_all_sensors() {
        let all: Vec<Options> = (0..800).map(options).collect();
        let kinds: BTreeSet<_> = all
            .iter()
            .map(|o| (o.scenario, o.dense, o.phase == Phase::Spread))
            .collect();
        assert_eq!(kinds.len(), 4 * Scenario::PLACES.len());
        let sensors = |of: fn(&Options) -> &Vec<Arc<Sensor>>| {
            let elevations = all.iter().flat_map(of).map(|sensor| sensor.elevations().len());
            elevations.collect::<BTreeSet<_>>()
        };
        assert_eq!(sensors(|o| &o.vehicle_sensors), BTreeSet::from([16, 32, 40, 64, 128]));
        assert_eq!(
            sensors(|o| &o.roadside_sensors).len(),
            3,
            "a forward scan, 64 and 128 beams"
        );
        let on_grid = all.iter().filter(|o| o.vehicle_sensors.is_empty());
        assert_eq!(on_grid.clone().count(), 300, "seeds of the places on a grid");
        let rounded: Vec<Scenario> = on_grid.filter(|o| o.rounded_bodies).map(|o| o.scenario).collect();
        assert_eq!(rounded.len(), 100);
        assert_eq!(
            BTreeSet::from_iter(rounded),
            Scenario::PLACES[..2].iter().copied().collect()
        );
    }

    #[test]
    fn validation_covers_every_place_once() {
        let places: BTreeSet<Scenario> = (800..812).map(|seed| options(seed).scenario).collect();
        assert_eq!(places, Scenario::PLACES.into_iter().collect());
        assert_eq!((800..812).filter(|seed| options(*seed).dense).count(), 4);
    }

    #[test]
    fn points_of_all_agents_lie_on_the_same_objects() {
        let options = Options {
            column_stride: 4,
            ..options(2)
        };
        let frame = frames(&options, 1, false).unwrap().remove(0);
        let ego = &frame.agents[0];
        for agent in &frame.agents {
            let ego_from_agent = ego.map_from_body.inverse() * agent.map_from_body;
            assert!(!agent.points.is_empty() && !agent.objects.is_empty());
            for object in agent.objects.iter().filter(|object| object.points >= 20) {
                // The same object in the ego's frame, where the ego is not the object.
                let Some(known) = ego.objects.iter().find(|known| known.track == object.track) else {
                    continue;
                };
                let [x, y, z, ..] = object.lwh;
                let there = ego_from_agent * nalgebra::Point3::new(x, y, z);
                let off = (there.x - known.lwh[0]).hypot(there.y - known.lwh[1]);
                assert!(off < 0.1, "{}: {off} m", agent.name);
                let inside = agent.metres().filter(|point| contains(&object.lwh, *point)).count();
                assert!(
                    inside * 2 > object.points as usize,
                    "{}: {inside} of {}",
                    agent.name,
                    object.points
                );
            }
            // A car that moves would see itself smeared beyond its outline if it were left out after the motion was.
            let on_body = |[x, y, z]: [f32; 3]| (-2.7..3.7).contains(&x) && y.abs() < 1.1 && (0.4..1.7).contains(&z);
            assert!(agent.roadside || !agent.metres().any(on_body), "{}", agent.name);
        }
    }

    fn contains(lwh: &[f64; 7], point: [f32; 3]) -> bool {
        let [x, y, z, l, w, h, yaw] = *lwh;
        let (dx, dy, dz) = (
            f64::from(point[0]) - x,
            f64::from(point[1]) - y,
            f64::from(point[2]) - z,
        );
        let (along, across) = (dx * yaw.cos() + dy * yaw.sin(), dy * yaw.cos() - dx * yaw.sin());
        // A moving object's points spread over the time of a sweep.
        along.abs() < l / 2.0 + 0.8 && across.abs() < w / 2.0 + 0.3 && dz.abs() < h / 2.0 + 0.3
    }
}

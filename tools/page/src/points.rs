//! Sweeps of agents, in few bytes: whole steps of 2 cm in the axes of the map, from a place near the agent.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::hash::{BuildHasherDefault, Hasher};

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use realo_logs::{Log, MAX_GAP, Stream, pose_track};
use realo_render::clouds::in_ego_frame;
use realo_render::{RenderError, single_runs};
use realo_results::read_run;
use realo_schemas::geometry::PoseTrack;
use realo_schemas::{Nanos, PointCloud};
use serde::Serialize;

use crate::scenes::{PoseRow, Scenes};
use crate::{PageError, Request, Watch};

/// Length of a step, m; 16 bits reach 655 m.
const STEP: f32 = 0.02;
/// Bytes of base64 for a point of three numbers of 16 bits.
const POINT_BYTES: usize = 8;
/// Bytes that say whose a sweep is, of which time and where; about.
const INDEX_BYTES: usize = 100;
/// Sweeps so near to one of the ego are on the page.
const NEAR: Nanos = 60_000_000;
/// Points are thinned on cells of this side first, m, and then of ever larger ones.
const CELL: f32 = 0.1;
const GROWTH: f32 = 1.15;
/// Points lower than this above an agent's ground are thinned on cells that are larger by this factor: they say least.
const GROUND_M: f32 = 0.3;
const GROUND_CELLS: f32 = 4.0;
/// Points on objects are thinned on cells that are smaller by this factor: they are what one looks at.
const OBJECT_CELLS: f32 = 0.2;
/// Side of the squares on the map that say where objects are, m.
const SQUARE: f64 = 1.0;

/// Where a sweep's points are in the text.
#[derive(Debug, Serialize)]
pub struct CloudPart {
    pub log: String,
    pub agent: String,
    /// ms, as the scenes of the log.
    pub t: i64,
    /// x, y, z of the place that steps count from, cm, as poses of the scene.
    pub from: [i64; 3],
    /// First letter and letters.
    pub text: [usize; 2],
}

/// Sweeps as texts of base64: x, y, z, x, y, z … as i16, little-endian, steps of 2 cm.
#[derive(Debug, Default)]
pub struct Points {
    pub index: Vec<CloudPart>,
    pub text: String,
    pub count: usize,
}

impl Points {
    /// Reads the sweeps of all agents that are near the sweeps of the scenes.
    ///
    /// # Errors
    /// A log that is gone or cannot be read.
    pub fn read(
        scenes: &Scenes,
        request: &Request,
        left_out: &mut Vec<String>,
        watch: &Watch,
    ) -> Result<Self, PageError> {
        need_logs(scenes, request)?;
        // By log: the agents and the stamps of all its egos.
        let mut wanted: BTreeMap<String, (BTreeSet<String>, BTreeSet<i64>, bool)> = BTreeMap::new();
        for scene in &scenes.parts {
            let (agents, times, exact) = wanted
                .entry(scene.log.clone())
                .or_insert_with(|| (BTreeSet::new(), BTreeSet::new(), true));
            agents.extend(scene.agents.iter().map(|agent| agent.name.clone()));
            times.extend(scene.frames.values().map(|frame| frame.t));
            *exact &= scene.exact;
        }
        // Counted before the first is read, as each has the same share.
        let mut sweeps: usize = 0;
        for (name, (agents, times, _)) in &wanted {
            let Some(Some(log)) = scenes.logs.get(name) else {
                continue;
            };
            let (_, start) = scenes.origins[name];
            for (number, agent) in agents.iter().enumerate() {
                watch(
                    &format!("counting the sweeps of {agent} in {name}"),
                    number,
                    agents.len(),
                );
                if !log.has(agent, Stream::Points) {
                    continue;
                }
                let mut reader = log.read_all(&[(agent, Stream::Points)])?;
                while let Some(entry) = reader.next()? {
                    sweeps += usize::from(is_near(times, (entry.stamp() - start) / 1_000_000));
                }
            }
        }
        let room = request.most_point_bytes.saturating_sub(sweeps * INDEX_BYTES);
        let most = room / POINT_BYTES / sweeps.max(1);
        let mut points = Points::default();
        let mut largest = 0.0f32;
        for (name, (agents, times, exact)) in &wanted {
            let Some(Some(log)) = scenes.logs.get(name) else {
                continue;
            };
            let (origin, start) = scenes.origins[name];
            let objects = Objects::of(scenes, name);
            for (number, agent) in agents.iter().enumerate() {
                watch(
                    &format!("reading the points of {agent} in {name}"),
                    number,
                    agents.len(),
                );
                let stream = match *exact && log.has(agent, Stream::PoseTruth) {
                    true => Stream::PoseTruth,
                    false => Stream::Pose,
                };
                if !log.has(agent, Stream::Points) || !log.has(agent, stream) {
                    left_out.push(format!(
                        "the log `{name}` has no points or poses of agent `{agent}`: the player shows none"
                    ));
                    continue;
                }
                let track = pose_track(log, agent, stream, MAX_GAP)?;
                let mut cell = CELL;
                let mut reader = log.read_all(&[(agent, Stream::Points)])?;
                while let Some(entry) = reader.next()? {
                    let stamp = entry.stamp();
                    let t = (stamp - start) / 1_000_000;
                    let Some(pose) = track.at(stamp).filter(|_| is_near(times, t)) else {
                        continue;
                    };
                    let (from, cloud) = placed(&entry.cloud()?, stamp, &track, &pose, origin);
                    let near_object = objects.at(t);
                    let is_object = |point: &[f32; 3]| {
                        let [x, y] = [from.x + f64::from(point[0]), from.y + f64::from(point[1])];
                        near_object.is_some_and(|squares| squares.contains(&square(x, y)))
                    };
                    let (side, cloud) = thinned(cloud, most, cell, is_object);
                    largest = largest.max(side);
                    // The next sweep needs about the same.
                    cell = (side / GROWTH).max(CELL);
                    points.add(name, agent, t, centimetres(from), &cloud);
                }
            }
        }
        if largest > 0.0 {
            left_out.push(format!(
                "points are thinned to one in a cell of {largest:.2} m, on the ground of {:.1} m, so that they stay below {} MB",
                GROUND_CELLS * largest,
                request.most_point_bytes / 1_000_000
            ));
        }
        Ok(points)
    }

    fn add(&mut self, log: &str, agent: &str, t: i64, from: [i64; 3], cloud: &[[f32; 3]]) {
        let bytes: Vec<u8> = steps(cloud).collect();
        let begin = self.text.len();
        base64(&bytes, &mut self.text);
        self.count += cloud.len();
        self.index.push(CloudPart {
            log: log.into(),
            agent: agent.into(),
            t,
            from,
            text: [begin, self.text.len() - begin],
        });
    }
}

/// A sweep in the axes of the map, without the agent's own motion; and the place near the agent that it counts from, m from the
/// origin of the scene.
pub fn placed(
    cloud: &PointCloud,
    stamp: Nanos,
    track: &PoseTrack,
    map_from_agent: &Isometry3<f64>,
    origin: Vector3<f64>,
) -> (Vector3<f64>, Vec<[f32; 3]>) {
    let from = (map_from_agent.translation.vector - origin).map(|metres| (metres * 100.0).round() / 100.0);
    let map_from_here = Isometry3::from_parts(Translation3::from(from + origin), UnitQuaternion::identity());
    (from, in_ego_frame(cloud, stamp, track, &map_from_here, map_from_agent))
}

pub fn centimetres(place: Vector3<f64>) -> [i64; 3] {
    [place.x, place.y, place.z].map(|metres| (metres * 100.0).round() as i64)
}

/// Points as the page takes them: x, y, z, x, y, z … as i16, little-endian, steps of 2 cm.
pub fn steps(cloud: &[[f32; 3]]) -> impl Iterator<Item = u8> {
    cloud
        .iter()
        // A cast saturates.
        .flat_map(|point| point.map(|metres| (metres / STEP).round() as i16))
        .flat_map(i16::to_le_bytes)
}

/// A page with points needs every log.
fn need_logs(scenes: &Scenes, request: &Request) -> Result<(), PageError> {
    let missing: Vec<&String> = scenes
        .logs
        .iter()
        .filter(|(_, log)| log.is_none())
        .map(|(name, _)| name)
        .collect();
    let Some(name) = missing.first() else {
        return Ok(());
    };
    let mut tried: Vec<String> = request.log.iter().map(|path| path.display().to_string()).collect();
    for (_, folder) in &request.runs {
        for single in single_runs(folder)? {
            let run = read_run(&single)?;
            if run.result.logs.first() == Some(*name) {
                tried.extend(
                    run.log_candidates(&request.log_folders)
                        .iter()
                        .map(|path| path.display().to_string()),
                );
            }
        }
    }
    tried.sort();
    tried.dedup();
    // A file that is there under this name may be of another run.
    if let Some(path) = &request.log {
        Log::open(path)?;
    }
    Err(RenderError::NoLog {
        name: (*name).clone(),
        tried: tried.join(", "),
    }
    .into())
}

/// Whether a sweep at a time is near one of these times, ms.
fn is_near(times: &BTreeSet<i64>, t: i64) -> bool {
    let near = NEAR / 1_000_000;
    times.range(t - near..=t + near).next().is_some()
}

/// So many points at most, in the order of the sweep; and the side of the cells that took it, m; 0 where all are kept.
/// `cell`: the side to begin with.
fn thinned(
    cloud: Vec<[f32; 3]>,
    most: usize,
    mut cell: f32,
    is_object: impl Fn(&[f32; 3]) -> bool,
) -> (f32, Vec<[f32; 3]>) {
    let reach = STEP * f32::from(i16::MAX);
    let near = |point: &[f32; 3]| point.iter().all(|metres| metres.abs() < reach);
    let mut kept: Vec<[f32; 3]> = cloud.into_iter().filter(near).collect();
    if kept.len() <= most {
        return (0.0, kept);
    }
    loop {
        let mut taken: HashSet<u64, BuildHasherDefault<CellHasher>> = HashSet::default();
        // Three numbers of 21 bits: no cell is further from the middle than 655 m / 0.02 m.
        let number = |point: &[f32; 3]| {
            let is_ground = point[2] < GROUND_M;
            let side = match is_ground {
                true => GROUND_CELLS * cell,
                false if is_object(point) => OBJECT_CELLS * cell,
                false => cell,
            };
            let cells = point.map(|metres| (metres / side).floor() as i64 as u64 & 0x1f_ffff);
            u64::from(is_ground) << 63 | cells[0] << 42 | cells[1] << 21 | cells[2]
        };
        kept.retain(|point| taken.insert(number(point)));
        // Beyond this the few that are left are in cells of their own, on the ground or around the origin.
        if cell > 2.0 * reach {
            kept.truncate(most);
        }
        if kept.len() <= most {
            return (cell, kept);
        }
        cell *= GROWTH;
    }
}

/// Where on the map the objects are, by the times of the sweeps that name them, ms.
struct Objects(BTreeMap<i64, HashSet<(i32, i32)>>);

fn square(x: f64, y: f64) -> (i32, i32) {
    ((x / SQUARE).floor() as i32, (y / SQUARE).floor() as i32)
}

impl Objects {
    fn of(scenes: &Scenes, log: &str) -> Self {
        let mut all = BTreeMap::new();
        for frame in scenes
            .parts
            .iter()
            .filter(|scene| scene.log == log)
            .flat_map(|scene| scene.frames.values())
        {
            let Some(Some(ego)) = frame.poses.first() else { continue };
            let squares: &mut HashSet<_> = all.entry(frame.t).or_default();
            for (row, _) in &frame.objects {
                cover(ego, row, squares);
            }
        }
        Objects(all)
    }

    /// The squares with objects about this time.
    fn at(&self, t: i64) -> Option<&HashSet<(i32, i32)>> {
        let near = NEAR / 1_000_000;
        let around = self.0.range(t - near..=t + near);
        around.min_by_key(|(at, _)| (*at - t).abs()).map(|(_, squares)| squares)
    }
}

/// Adds the squares under an object's outline.
fn cover(ego: &PoseRow, row: &[i32], squares: &mut HashSet<(i32, i32)>) {
    let metres = |at: usize| f64::from(row[at]) / 100.0;
    let turned = |[x, y]: [f64; 2], yaw: f64| {
        let (sin, cos) = (libm::sin(yaw), libm::cos(yaw));
        [cos * x - sin * y, sin * x + cos * y]
    };
    let [length, width] = [metres(4), metres(5)].map(|side| side.min(100.0));
    let steps = |side: f64| (side / (0.5 * SQUARE)).ceil().max(1.0) as i32;
    for along in 0..=steps(length) {
        for across in 0..=steps(width) {
            let place = [
                length * (f64::from(along) / f64::from(steps(length)) - 0.5),
                width * (f64::from(across) / f64::from(steps(width)) - 0.5),
            ];
            let [x, y] = turned(place, f64::from(row[7]) / 1000.0);
            let [x, y] = turned([x + metres(1), y + metres(2)], ego[3] as f64 / 1000.0);
            squares.insert(square(x + ego[0] as f64 / 100.0, y + ego[1] as f64 / 100.0));
        }
    }
}

/// Spreads the numbers of cells; nobody can choose them to collide on purpose and gain by it.
#[derive(Default)]
struct CellHasher(u64);

impl Hasher for CellHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.write_u64(u64::from(*byte)));
    }

    fn write_u64(&mut self, number: u64) {
        let mixed = (self.0 ^ number).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 = mixed ^ mixed >> 32;
    }
}

const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

fn base64(bytes: &[u8], out: &mut String) {
    out.reserve(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let byte = |at: usize| u32::from(three.get(at).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for letter in 0..4 {
            match letter <= three.len() {
                true => out.push(char::from(LETTERS[(bits >> (18 - 6 * letter) & 63) as usize])),
                false => out.push('='),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_is_that_of_its_standard() {
        // RFC 4648, section 10.
        for (plain, coded) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foobar", "Zm9vYmFy"),
        ] {
            let mut text = String::new();
            base64(plain.as_bytes(), &mut text);
            assert_eq!(text, coded);
        }
    }

    #[test]
    fn points_are_those_that_the_page_reads() {
        // `player.test.mjs` has the same text.
        let mut points = Points::default();
        points.add(
            "log",
            "cav1",
            0,
            [1000, -500, 20],
            &[[1.0, -2.0, 0.5], [0.02, 655.34, -655.36]],
        );
        assert_eq!(points.text, "MgCc/xkAAQD/fwCA");
        assert_eq!((points.count, points.index[0].text), (2, [0, 16]));
    }

    #[test]
    fn objects_keep_more_points_than_walls() {
        let cloud: Vec<[f32; 3]> = (0..10_000).map(|i| [i as f32 * 0.01, 0.0, 1.0]).collect();
        let on_object = |point: &[f32; 3]| (10.0..14.0).contains(&point[0]);
        let (_, thin) = thinned(cloud, 200, CELL, on_object);
        let kept = thin.iter().filter(|point| on_object(point)).count();
        assert!(kept > 3 * thin.len() * 4 / 100, "{kept} of {}", thin.len());
    }

    #[test]
    fn an_object_covers_the_squares_under_it() {
        let mut squares = HashSet::new();
        // At (10, 0) in front of an ego that looks along y from (100, 50): at (100, 60), 4 m along y, 1 m wide.
        let row = [0, 1000, 0, 80, 400, 100, 150, 0, -1, 1];
        cover(&[10_000, 5_000, 0, 1571], &row, &mut squares);
        assert!(squares.contains(&square(100.2, 61.5)) && squares.contains(&square(99.8, 58.5)));
        assert!(!squares.contains(&square(103.0, 60.0)) && !squares.contains(&square(100.0, 64.0)));
    }

    #[test]
    fn every_sweep_near_one_of_the_ego_counts() {
        let egos = BTreeSet::from([0, 100, 200]);
        let twice_as_often: Vec<i64> = (-100..=300).step_by(50).filter(|t| is_near(&egos, *t)).collect();
        assert_eq!(twice_as_often, [-50, 0, 50, 100, 150, 200, 250]);
        assert!(!is_near(&BTreeSet::new(), 0));
    }

    #[test]
    fn the_smallest_share_is_kept_too() {
        let place = |i: i32, z: f32| [if i % 2 == 0 { 600.0 } else { -600.0 }, i as f32 - 50.0, z];
        let cloud: Vec<[f32; 3]> = (0..100).map(|i| place(i, (i % 3) as f32)).collect();
        for most in [0, 1, 3, 63] {
            let (_, thin) = thinned(cloud.clone(), most, CELL, |_| false);
            assert!(thin.len() <= most, "{} of {most}", thin.len());
        }
    }

    #[test]
    fn a_sweep_is_thinned_to_its_share_and_keeps_its_extent() {
        let cloud: Vec<[f32; 3]> = (0..10_000).map(|i| [i as f32 * 0.01, 0.0, 1.0]).collect();
        let (cell, thin) = thinned(cloud.clone(), 200, CELL, |_| false);
        assert!(cell > 0.4 && thin.len() <= 200 && thin.len() > 100);
        assert_eq!(thin[0], cloud[0]);
        assert!(thin.last().unwrap()[0] > 99.0);
        assert_eq!(thinned(cloud.clone(), 10_000, CELL, |_| false), (0.0, cloud));
        assert!(
            thinned(vec![[9000.0, 0.0, 0.0]], 10, CELL, |_| false).1.is_empty(),
            "further than the steps reach"
        );
    }
}

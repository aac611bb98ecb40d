//! Label files of OPV2V: the poses of an agent and the boxes at a frame, left-handed.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use nalgebra::{Isometry3, Point3, Translation3};
use realo_logs::AgentKind;
use realo_schemas::Box3;

use crate::places::{mirrored, number, numbers, six};
use crate::scene::{SceneAgent, Sweep, center_in_map, map_from_object, speed};

/// Boxes without a track that two agents have within so many metres are one object.
const SAME_OBJECT: f64 = 1.0;
/// Tracks from here on are those of texts: an id above them could be mistaken for one.
const TEXTS: u64 = 1 << 63;
/// Frames in which sweeps of other agents may still come.
const OPEN_FRAMES: usize = 32;

/// The label file of a sweep; `ids`: of its boxes.
pub fn yaml(agent: &SceneAgent, sweep: &Sweep, ids: &[u64]) -> String {
    let map_from_lidar = sweep.map_from_body * agent.lidar_from_body().inverse();
    let speed = agent
        .track
        .motion_at(sweep.stamp)
        .map_or(0.0, |(velocity, _)| velocity.norm());
    let name = serde_json::to_string(&agent.name).expect("a text is plain data");
    let mut text = format!(
        "agent_name: {name}\nego_speed: {}\nlidar_height: {}\nlidar_pose: [{}]\nstamp_ns: {}\ntrue_ego_pos: [{}]\n",
        number(3.6 * speed),
        number(agent.height),
        pose(&map_from_lidar),
        sweep.stamp,
        pose(&sweep.map_from_body),
    );
    if let Some(outline) = agent.stated_footprint {
        text += &format!("footprint: [{}]\n", numbers(&outline));
    }
    if agent.kind == AgentKind::Roadside {
        text += "RSU: true\n";
    }
    if !sweep.is_scored {
        text += "scored: false\n";
    }
    if sweep.boxes.is_empty() {
        text += "vehicles: {}\n";
        return text;
    }
    text += "vehicles:\n";
    for (index, (id, object)) in ids.iter().zip(&sweep.boxes).enumerate() {
        vehicle(&mut text, *id, object, &sweep.map_from_body);
        if let Some(points) = sweep.points.as_ref().and_then(|points| points.get(index)) {
            // Writing to a text does not fail.
            let _ = writeln!(text, "    points: {points}");
        }
    }
    text
}

fn pose(pose: &Isometry3<f64>) -> String {
    numbers(&six(&mirrored(pose)))
}

fn vehicle(text: &mut String, id: u64, object: &Box3, map_from_body: &Isometry3<f64>) {
    let half = object.height / 2.0;
    let ground = map_from_object(map_from_body, object) * Translation3::new(0.0, 0.0, -half);
    let [x, y, z, roll, yaw, pitch] = six(&mirrored(&ground));
    let extent = [object.length, object.width, object.height].map(|edge| edge / 2.0);
    let class = serde_json::to_string(&*object.class).expect("a text is plain data");
    // Writing to a text does not fail.
    let _ = write!(
        text,
        "  {id}:\n    angle: [{}]\n    center: [{}]\n    extent: [{}]\n    location: [{}]\n    obj_type: {class}\n",
        numbers(&[roll, yaw, pitch]),
        numbers(&[0.0, 0.0, half]),
        numbers(&extent),
        numbers(&[x, y, z]),
    );
    if let Some((along, _)) = speed(object) {
        let _ = writeln!(text, "    speed: {}", number(3.6 * along));
    }
}

/// Ids of boxes: their tracks, or for those without one a number of their frame alone.
pub struct Ids {
    /// The first number that is no track.
    free: u64,
    /// What has such a number in the last frames.
    frames: BTreeMap<u64, Vec<Point3<f64>>>,
    /// Boxes without a track.
    pub without_track: usize,
}

impl Ids {
    /// Beside these tracks and folders of agents.
    pub fn new(tracks: &BTreeSet<u64>, folders: &[String]) -> Self {
        let folders = folders.iter().filter_map(|folder| folder.parse().ok());
        let numbers = tracks.iter().copied().chain(folders).filter(|track| *track < TEXTS - 1);
        Ids {
            free: numbers.max().map_or(1, |most| most + 1),
            frames: BTreeMap::new(),
            without_track: 0,
        }
    }

    /// The id of each box of a sweep, no two the same.
    pub fn of(&mut self, frame: u64, sweep: &Sweep) -> Vec<u64> {
        let mut taken = BTreeSet::new();
        let mut id = |object: &Box3| {
            if let Some(track) = object.track.filter(|track| taken.insert(*track)) {
                return track;
            }
            self.without_track += 1;
            let center = center_in_map(&sweep.map_from_body, object);
            let known = self.frames.entry(frame).or_default();
            let is_free = |index: usize, taken: &BTreeSet<u64>| !taken.contains(&(self.free + index as u64));
            let near = known.iter().map(|other| (other - center).norm()).enumerate();
            let near = near.filter(|(index, apart)| *apart <= SAME_OBJECT && is_free(*index, &taken));
            let index = near.min_by(|(_, a), (_, b)| a.total_cmp(b)).map(|(index, _)| index);
            let index = index.unwrap_or_else(|| {
                known.push(center);
                known.len() - 1
            });
            let id = self.free + index as u64;
            taken.insert(id);
            id
        };
        let ids = sweep.boxes.iter().map(&mut id).collect();
        while self.frames.len() > OPEN_FRAMES {
            self.frames.pop_first();
        }
        ids
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::PointCloud;

    use super::*;

    fn sweep(boxes: &[(f64, Option<u64>)], x: f64) -> Sweep {
        let object = |(at, track): &(f64, Option<u64>)| {
            let mut object = Box3::new("Car", [at - x, 0.0, 0.75], [4.0, 2.0, 1.5], 0.0);
            object.track = *track;
            object
        };
        Sweep {
            agent: 0,
            stamp: 0,
            map_from_body: Isometry3::translation(x, 0.0, 0.0),
            cloud: PointCloud::empty(),
            boxes: boxes.iter().map(object).collect(),
            points: None,
            is_scored: true,
        }
    }

    #[test]
    fn boxes_without_tracks_of_two_agents_are_one_object_where_they_are_near() {
        let mut ids = Ids::new(&[7, 9].into(), &["12".into(), "-1".into()]);
        assert_eq!(
            ids.of(0, &sweep(&[(5.0, Some(7)), (10.0, None), (20.0, None)], 0.0)),
            [7, 13, 14]
        );
        assert_eq!(ids.of(0, &sweep(&[(20.3, None), (30.0, None)], 8.0)), [14, 15]);
        assert_eq!(
            ids.of(1, &sweep(&[(30.0, None)], 8.0)),
            [13],
            "a frame has numbers of its own"
        );
        assert_eq!(
            ids.of(2, &sweep(&[(1.0, Some(9)), (2.0, Some(9))], 0.0)),
            [9, 13],
            "no id is there twice"
        );
        assert_eq!(ids.without_track, 6);
    }

    #[test]
    fn a_box_is_on_its_location_and_left_handed() {
        let mut text = String::new();
        let mut object = Box3::new("Car \"x\"", [10.0, 2.0, 0.75], [4.0, 2.0, 1.5], 0.5);
        object.velocity = Some([3.0, 4.0, 0.0]);
        vehicle(&mut text, 7, &object, &Isometry3::translation(100.0, 0.0, 0.0));
        for line in [
            "  7:\n",
            "center: [0.0, 0.0, 0.75]",
            "extent: [2.0, 1.0, 0.75]",
            "location: [110.0, -2.0, 0.0]",
            "obj_type: \"Car \\\"x\\\"\"",
        ] {
            assert!(text.contains(line), "{line} is not in\n{text}");
        }
        assert!(text.contains("angle: [0.0, -28.64788975654"), "{text}");
    }
}

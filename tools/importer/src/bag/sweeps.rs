//! The sweeps of an agent, in its body frame, in the order of time.

use std::collections::{BTreeSet, VecDeque};

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use realo_bags::Messages;
use realo_bags::map_file::{Height, StampClock};
use realo_logs::cloud::{CloudReader, Reading};
use realo_logs::{Frames, kind_of_clock, side};
use realo_schemas::geometry::{level_from_body, tilt_degrees};
use realo_schemas::{Nanos, PointCloud, to_seconds};

use super::agents::Agent;
use super::clocks::{AgentClock, ONE_CLOCK};
use super::heads::{Heads, stamp_of};
use super::track::Track;
use super::{Counted, Import};
use crate::ImportError;
use crate::level::{Plane, by_pose};

/// Sweeps wait for those of other topics, at most so many.
const WAITING: usize = 8;
/// Sweeps of two topics of an agent are one if their stamps are so near, ns.
const TOGETHER: Nanos = 60_000_000;

/// A sweep.
pub struct Sweep {
    /// As the bag has it, ns.
    pub stamp: Nanos,
    /// When it was there, by the clock of the log, ns.
    pub ready: Nanos,
    /// In the body frame.
    pub cloud: PointCloud,
    /// Where the body is.
    pub world_from_body: Isometry3<f64>,
    /// What was levelled, degrees.
    pub tilt: f64,
}

/// Reads the sweeps of an agent.
pub struct Sweeps<'a> {
    import: &'a Import,
    agent: &'a Agent,
    frames: &'a Frames,
    track: &'a Track,
    heads: &'a [Heads],
    clock: AgentClock,
    height: f64,
    messages: Box<dyn Messages + 'a>,
    has_ended: bool,
    /// Sweeps of the first topic, which wait for those of the others.
    waiting: VecDeque<Sweep>,
    /// Clouds of the others, by topic.
    others: Vec<VecDeque<Sweep>>,
    last: Option<Nanos>,
    /// Intensities that were limited.
    pub limited: u64,
    /// Messages that were read.
    pub read: u64,
    /// Clouds without a stamp, by topic, where stamps of headers count.
    pub unstamped: Vec<u64>,
    /// Sweeps without a cloud of a topic beside the first, by topic.
    pub lacking: Vec<u64>,
    /// Sweeps that were given.
    pub joined: u64,
    /// Stamp and log time of the first sweep that no pose is near.
    unposed: Option<[Nanos; 2]>,
}

impl<'a> Sweeps<'a> {
    /// Begins to read.
    pub fn new(
        import: &'a Import,
        place: usize,
        frames: &'a Frames,
        track: &'a Track,
        heads: &'a [Heads],
        clock: AgentClock,
        height: f64,
    ) -> Result<Self, ImportError> {
        let agent = &import.agents[place];
        let wanted: BTreeSet<usize> = agent.clouds.iter().map(|topic| topic.connection).collect();
        Ok(Sweeps {
            import,
            agent,
            frames,
            track,
            heads,
            clock,
            height,
            messages: import.joined.bags[agent.bag].messages(&wanted)?,
            has_ended: false,
            waiting: VecDeque::new(),
            others: agent.clouds.iter().map(|_| VecDeque::new()).collect(),
            last: None,
            limited: 0,
            read: 0,
            unstamped: vec![0; agent.clouds.len()],
            lacking: vec![0; agent.clouds.len()],
            joined: 0,
            unposed: None,
        })
    }

    /// The next sweep; `None` after the last.
    pub fn next(&mut self, faults: &mut Counted) -> Result<Option<Sweep>, ImportError> {
        loop {
            if let Some(first) = self.waiting.front() {
                let has_all = self.others[1..]
                    .iter()
                    .all(|clouds| clouds.back().is_some_and(|cloud| cloud.stamp >= first.stamp));
                if has_all || self.has_ended || self.waiting.len() > WAITING {
                    let sweep = self.waiting.pop_front();
                    return Ok(sweep.map(|sweep| self.joined(sweep)));
                }
            } else if self.has_ended {
                return Ok(None);
            }
            self.read_one(faults)?;
        }
    }

    fn read_one(&mut self, faults: &mut Counted) -> Result<(), ImportError> {
        let Some(message) = self.messages.next()? else {
            self.has_ended = true;
            return Ok(());
        };
        self.read += 1;
        let topic = self
            .agent
            .clouds
            .iter()
            .position(|topic| topic.connection == message.connection);
        let topic = topic.expect("only topics of clouds are read");
        let connection = &self.import.joined.bags[self.agent.bag].connections()[message.connection];
        let read = connection
            .reader_of(&message)
            .and_then(|mut input| CloudReader::read(&mut input))
            .and_then(|reader| self.placed(reader, topic, message.log_time));
        let sweep = match read {
            Ok(sweep) => sweep,
            Err(reason) => {
                faults.add(&connection.topic, reason);
                return Ok(());
            }
        };
        if topic > 0 {
            let clouds = &mut self.others[topic];
            clouds.push_back(sweep);
            if clouds.len() > 2 * WAITING {
                clouds.pop_front();
            }
        } else if self.last.is_some_and(|last| sweep.stamp <= last) {
            faults.add(&connection.topic, "its stamp does not lie behind the one before".into());
        } else {
            self.last = Some(sweep.stamp);
            self.waiting.push_back(sweep);
        }
        Ok(())
    }

    fn placed(&mut self, mut reader: CloudReader, topic: usize, log_time: Nanos) -> Result<Sweep, String> {
        let clock = self.import.map.clock;
        self.unstamped[topic] += u64::from(reader.stamp == 0 && clock == StampClock::Header);
        let stamp = stamp_of(clock, reader.stamp, log_time);
        if !self.heads[topic].by_header {
            reader.stamp = stamp;
        }
        let moved = stamp.saturating_add(self.clock.stamp);
        if moved < 0 {
            return Err("its stamp is before 1970".into());
        }
        let Some(world_from_frame) = self.track.at(stamp) else {
            self.unposed.get_or_insert([stamp, log_time]);
            return Err("no pose is near its stamp".into());
        };
        let frame_from_lidar = self.agent.map.mount(self.frames, reader.frame, stamp)?;
        let body_from_frame = by_pose(&world_from_frame.rotation, self.height);
        let reading = Reading {
            scale: self.heads[topic].scale,
            times: self.heads[topic].times,
            to: Some(body_from_frame * frame_from_lidar),
        };
        let (cloud, limited) = reader.cloud(&reading)?;
        self.limited += limited;
        let end = cloud.time.iter().copied().max().unwrap_or(0).max(0);
        let ready = log_time
            .saturating_add(self.clock.ready)
            .max(moved.saturating_add(end.into()));
        Ok(Sweep {
            stamp,
            ready,
            cloud,
            world_from_body: world_from_frame * body_from_frame.inverse(),
            tilt: tilt_degrees(&world_from_frame.rotation),
        })
    }

    /// Why no pose is near the first sweep that has none, and what to try; `None` where all have one.
    pub fn why_unposed(&self) -> Option<String> {
        let times = self.unposed?;
        Some(unposed_words(
            times,
            self.track.nearest(times[0])?,
            self.import.map.clock,
        ))
    }

    /// A sweep with the nearest of the other topics.
    fn joined(&mut self, mut sweep: Sweep) -> Sweep {
        self.joined += 1;
        for (clouds, lacking) in self.others.iter_mut().zip(&mut self.lacking).skip(1) {
            let off = |cloud: &Sweep| cloud.stamp.abs_diff(sweep.stamp);
            let nearest = (0..clouds.len()).min_by_key(|place| off(&clouds[*place]));
            let nearest = nearest.filter(|place| off(&clouds[*place]) <= TOGETHER as u64);
            let Some(other) = nearest.and_then(|place| clouds.remove(place)) else {
                *lacking += 1;
                continue;
            };
            clouds.retain(|cloud| cloud.stamp > other.stamp);
            sweep.ready = sweep.ready.max(other.ready);
            sweep.cloud = both(&sweep.cloud, &other.cloud, (other.stamp - sweep.stamp) as i32);
        }
        sweep
    }
}

/// How far the nearest pose is from a sweep, whether their clocks differ, and what to try. Of both, stamp and log time, ns.
fn unposed_words([stamp, log_time]: [Nanos; 2], [pose, pose_log_time]: [Nanos; 2], clock: StampClock) -> String {
    let away = pose.saturating_sub(stamp);
    let nearest = format!(
        "the nearest pose is {:.3} s {} the first such sweep",
        to_seconds(away.saturating_abs()),
        side(away)
    );
    // When the sweep was recorded, by the clock of the poses.
    let recorded = log_time.saturating_add(pose.saturating_sub(pose_log_time));
    let ahead = stamp.saturating_sub(recorded);
    if ahead.saturating_abs() <= ONE_CLOCK || clock == StampClock::Log {
        return format!("{nearest}, and both have one clock: poses of that time are missing in the bag");
    }
    let looks = match kind_of_clock(stamp, recorded) {
        Some(kind) => format!("the clock of the clouds looks like {kind}"),
        None => "the kind of that clock is not known".into(),
    };
    format!(
        "{nearest}, and by log times the stamps of clouds are {:.3} s {} those of poses; {looks}. Try \
         `clock: log` in the map file, which takes log times as the stamps of all topics, so sweeps get late by the time until they were \
         recorded. Or correct the stamps of the clouds, and set the clock of the LiDAR for the next recording (`offset` moves clouds and poses \
         alike)",
        to_seconds(ahead.saturating_abs()),
        side(ahead)
    )
}

/// The points of two clouds; `later`: how far the stamp of the second is behind the first, ns.
fn both(one: &PointCloud, other: &PointCloud, later: i32) -> PointCloud {
    fn joined<T: Copy>(one: &[T], other: &[T]) -> Vec<T> {
        [one, other].concat()
    }
    let times: Vec<i32> = other.time.iter().map(|time| time.saturating_add(later)).collect();
    PointCloud::new(
        joined(&one.x, &other.x),
        joined(&one.y, &other.y),
        joined(&one.z, &other.z),
        joined(&one.intensity, &other.intensity),
        joined(&one.time, &times),
        joined(&one.ring, &other.ring),
    )
    .expect("all columns are of both clouds")
}

/// How high an agent's frame is over the ground, m.
///
/// # Errors
/// No ground, or nothing that places the first sweeps.
pub fn height(agent: &Agent, frames: &Frames, track: &Track, heads: &Heads) -> Result<f64, String> {
    if let Height::Meters(height) = agent.map.height {
        return Ok(height);
    }
    let (mut heights, mut reason) = (Vec::new(), None);
    for (stamp, sensor, cloud) in &heads.first {
        match over_ground(agent, frames, track, *stamp, sensor, cloud) {
            Ok(height) => heights.push(height),
            Err(error) => reason = Some(error),
        }
    }
    heights.sort_by(f64::total_cmp);
    match (heights.get(heights.len() / 2), reason) {
        (Some(height), _) => Ok(*height),
        (None, reason) => Err(format!(
            "height: {}; or write the height of `{}` over the ground: `height: 0` if that frame is on the ground, else as `height: 0.3`",
            reason.unwrap_or_else(|| "there is no sweep".into()),
            agent.map.frame
        )),
    }
}

fn over_ground(
    agent: &Agent,
    frames: &Frames,
    track: &Track,
    stamp: Nanos,
    sensor: &str,
    cloud: &PointCloud,
) -> Result<f64, String> {
    let frame_from_lidar = agent.map.mount(frames, sensor, stamp)?;
    let level: UnitQuaternion<f64> = track
        .at(stamp)
        .map_or_else(UnitQuaternion::identity, |pose| level_from_body(&pose.rotation));
    let turn = level * frame_from_lidar.rotation;
    let points = cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter());
    let points: Vec<[f64; 3]> = points
        .map(|((x, y), z)| {
            let point = turn * Vector3::new(f64::from(*x), f64::from(*y), f64::from(*z));
            [point.x, point.y, point.z]
        })
        .collect();
    let ground = Plane::of_ground_or_zero(&points).map_err(|reason| {
        // What helps there is another option.
        reason.split("; take --level").next().unwrap_or_default().to_string()
    })?;
    let lidar = level * (frame_from_lidar * Point3::origin());
    Ok(-ground.offset - lidar.z)
}

//! What is known of one agent: its recent poses, and the sweeps that wait for theirs.

use std::collections::VecDeque;

use nalgebra::Vector3;
use realo_schemas::geometry::{Motion, PoseTrack};
use realo_schemas::{AgentState, Header, Nanos, PointCloud, PoseStatus};

/// Poses older than the newest one are kept for so long, ns.
const KEEP: Nanos = 2_000_000_000;

/// Sweeps that may wait at the same time.
const WAITING: usize = 8;

/// Sweeps that were given up and of which it is open whether their pose comes late or never; of more the oldest have none.
const UNPOSED: usize = 64;

type Covariance = Option<Box<[f64; 36]>>;

/// A sweep's pose and the motion during it.
#[derive(Clone, Debug)]
pub struct Pairing {
    /// Pose and motion at the sweep's stamp.
    pub state: AgentState,
    /// The motion during the sweep, where it is known.
    pub motion: Option<Motion>,
}

/// What accompanies a pose.
#[derive(Clone, Debug)]
pub struct PosePoint {
    stamp: Nanos,
    covariance: Covariance,
    status: PoseStatus,
}

/// A sweep that was given up.
#[derive(Clone, Debug)]
pub struct Unposed {
    stamp: Nanos,
    /// Its pose became known later.
    pub is_late: bool,
    /// Why no pose was known, in words.
    pub lack: String,
}

/// One agent.
pub struct AgentTrack {
    track: PoseTrack,
    max_gap: Nanos,
    points: VecDeque<PosePoint>,
    /// Stamp of the newest sweep that was taken.
    pub newest: Option<Nanos>,
    /// Sweeps that wait, with the time at which they came; oldest first.
    pub waiting: VecDeque<(Nanos, Header, PointCloud)>,
    /// Sweeps that were given up and whose pose may still come.
    unposed: Vec<Unposed>,
}

impl AgentTrack {
    /// Nothing known yet; gaps of at most `max_gap` ns are bridged.
    pub fn new(max_gap: Nanos) -> Self {
        let (points, waiting) = (VecDeque::new(), VecDeque::new());
        AgentTrack {
            track: PoseTrack::new(KEEP, max_gap),
            max_gap,
            points,
            newest: None,
            waiting,
            unposed: Vec::new(),
        }
    }

    /// Takes a pose.
    pub fn insert(&mut self, stamp: Nanos, state: AgentState) {
        self.track.insert(stamp, state.map_from_body);
        let at = self.points.partition_point(|point| point.stamp < stamp);
        let point = PosePoint {
            stamp,
            covariance: state.covariance,
            status: state.status,
        };
        match self.points.get_mut(at) {
            Some(known) if known.stamp == stamp => *known = point,
            _ => self.points.insert(at, point),
        }
        let newest = self.track.newest().unwrap_or(stamp);
        while self
            .points
            .front()
            .is_some_and(|point| newest.saturating_sub(point.stamp) > KEEP)
        {
            self.points.pop_front();
        }
    }

    /// Pose and motion for a sweep; `None` while it should wait. One that gives up waiting takes the pose at its stamp
    /// without the motion.
    pub fn pair(&self, stamp: Nanos, span: Option<[i32; 2]>, deskew: bool, gives_up: bool) -> Option<Pairing> {
        let map_from_body = self.track.at(stamp)?;
        let [first, last] = span.unwrap_or_default().map(Nanos::from);
        let motion = if deskew {
            Motion::new(&self.track, stamp, first, last)
        } else {
            None
        };
        let rates = self.track.motion_at(stamp);
        if deskew && motion.is_none() && rates.is_some() && !gives_up {
            return None;
        }
        let (velocity, angular_rate): (Option<Vector3<f64>>, _) = rates.unzip();
        let near = self.near(stamp)?;
        let beyond = self.track.newest().is_some_and(|newest| stamp > newest);
        let status = if beyond { PoseStatus::Extrapolated } else { near.status };
        let covariance = near.covariance.clone();
        Some(Pairing {
            state: AgentState {
                map_from_body,
                covariance,
                velocity,
                angular_rate,
                status,
            },
            motion,
        })
    }

    /// Notes that a sweep is not waited for any more.
    pub fn give_up(&mut self, stamp: Nanos) {
        let lack = self.lack(stamp);
        self.unposed.push(Unposed {
            stamp,
            is_late: false,
            lack,
        });
    }

    /// The sweeps that were given up and whose pose is known by now, or can no longer become known.
    pub fn settled(&mut self) -> Vec<Unposed> {
        let newest = self.track.newest().unwrap_or(Nanos::MIN);
        let (mut settled, mut open) = (Vec::new(), Vec::new());
        for mut sweep in std::mem::take(&mut self.unposed) {
            sweep.is_late = self.track.at(sweep.stamp).is_some();
            let is_over = newest.saturating_sub(self.max_gap) > sweep.stamp;
            let list = if sweep.is_late || is_over {
                &mut settled
            } else {
                &mut open
            };
            list.push(sweep);
        }
        // Without poses nobody asks how many there are.
        let surplus = open.len().saturating_sub(UNPOSED);
        settled.extend(open.drain(..surplus));
        self.unposed = open;
        settled
    }

    /// Whether its poses are true ones.
    pub fn has_true_poses(&self) -> bool {
        let newest = self.points.back();
        newest.is_some_and(|point| point.status == PoseStatus::Truth)
    }

    /// All sweeps that were given up, at the end.
    pub fn unposed(&mut self) -> Vec<Unposed> {
        std::mem::take(&mut self.unposed)
    }

    /// What accompanies the pose nearest to a stamp; of two the earlier one.
    fn near(&self, stamp: Nanos) -> Option<&PosePoint> {
        self.points.iter().min_by_key(|point| point.stamp.abs_diff(stamp))
    }

    /// Whether the newest pose is missing `now` that by the rhythm of the last two exists, and that would tell of the motion
    /// until `last`. Where more than one is missing, poses come late or not at all.
    pub fn misses_pose(&self, last: Nanos, now: Nanos) -> bool {
        let mut stamps = self.points.iter().rev().map(|point| point.stamp);
        let (Some(newest), Some(previous)) = (stamps.next(), stamps.next()) else {
            return false;
        };
        let (period, since) = (newest.saturating_sub(previous), now.saturating_sub(newest));
        newest < last && (period..period.saturating_mul(2)).contains(&since)
    }

    /// Why no pose is known at a stamp, in words.
    pub fn lack(&self, stamp: Nanos) -> String {
        let millis = |time: Nanos| (time + 500_000) / 1_000_000;
        let bridged = millis(self.max_gap);
        let after = self.points.partition_point(|point| point.stamp < stamp);
        let at = |index: usize| self.points.get(index).map(|point| point.stamp);
        match (after.checked_sub(1).and_then(at), at(after)) {
            (None, None) => "no poses came".into(),
            (None, Some(first)) => format!("the first pose is {} ms later than the sweep", millis(first - stamp)),
            (Some(from), Some(to)) => format!("poses {} ms apart, max_gap_ms={bridged}", millis(to - from)),
            (Some(_), None) if after == 1 => "one pose came so far, at least two are needed".into(),
            (Some(last), None) => {
                let period = after.checked_sub(2).and_then(at).map_or(0, |before| last - before);
                let since = stamp - last;
                match period > self.max_gap {
                    true => format!("poses {} ms apart, max_gap_ms={bridged}", millis(period)),
                    false => format!(
                        "the last pose is {} ms earlier than the sweep, max_gap_ms={bridged}",
                        millis(since)
                    ),
                }
            }
        }
    }

    /// Lets a sweep wait that came `now`; returns one that must give up for it.
    pub fn wait(&mut self, now: Nanos, header: Header, cloud: PointCloud) -> Option<(Header, PointCloud)> {
        self.waiting.push_back((now, header, cloud));
        if self.waiting.len() <= WAITING {
            return None;
        }
        self.waiting.pop_front().map(|(_, header, cloud)| (header, cloud))
    }
}

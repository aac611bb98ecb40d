//! Chooses the messages that a viewer gets: about ten sweeps a second, each with the boxes and poses of its time.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use realo_schemas::{Message, Nanos, PayloadType};

use super::Sweeps;

/// Log time that one picture covers, ns.
const TENTH: Nanos = 100_000_000;
/// Max distance of a message's stamp from its picture's sweep, ns.
const NEAR: Nanos = 60_000_000;
/// From one picture to the next at least.
const BETWEEN: Duration = Duration::from_millis(85);
/// Pictures whose messages may still come.
const OPEN: usize = 32;

/// Lets the messages of some sweeps through.
pub(super) struct Gate {
    sweeps: Sweeps,
    /// The newest stamp so far.
    newest: Nanos,
    /// First and last stamp of each picture, the newest last; without an end while nobody knows its sweep.
    windows: VecDeque<(Nanos, Option<Nanos>)>,
    /// When the newest window was opened.
    opened: Option<Instant>,
}

impl Gate {
    pub fn new(sweeps: Sweeps) -> Self {
        Gate {
            sweeps,
            newest: Nanos::MIN,
            windows: VecDeque::new(),
            opened: None,
        }
    }

    /// Whether a message belongs to a sweep that is shown. `now`: the wall clock.
    pub fn lets_through(&mut self, message: &Message, now: Instant) -> bool {
        let stamp = message.header.stamp;
        let kind = message.payload.payload_type();
        // A pose is known between two others.
        let around = if kind == PayloadType::AgentState { NEAR } else { 0 };
        match self.sweeps {
            Sweeps::OneOf(all) => {
                let is_seen = |stamp: Nanos| stamp.div_euclid(TENTH).rem_euclid(Nanos::from(all.max(1))) == 0;
                is_seen(stamp) || is_seen(stamp - around) || is_seen(stamp + around)
            }
            Sweeps::ByClock => {
                self.open(now);
                // Poses are ahead of sweeps, which come at their end.
                if kind != PayloadType::AgentState {
                    self.newest = self.newest.max(stamp);
                    if let Some((first, end @ None)) = self.windows.back_mut()
                        && *first <= stamp
                    {
                        *end = Some(stamp + NEAR);
                    }
                }
                let mut windows = self.windows.iter();
                windows.any(|(first, end)| *first <= stamp + around && end.is_none_or(|end| stamp - around <= end))
            }
        }
    }

    /// Begins a new picture with what comes next, if it is time for one.
    fn open(&mut self, now: Instant) {
        let has_sweep = self.windows.back().is_none_or(|(_, end)| end.is_some());
        if has_sweep && self.opened.is_none_or(|opened| now - opened >= BETWEEN) {
            self.windows.push_back((self.newest.saturating_add(1), None));
            self.opened = Some(now);
            if self.windows.len() > OPEN {
                self.windows.pop_front();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;
    use realo_schemas::{AgentState, Boxes, Header, Kind, Payload, PointCloud, PoseStatus};

    use super::*;

    const MILLI: Nanos = 1_000_000;

    fn at(stamp: Nanos, payload: impl Into<Payload>) -> Message {
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Points, 0, stamp, stamp);
        Message::new(header, payload)
    }

    fn state_at(stamp: Nanos) -> Message {
        let state = AgentState {
            map_from_body: Isometry3::identity(),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Recorded,
        };
        at(stamp, state)
    }

    /// Stamps of sweeps and of boxes that are seen of a log that is played so many times as fast as the wall clock; boxes come 300
    /// ms after their sweep.
    fn seen(sweeps: Sweeps, times: u32, seconds: Nanos) -> (Vec<Nanos>, Vec<Nanos>) {
        let (mut gate, begun) = (Gate::new(sweeps), Instant::now());
        let (mut clouds, mut boxes) = (Vec::new(), Vec::new());
        for tenth in 0..10 * seconds {
            let stamp = tenth * TENTH;
            let now = begun + Duration::from_nanos(stamp as u64) / times;
            for state in 0..10 {
                // They are stamped later than the sweep that comes with them.
                gate.lets_through(&state_at(stamp + state * TENTH / 10), now);
            }
            if gate.lets_through(&at(stamp, PointCloud::empty()), now) {
                clouds.push(tenth);
            }
            if tenth >= 3 && gate.lets_through(&at(stamp - 3 * TENTH, Boxes::default()), now) {
                boxes.push(tenth - 3);
            }
        }
        (clouds, boxes)
    }

    #[test]
    fn at_the_pace_of_a_log_all_is_seen() {
        for sweeps in [Sweeps::ByClock, Sweeps::OneOf(1)] {
            let (clouds, boxes) = seen(sweeps, 1, 10);
            assert!(clouds.iter().copied().eq(0..100), "{sweeps:?}: {clouds:?}");
            assert!(boxes.iter().copied().eq(0..97), "{sweeps:?}: {boxes:?}");
        }
    }

    #[test]
    fn of_a_fast_run_ten_pictures_a_second_are_seen_each_with_its_boxes() {
        for times in [2, 7, 50] {
            let (clouds, boxes) = seen(Sweeps::ByClock, times, 100);
            let wall_tenths = 1000 / times as usize;
            assert!(
                (wall_tenths * 8 / 10..=wall_tenths * 13 / 10).contains(&clouds.len()),
                "{times}: {} of {wall_tenths}",
                clouds.len()
            );
            assert!(boxes.len() + 3 >= clouds.len(), "{times}");
            assert!(boxes.iter().all(|tenth| clouds.contains(tenth)));
        }
        let (clouds, boxes) = seen(Sweeps::OneOf(4), 4, 10);
        assert!(clouds.iter().copied().eq((0..100).step_by(4)) && boxes.iter().all(|tenth| tenth % 4 == 0));
    }

    #[test]
    fn what_comes_around_a_sweep_belongs_to_it() {
        let (mut gate, now) = (Gate::new(Sweeps::ByClock), Instant::now());
        assert!(gate.lets_through(&at(0, PointCloud::empty()), now));
        assert!(gate.lets_through(&at(50 * MILLI, PointCloud::empty()), now));
        assert!(!gate.lets_through(&at(70 * MILLI, PointCloud::empty()), now));
    }
}

//! What motion sensors measured, as it is played: with each sweep all that has arrived since the one before.

use realo_logs::{Entry, LogError};
use realo_schemas::motion::Taken;
use realo_schemas::{Kind, Motion, Nanos};

use super::Feed;
use crate::Output;
use crate::counters::MOTION_UNUSABLE;

/// Measurements wait at most so long for a sweep, in log time, ns.
const PATIENCE: Nanos = 200_000_000;

/// What an agent's sensors measured and no message has yet; times are those of the log.
#[derive(Default)]
pub(super) struct Waiting {
    motion: Motion,
    /// Messages so far in this pass.
    sent: u64,
}

impl Waiting {
    fn add(&mut self, one: Motion) {
        let Motion {
            imu,
            imu_variance,
            fixes,
            wheels,
            imu_position,
            antenna,
            axle,
        } = one;
        let motion = &mut self.motion;
        if !imu.is_empty() {
            (motion.imu_variance, motion.imu_position) = (imu_variance, imu_position);
        }
        if !fixes.is_empty() {
            motion.antenna = antenna;
        }
        if !wheels.is_empty() {
            motion.axle = axle;
        }
        motion.imu.extend(imu);
        motion.fixes.extend(fixes);
        motion.wheels.extend(wheels);
    }

    /// When the measurement that waits longest arrived.
    fn oldest(&self) -> Option<Nanos> {
        let Motion { imu, fixes, wheels, .. } = &self.motion;
        let firsts = [
            imu.first().map(|sample| sample.taken),
            fixes.first().map(|fix| fix.taken),
            wheels.first().map(|wheel| wheel.taken),
        ];
        firsts.into_iter().flatten().map(|taken| taken.arrival).min()
    }

    /// The newest stamp, and when the last measurement arrived.
    fn newest(&self) -> Option<[Nanos; 2]> {
        let Motion { imu, fixes, wheels, .. } = &self.motion;
        let imu = imu.iter().map(|sample| sample.taken);
        let fixes = fixes.iter().map(|fix| fix.taken);
        let all = imu.chain(fixes).chain(wheels.iter().map(|wheel| wheel.taken));
        let times = all.map(|taken| [taken.stamp, taken.arrival]);
        times.reduce(|a, b| [a[0].max(b[0]), a[1].max(b[1])])
    }

    /// Takes what had arrived at a time; its times are from the stamp and the release of its message.
    fn take(&mut self, stamp: Nanos, release: Nanos) -> Option<Motion> {
        let due = |taken: &mut Taken| {
            let is_there = taken.arrival <= release;
            if is_there {
                taken.stamp = taken.stamp.saturating_sub(stamp);
                taken.arrival = taken.arrival.saturating_sub(release);
            }
            is_there
        };
        let motion = &mut self.motion;
        let taken = Motion {
            imu: motion.imu.extract_if(.., |sample| due(&mut sample.taken)).collect(),
            imu_variance: motion.imu_variance,
            fixes: motion.fixes.extract_if(.., |fix| due(&mut fix.taken)).collect(),
            wheels: motion.wheels.extract_if(.., |wheel| due(&mut wheel.taken)).collect(),
            imu_position: motion.imu_position,
            antenna: motion.antenna,
            axle: motion.axle,
        };
        (!taken.is_empty()).then_some(taken)
    }
}

impl Feed {
    /// Keeps what a motion sensor measured for the next sweep of its agent.
    pub(super) fn take_motion(&mut self, entry: &Entry) {
        let measured = entry.motion();
        let counters = &self.script.counters;
        let lost = u64::from(measured.is_err());
        counters.lost(&MOTION_UNUSABLE, &entry.agent, lost, 1, || {
            measured.as_ref().err().map(LogError::reason).unwrap_or_default()
        });
        let Ok(mut motion) = measured else { return };
        if self.script.offline {
            let arrive = |taken: &mut Taken| taken.arrival = taken.stamp;
            motion.imu.iter_mut().for_each(|sample| arrive(&mut sample.taken));
            motion.fixes.iter_mut().for_each(|fix| arrive(&mut fix.taken));
            motion.wheels.iter_mut().for_each(|wheel| arrive(&mut wheel.taken));
        }
        let rank = self.rank(entry);
        self.motion.entry(rank).or_default().add(motion);
    }

    /// Sends what had arrived of an agent's motion at a time.
    pub(super) fn send_motion(&mut self, rank: usize, [stamp, release]: [Nanos; 2]) {
        let Some(waiting) = self.motion.get_mut(&rank) else {
            return;
        };
        let Some(motion) = waiting.take(stamp, release) else {
            return;
        };
        let seq = waiting.sent;
        waiting.sent += 1;
        let sides = [Output::EgoMotion, Output::Motion];
        let output = self.output((rank, [stamp, release]), seq, Kind::Motion, sides, motion);
        self.queue((rank, release), output);
    }

    /// Sends what has waited too long for a sweep, at the log's end everything.
    pub(super) fn send_waiting_motion(&mut self, now: Nanos) {
        let is_old = |waiting: &Waiting| {
            waiting
                .oldest()
                .is_some_and(|oldest| now.saturating_sub(oldest) > PATIENCE)
        };
        let old = self.motion.iter().filter(|(_, waiting)| is_old(waiting));
        let due: Vec<(usize, [Nanos; 2])> = old
            .filter_map(|(rank, waiting)| Some((*rank, waiting.newest()?)))
            .collect();
        for (rank, [stamp, arrival]) in due {
            self.send_motion(rank, [stamp, arrival.max(self.released_to)]);
        }
    }

    /// Begins another pass: nothing waits, and numbers begin again.
    pub(super) fn rewind_motion(&mut self) {
        self.motion.clear();
    }
}

use std::collections::VecDeque;

use nalgebra::{Isometry3, Matrix6, Vector3};
use realo_schemas::Nanos;

use crate::fault::{Fault, Faults};
use crate::filter::Filter;
use crate::rules::{Checked, Rules};
use crate::settings::{Settings, SettingsError};
use crate::{Estimate, Sample, Status, Stuck};

/// A stamp may be so far ahead of all others, ns.
const AHEAD: Nanos = 1_000_000_000;
/// So many stamps that are ahead one after the other are a gap in time.
const TOGETHER: u32 = 5;
/// An estimate is given so long after the last sample, ns.
const BEYOND: Nanos = 1_000_000_000;

/// What became of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It is part of the estimate.
    Used,
    /// There is no estimate yet; it helps to find one.
    Waiting,
    /// It is not used, or not all of it.
    Refused(Fault),
}

/// A sample, and the filter after it.
#[derive(Clone, Debug)]
struct Step {
    stamp: Nanos,
    sample: Checked,
    after: Filter,
}

/// Estimates an agent's pose and motion from IMU, wheels, GNSS and scans, in the order of their stamps however late they
/// come: an error-state Kalman filter (Solà 2017, arXiv 1711.02508) over a ring of past states.
///
/// A sample that comes late is put where its stamp belongs, and what follows is computed again: the result has the same bits as
/// if it had come in time.
#[derive(Clone, Debug)]
pub struct Estimator {
    rules: Rules,
    keep: Nanos,
    /// Before the first step that is kept.
    base: Filter,
    steps: VecDeque<Step>,
    /// Of samples that never reached the filter.
    faults: Faults,
    ahead: u32,
}

impl Estimator {
    /// An estimator that knows nothing yet.
    ///
    /// # Errors
    /// [`SettingsError`] for a setting that is none, by name.
    pub fn new(settings: Settings) -> Result<Self, SettingsError> {
        let settings = settings.checked()?;
        Ok(Estimator {
            keep: settings.keep,
            rules: Rules::new(settings),
            base: Filter::new(),
            steps: VecDeque::new(),
            faults: Faults::default(),
            ahead: 0,
        })
    }

    /// Says where the antenna and the wheels' axle are in the body frame, m, once their first samples say it.
    pub fn remount(&mut self, antenna_in_body: &Vector3<f64>, axle_in_body: &Vector3<f64>) {
        self.rules.remount(antenna_in_body, axle_in_body);
    }

    /// Gives up what was estimated, and begins anew: what comes next is of another clock. What was wrong so far stays counted.
    pub fn begin_anew(&mut self) {
        let (faults, latest) = (self.faults(), self.latest());
        let knew = latest.belief.is_some() || latest.start.after_loss;
        self.base = Filter::after(knew);
        self.steps.clear();
        (self.faults, self.ahead) = (faults, 0);
    }

    /// Takes a sample. What is wrong with it is the verdict, and counted in [`Self::faults`].
    pub fn take(&mut self, sample: &Sample) -> Verdict {
        let stamp = sample.stamp();
        let placed = self.rules.check(sample).and_then(|checked| self.place(stamp, checked));
        placed.unwrap_or_else(|fault| {
            self.faults.note(fault, stamp);
            Verdict::Refused(fault)
        })
    }

    /// Puts a sample where it belongs, and computes what follows.
    fn place(&mut self, stamp: Nanos, sample: Checked) -> Result<Verdict, Fault> {
        if let Some(newest) = self.latest().time {
            if stamp.saturating_sub(newest) > AHEAD && self.ahead + 1 < TOGETHER {
                self.ahead += 1;
                return Err(Fault::StampAhead);
            }
            self.ahead = 0;
        }
        if self.base.time.is_some_and(|oldest| stamp < oldest) {
            return Err(Fault::TooLate);
        }
        let key = (stamp, sample.rank());
        let at = self
            .steps
            .partition_point(|step| (step.stamp, step.sample.rank()) < key);
        let is_same = |step: &Step| (step.stamp, step.sample.rank()) == key;
        if self.steps.get(at).is_some_and(is_same) {
            return Err(Fault::Repeated);
        }
        let mut filter = self.before(at).clone();
        let verdict = filter.take(stamp, &sample, &self.rules);
        self.steps.insert(
            at,
            Step {
                stamp,
                sample,
                after: filter,
            },
        );
        for later in at + 1..self.steps.len() {
            let mut filter = self.steps[later - 1].after.clone();
            let step = &mut self.steps[later];
            filter.take(step.stamp, &step.sample, &self.rules);
            step.after = filter;
        }
        self.forget();
        Ok(verdict)
    }

    /// The filter before a step.
    fn before(&self, at: usize) -> &Filter {
        match at.checked_sub(1) {
            Some(last) => &self.steps[last].after,
            None => &self.base,
        }
    }

    fn latest(&self) -> &Filter {
        self.before(self.steps.len())
    }

    /// Lets steps go that are too old, but for the last one.
    fn forget(&mut self) {
        let Some(newest) = self.steps.back().map(|step| step.stamp) else {
            return;
        };
        while self.steps.len() > 1 && self.steps[0].stamp < newest.saturating_sub(self.keep) {
            if let Some(step) = self.steps.pop_front() {
                self.base = step.after;
            }
        }
    }

    /// The stamp of the newest sample.
    pub fn newest(&self) -> Option<Nanos> {
        self.latest().time
    }

    /// The estimate at the newest sample; `None` before any position is known.
    pub fn estimate(&self) -> Option<Estimate> {
        self.estimate_at(self.newest()?)
    }

    /// The estimate at a stamp, by the samples up to it.
    ///
    /// `None` before any position is known, for a stamp older than what is kept, and for one more than a second ahead.
    pub fn estimate_at(&self, stamp: Nanos) -> Option<Estimate> {
        let at = self.steps.partition_point(|step| step.stamp <= stamp);
        let mut filter = self.before(at).clone();
        let time = filter.time?;
        if stamp < time || stamp.saturating_sub(time) > BEYOND {
            return None;
        }
        filter.advance(stamp, None, &self.rules);
        self.estimate_of(&filter, stamp)
    }

    fn estimate_of(&self, filter: &Filter, stamp: Nanos) -> Option<Estimate> {
        let Some(belief) = &filter.belief else {
            return self.beginning(filter, stamp);
        };
        let mut estimate = Estimate::of(belief, filter.rate(stamp), stamp, Status::Tracking, &self.rules);
        let doubt = filter.doubt(stamp, &self.rules);
        let mut place = estimate.covariance.fixed_view_mut::<2, 2>(0, 0);
        place += doubt;
        let limits = &self.rules.limits;
        let is_astray = filter.is_astray(stamp);
        let certain = !is_astray
            && estimate.position_sigma() <= limits.position_m
            && estimate.heading_sigma() <= limits.heading_rad;
        let corrected = [&filter.scans, &filter.fixes]
            .iter()
            .any(|source| source.is_used(stamp, limits.dead_reckoning));
        estimate.status = match (certain, corrected) {
            (false, _) => Status::Lost,
            (true, true) => Status::Tracking,
            (true, false) => Status::DeadReckoning,
        };
        Some(estimate)
    }

    /// What is known before there is an estimate: a position of GNSS, and no heading.
    fn beginning(&self, filter: &Filter, stamp: Nanos) -> Option<Estimate> {
        let fix = filter.start.fix()?;
        let mut covariance = Matrix6::zeros();
        for axis in 0..3 {
            covariance[(axis, axis)] = fix.variance[axis];
        }
        // Evenly spread over the circle; roads are level within a few degrees.
        covariance[(3, 3)] = 2.5e-3;
        covariance[(4, 4)] = 2.5e-3;
        covariance[(5, 5)] = std::f64::consts::PI * std::f64::consts::PI / 3.0;
        Some(Estimate {
            stamp,
            map_from_body: Isometry3::translation(fix.position.x, fix.position.y, fix.position.z),
            covariance,
            velocity: Vector3::zeros(),
            angular_rate: None,
            status: if filter.start.after_loss {
                Status::Lost
            } else {
                Status::Init
            },
        })
    }

    /// Whether the agent can be relied on, also where there is no estimate.
    pub fn status(&self) -> Status {
        let lost = self.latest().start.after_loss;
        let without = if lost { Status::Lost } else { Status::Init };
        self.estimate().map_or(without, |estimate| estimate.status)
    }

    /// What was wrong with the samples so far.
    pub fn faults(&self) -> Faults {
        self.latest().faults.with(&self.faults)
    }

    /// How far GNSS was off last by scans that are believed rather than it, m.
    pub fn gnss_offset(&self) -> Option<f64> {
        self.latest().gnss_offset
    }

    /// What of the IMU was stuck last.
    pub fn stuck(&self) -> Option<Stuck> {
        self.latest().stuck()
    }

    /// The biases of gyro (rad/s) and accelerometer (m/s²) as estimated, in the IMU's frame.
    pub fn biases(&self) -> Option<[Vector3<f64>; 2]> {
        let belief = self.latest().belief.as_ref()?;
        let gyro = belief.coasting.as_ref().map_or(belief.gyro_bias, |held| held.bias);
        Some([gyro, belief.accel_bias])
    }
}

//! One agent that is localised by its sensors.

use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector3};
use realo_geodesy::{Geodetic, LocalFrame};
use realo_operator::{Outputs, StageOutputs};
use realo_schemas::geometry::yaw_of;
use realo_schemas::{AgentState, Header, Motion, Nanos, PointCloud, PoseStatus};
use realo_state_estimation as estimation;
use realo_state_estimation::{
    Estimate, Estimator, HoldEstimator, HoldSettings, Measured, Mounting, Sample, ScanPose, Status, Unit, Verdict,
    deskewed, level_pose, unit_of,
};

use crate::clock::MotionClock;
use crate::faults::{
    CLOCK_SET, CLOCKS_APART, Reported, SCAN_FEW_POINTS, SCAN_OFF_MAP, SCAN_UNFIT, SCANS, SEARCHES, Taken,
};
use crate::place::{Found, FoundPose, Guess, Place};

/// From one search in all directions to the next, ns: it takes long.
const SEARCH_PERIOD: Nanos = 500_000_000;
/// A vehicle that was never found on the map is looked for so far around its fix, m: receivers without corrections are metres off for
/// minutes. Later it is looked for so far around the estimate, m, and by so many standard deviations more.
const AT_START: f64 = 15.0;
const LATER: (f64, f64) = (5.0, 3.0);
/// A sweep that was found, but does not tell the estimate yet, leads to the next for so long, ns; and all such sweeps for so long.
const LEADS: Nanos = 500_000_000;
const FOLLOWED: Nanos = 5_000_000_000;
/// How far the next sweep may be from where it leads, m; where the motion between is known, it is known to so much, m and rad.
const NEAR: f64 = 4.0;
const LED: [f64; 2] = [0.5, 0.03];
/// From one look at a unit that is held to the next, ns.
const WATCH_PERIOD: Nanos = 1_000_000_000;
/// What is added to the covariance of each sweep's pose: standard deviations of position, m, and turn, rad.
const SWEEP_ERRORS: [f64; 2] = [0.02, 8e-4];
/// Standard deviation of a position that nobody knows, m, and of turns, rad.
const ANYWHERE: [f64; 2] = [1e5, 1.8];

/// What holds for all agents.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rules {
    /// The motion sensors; `None`: the unit whose noise is nearest to what the agent's IMU says of itself.
    pub unit: Option<Unit>,
    /// Whether sweeps are looked for on a map.
    pub has_map: bool,
}

/// What estimates.
enum Filter {
    Vehicle(Box<Estimator>),
    /// A roadside unit.
    Held(Box<HoldEstimator>),
}

/// Where a sweep was found.
#[derive(Clone, Copy)]
struct Tried {
    /// When the first of such sweeps was taken, and this one.
    since: Nanos,
    stamp: Nanos,
    map_from_body: Isometry3<f64>,
}

impl Tried {
    /// Whether a sweep may be looked for by it.
    fn leads_to(&self, stamp: Nanos) -> bool {
        let after = |earlier: Nanos| stamp.saturating_sub(earlier);
        (0..=LEADS).contains(&after(self.stamp)) && after(self.since) <= FOLLOWED
    }
}

/// An agent and what is known of it.
pub(crate) struct Agent {
    is_roadside: bool,
    /// Once anything was measured.
    filter: Option<Filter>,
    /// How a roadside unit is turned in `map`, as its recorded pose has it from a survey.
    surveyed: Option<UnitQuaternion<f64>>,
    has_motion: bool,
    antenna: Vector3<f64>,
    axle: Vector3<f64>,
    measured: Measured,
    clock: MotionClock,
    /// When a sweep was looked for in all directions, or a held unit was looked at.
    looked: Option<Nanos>,
    /// Where the last sweep was found, if that does not tell the estimate yet.
    tried: Option<Tried>,
    /// Whether a sweep ever told a vehicle's estimate.
    is_on_map: bool,
    /// How much of the last sweep that was found fits the map.
    share: f64,
    taken: Taken,
    reported: Reported,
}

impl Agent {
    pub fn new(is_roadside: bool) -> Self {
        Agent {
            is_roadside,
            filter: None,
            surveyed: None,
            has_motion: false,
            antenna: Vector3::zeros(),
            axle: Vector3::zeros(),
            measured: Measured::default(),
            clock: MotionClock::default(),
            looked: None,
            tried: None,
            is_on_map: false,
            share: 1.0,
            taken: Taken::default(),
            reported: Reported::default(),
        }
    }

    /// Whether anything was measured.
    pub fn has_motion(&self) -> bool {
        self.has_motion
    }

    /// Takes the recorded pose. Of it nothing is used but how a roadside unit is turned, which no receiver measures.
    pub fn survey(&mut self, recorded: &AgentState) {
        self.surveyed = self.surveyed.or(Some(recorded.map_from_body.rotation));
    }

    /// Takes what was measured.
    ///
    /// # Errors
    /// Places of sensors that are none.
    pub fn measure<O: StageOutputs>(
        &mut self,
        header: &Header,
        motion: &Motion,
        rules: &Rules,
        out: &mut Outputs<O>,
    ) -> Result<(), estimation::SettingsError> {
        self.has_motion |= !motion.is_empty();
        self.mount(motion, rules)?;
        let mut samples = self.measured.samples(header.stamp, motion);
        if let Some(since) = self.set_back_or_ahead(header, motion, out) {
            samples.retain(|sample| matches!(sample, Sample::Imu(sample) if sample.stamp >= since));
        }
        for sample in &samples {
            match &mut self.filter {
                Some(Filter::Vehicle(estimator)) => _ = estimator.take(sample),
                Some(Filter::Held(held)) => _ = held.take(sample),
                None => {}
            }
        }
        self.taken.imu += motion.imu.len() as u64;
        self.taken.fixes += motion.fixes.len() as u64;
        self.taken.wheels += motion.wheels.len() as u64;
        self.report(&header.agent, out);
        Ok(())
    }

    /// Looks whether the clock of the motion sensors was set. Then all begins anew: what was measured before lies at other times. Gives the
    /// stamp from which on samples of the message are of the new clock.
    fn set_back_or_ahead<O: StageOutputs>(
        &mut self,
        header: &Header,
        motion: &Motion,
        out: &mut Outputs<O>,
    ) -> Option<Nanos> {
        let Some(Filter::Vehicle(estimator)) = &mut self.filter else {
            return None;
        };
        let mut since = None;
        for sample in &motion.imu {
            let (stamp, arrival) = (sample.taken.stamp_in(header), sample.taken.arrival_in(header));
            if self.clock.sample(stamp, arrival) {
                since = Some(stamp);
            }
        }
        out.count(&CLOCK_SET, &header.agent, u64::from(since.is_some()));
        if since.is_some() {
            estimator.begin_anew();
            (self.measured, self.looked, self.tried, self.is_on_map) = (Measured::default(), None, None, false);
        }
        since
    }

    /// Makes the filter with the first measurements, and takes over where sensors are.
    fn mount(&mut self, motion: &Motion, rules: &Rules) -> Result<(), estimation::SettingsError> {
        if !motion.fixes.is_empty() {
            self.antenna = motion.antenna.into();
        }
        if !motion.wheels.is_empty() {
            self.axle = motion.axle.into();
        }
        let filter = match self.filter.take() {
            Some(filter) => filter,
            // A receiver alone does not say how the unit is turned.
            None if self.is_roadside && !rules.has_map && self.surveyed.is_none() => return Ok(()),
            None if self.is_roadside => {
                let hold = HoldSettings {
                    surveyed: self.surveyed.filter(|_| !rules.has_map),
                    ..HoldSettings::default()
                };
                Filter::Held(HoldEstimator::new(self.settings(motion, rules)?, hold)?.into())
            }
            None => Filter::Vehicle(Estimator::new(self.settings(motion, rules)?)?.into()),
        };
        self.filter = Some(match filter {
            Filter::Vehicle(mut estimator) => {
                estimator.remount(&self.antenna, &self.axle);
                Filter::Vehicle(estimator)
            }
            Filter::Held(mut held) => {
                held.remount(&self.antenna);
                Filter::Held(held)
            }
        });
        Ok(())
    }

    fn settings(&self, motion: &Motion, rules: &Rules) -> Result<estimation::Settings, estimation::SettingsError> {
        // Positions come in `map` already, so that it does not matter where that is.
        let frame =
            LocalFrame::new(Geodetic::default()).map_err(|_| estimation::SettingsError::NotFinite { name: "frame" })?;
        let unit = rules.unit.unwrap_or_else(|| unit_of(motion.imu_variance));
        let mut settings = estimation::Settings::new(unit, frame);
        [settings.scan.position_m, settings.scan.turn_rad] = SWEEP_ERRORS;
        settings.mounting = Mounting {
            body_from_imu: Isometry3::translation(
                motion.imu_position[0],
                motion.imu_position[1],
                motion.imu_position[2],
            ),
            antenna_in_body: self.antenna,
            axle_in_body: self.axle,
        };
        Ok(settings)
    }

    /// The agent's state at a sweep, by its sensors and, where there is a map, by the sweep.
    pub fn locate<O: StageOutputs>(
        &mut self,
        header: &Header,
        cloud: &PointCloud,
        place: Option<&mut Place>,
        out: &mut Outputs<O>,
    ) -> AgentState {
        let is_apart = !self.is_roadside && self.clock.is_apart(header.stamp, header.ready);
        out.count_of(&CLOCKS_APART, &header.agent, u64::from(is_apart), 1);
        if is_apart {
            return nowhere(Status::Lost);
        }
        let mut errors = [0.0; 3];
        if let Some(place) = place {
            self.look(header, cloud, place, out);
            self.report(&header.agent, out);
            errors = place.errors(self.share);
        }
        let Some(mut estimate) = self.estimate_at(header.stamp) else {
            return nowhere(self.status());
        };
        let [place, height, turn] = errors.map(|sigma| sigma * sigma);
        for (axis, variance) in [(0, place), (1, place), (2, height), (5, turn)] {
            estimate.covariance[(axis, axis)] += variance;
        }
        state_of(&estimate)
    }

    /// The sweep without the agent's own motion during it; `None` while that is not known. A roadside unit does not move.
    pub fn deskewed(&self, header: &Header, cloud: &PointCloud) -> Option<PointCloud> {
        match self.is_roadside {
            true => None,
            false => deskewed(cloud, header.stamp, |stamp| self.estimate_at(stamp)),
        }
    }

    fn estimate_at(&self, stamp: Nanos) -> Option<Estimate> {
        match self.filter.as_ref()? {
            Filter::Vehicle(estimator) => estimator.estimate_at(stamp),
            Filter::Held(held) => held.estimate_at(stamp),
        }
    }

    fn status(&self) -> Status {
        match &self.filter {
            Some(Filter::Vehicle(estimator)) => estimator.status(),
            Some(Filter::Held(held)) => held.status(),
            None => Status::Init,
        }
    }

    /// Looks for the sweep on the map, and gives its pose to the filter.
    fn look<O: StageOutputs>(&mut self, header: &Header, cloud: &PointCloud, place: &mut Place, out: &mut Outputs<O>) {
        let (agent, stamp) = (&header.agent, header.stamp);
        let Some(guess) = self.guess(stamp) else { return };
        out.count(&SEARCHES, agent, u64::from(guess.yaw.is_none()));
        let found = place.look(cloud, &guess);
        let is = |wrong: bool| u64::from(wrong);
        out.count_of(&SCAN_UNFIT, agent, is(matches!(found, Found::Unfit)), 1);
        out.count_of(&SCAN_FEW_POINTS, agent, is(matches!(found, Found::FewPoints)), 1);
        out.count_of(&SCAN_OFF_MAP, agent, is(matches!(found, Found::OffMap)), 1);
        let Found::Pose(found) = found else {
            self.tried = None;
            return;
        };
        let FoundPose {
            map_from_body,
            information,
            share,
        } = *found;
        out.count(&SCANS, agent, 1);
        self.taken.scans += 1;
        self.share = share;
        let scan = Sample::Scan(Box::new(ScanPose {
            stamp,
            map_from_body,
            information,
        }));
        let is_used = match &mut self.filter {
            Some(Filter::Vehicle(estimator)) => estimator.take(&scan) == Verdict::Used,
            Some(Filter::Held(held)) => {
                held.take(&scan);
                false
            }
            None => false,
        };
        self.is_on_map |= is_used;
        let leads = self.tried.filter(|tried| tried.leads_to(stamp));
        let since = leads.map_or(stamp, |tried| tried.since);
        let tried = Tried {
            since,
            stamp,
            map_from_body,
        };
        self.tried = (!is_used).then_some(tried);
    }

    /// Where to look for a sweep; `None` where it is not known, or not worth it now.
    fn guess(&mut self, stamp: Nanos) -> Option<Guess> {
        let estimate = self.estimate_at(stamp)?;
        let known = Guess {
            yaw: Some(yaw_of(&estimate.map_from_body.rotation)),
            radius: self.radius(estimate.position_sigma()),
            is_height_unsure: estimate.covariance[(2, 2)] > 0.25,
            ..sure(
                &estimate.map_from_body,
                [estimate.position_sigma(), estimate.heading_sigma()],
            )
        };
        let is_held = matches!(self.filter, Some(Filter::Held(_)));
        // Without a heading the estimate is a fix's position, or a mean of them.
        let has_heading = estimate.heading_sigma() < 1.0;
        match (is_held, has_heading, self.tried) {
            (true, true, _) => self.is_due(stamp, WATCH_PERIOD).then_some(known),
            (true, false, Some(tried)) => Some(sure(&tried.map_from_body, [0.0; 2])),
            (false, _, Some(tried)) if tried.leads_to(stamp) => Some(self.led(&tried, &estimate, has_heading)),
            (false, true, _) => Some(known),
            (_, false, _) => self.is_due(stamp, SEARCH_PERIOD).then_some(Guess {
                yaw: None,
                is_height_unsure: true,
                ..known
            }),
        }
    }

    /// Where the sweep before leads.
    fn led(&self, tried: &Tried, estimate: &Estimate, has_heading: bool) -> Guess {
        match self.estimate_at(tried.stamp).filter(|_| has_heading) {
            Some(before) => {
                let moved = level_pose(&before).inverse() * level_pose(estimate);
                sure(&(tried.map_from_body * moved), LED)
            }
            None => Guess {
                radius: NEAR,
                ..sure(&tried.map_from_body, [NEAR, 0.0])
            },
        }
    }

    /// How far around the estimate the agent may be, m.
    fn radius(&self, sigma: f64) -> f64 {
        match self.is_on_map {
            true => (LATER.0 + LATER.1 * sigma).min(AT_START),
            false => AT_START,
        }
    }

    /// Whether it is time for a look that comes seldom.
    fn is_due(&mut self, stamp: Nanos, period: Nanos) -> bool {
        let is_due = self.looked.is_none_or(|looked| stamp.saturating_sub(looked) >= period);
        if is_due {
            self.looked = Some(stamp);
        }
        is_due
    }

    fn report<O: StageOutputs>(&mut self, agent: &str, out: &mut Outputs<O>) {
        let (faults, found) = match &self.filter {
            Some(Filter::Vehicle(estimator)) => (estimator.faults(), (estimator.gnss_offset(), estimator.stuck())),
            Some(Filter::Held(held)) => (held.faults(), (None, None)),
            None => return,
        };
        self.reported.count(agent, &faults, &self.taken, found, out);
    }
}

/// A guess that is a pose, known to so much, m and rad.
fn sure(map_from_body: &Isometry3<f64>, sigmas: [f64; 2]) -> Guess {
    Guess {
        position: map_from_body.translation.vector,
        yaw: Some(yaw_of(&map_from_body.rotation)),
        sigmas,
        radius: NEAR,
        is_height_unsure: false,
    }
}

/// An estimate as others take it: the body frame is level.
fn state_of(estimate: &Estimate) -> AgentState {
    AgentState {
        map_from_body: level_pose(estimate),
        covariance: Some(rows(&estimate.covariance)),
        velocity: Some(estimate.velocity),
        angular_rate: estimate.angular_rate,
        status: status_of(estimate.status),
    }
}

/// The state of an agent of which not even a position is known.
fn nowhere(status: Status) -> AgentState {
    let [place, turn] = ANYWHERE.map(|sigma| sigma * sigma);
    let variances = Matrix6::from_diagonal(&[place, place, place, turn, turn, turn].into());
    // What was known when it was lost is worth nothing now.
    let status = if status == Status::Lost {
        PoseStatus::Lost
    } else {
        PoseStatus::Init
    };
    AgentState {
        map_from_body: Isometry3::identity(),
        covariance: Some(rows(&variances)),
        velocity: None,
        angular_rate: None,
        status,
    }
}

fn rows(covariance: &Matrix6<f64>) -> Box<[f64; 36]> {
    Box::new(std::array::from_fn(|at| covariance[(at / 6, at % 6)]))
}

fn status_of(status: Status) -> PoseStatus {
    match status {
        Status::Init => PoseStatus::Init,
        Status::Tracking => PoseStatus::Tracking,
        Status::DeadReckoning => PoseStatus::DeadReckoning,
        Status::Lost => PoseStatus::Lost,
    }
}

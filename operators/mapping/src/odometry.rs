//! Odometry by IMU, wheels and sweeps: the error-state filter, and a local map that grows and forgets.

use nalgebra::{Isometry3, Matrix6, Vector3};
use realo_geodesy::{Geodetic, LocalFrame};
use realo_registration::{AlignError, Alignment, Registrar, Sampler, Search, SettingError, VoxelMap};
use realo_schemas::geometry::yaw_of;
use realo_schemas::{Motion, Nanos, PointCloud};
use realo_state_estimation::{
    Estimate, Estimator, Measured, Mounting, Sample, ScanPose, Settings, SettingsError, Verdict, deskewed, level_pose,
    unit_of,
};

use crate::anchors::Fixes;
use crate::drive::{Drive, Piece};
use crate::keyframe::Keyframe;
use crate::lean::levelled;
use crate::local_map::{map_of, registrar};

/// Poses of the track are so far apart, ns.
const STEP: Nanos = 20_000_000;
/// It sets out when it has measured for so long: how the body leans and how fast it is are known then, ns.
const SET_OUT: Nanos = 400_000_000;
/// A guess that is known to so much is tracked, m and rad; around any other a wider neighbourhood is searched.
const TRACKED: [f64; 2] = [0.6, 0.035];
/// Standard deviations that are added to a sweep's pose, m and rad.
const SWEEP_ERRORS: [f64; 2] = [0.02, 8e-4];
/// A keyframe's points: one for each cell of this side, m.
const SAMPLE_M: f64 = 0.3;
/// More sweeps in a row at whose stamps nothing is known of the motion are no wrong stamps: the IMU was silent.
const MISDATED: u32 = 3;
/// Information of the place where it sets out, which is none but by definition.
const ORIGIN: f64 = 1e8;

/// How odometry works.
#[derive(Clone, Debug, PartialEq)]
pub struct OdometrySettings {
    /// Side of a voxel of the local map, m.
    pub voxel_m: f64,
    /// From one keyframe to the next, m and rad.
    pub apart: [f64; 2],
    /// Keyframes of which the local map is made.
    pub window: usize,
    /// Share of a sweep's points off the ground that must be near surfaces of the local map.
    pub min_share: f64,
    /// Points farther than this are left out of keyframes, m.
    pub range_m: f64,
    /// How the sensor leans, as [`Lean`](crate::Lean) has it: points are levelled.
    pub slope: f64,
}

impl Default for OdometrySettings {
    fn default() -> Self {
        OdometrySettings {
            voxel_m: 1.0,
            apart: [2.0, 0.2],
            window: 20,
            min_share: 0.35,
            range_m: 60.0,
            slope: 0.0,
        }
    }
}

/// What became of sweeps and measurements.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Sweeps that came.
    pub sweeps: u64,
    /// Sweeps before anything was known of the motion.
    pub waiting: u64,
    /// Sweeps that were registered.
    pub registered: u64,
    /// Sweeps with too few points.
    pub few_points: u64,
    /// Sweeps that do not fit the last ones.
    pub unfit: u64,
    /// Sweeps whose stamps are not after the last one's, or at which the IMU said nothing.
    pub misdated: u64,
    /// Samples of the IMU.
    pub imu: u64,
    /// Speeds of the wheels.
    pub wheels: u64,
}

/// What became of a sweep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Taken {
    /// Nothing is known of the motion yet.
    Waiting,
    /// It was registered, or is the first of a piece.
    Registered,
    /// It has too few points: IMU and wheels carry on.
    FewPoints,
    /// It does not fit the last ones: IMU and wheels carry on.
    Unfit,
    /// Its stamp is not after the last one's, or the motion is known, but not then: it is left out.
    Misdated,
}

/// Odometry of one vehicle.
pub struct Odometry {
    settings: OdometrySettings,
    estimator: Option<Estimator>,
    measured: Measured,
    antenna: Vector3<f64>,
    axle: Vector3<f64>,
    registrar: Registrar,
    sampler: Sampler,
    local: Option<VoxelMap>,
    /// When the first sample came after the last break.
    since: Option<Nanos>,
    /// The piece that goes on.
    piece: Option<Piece>,
    pieces: Vec<Piece>,
    fixes: Fixes,
    counts: Counts,
    /// Sweeps in a row at whose stamps nothing is known of the motion.
    misdated: u32,
}

impl Odometry {
    /// Odometry that knows nothing yet.
    ///
    /// # Errors
    /// A setting out of its range.
    pub fn new(settings: OdometrySettings) -> Result<Self, SettingError> {
        let registrar = registrar();
        Ok(Odometry {
            sampler: Sampler::new(SAMPLE_M, [registrar.range_m[0], settings.range_m]),
            registrar: Registrar::new(registrar)?,
            settings,
            estimator: None,
            measured: Measured::default(),
            antenna: Vector3::zeros(),
            axle: Vector3::zeros(),
            local: None,
            since: None,
            piece: None,
            pieces: Vec::new(),
            fixes: Fixes::default(),
            counts: Counts::default(),
            misdated: 0,
        })
    }

    /// Takes what was measured, with stamps as they are; positions of GNSS are only kept.
    ///
    /// # Errors
    /// Places of sensors that are none.
    pub fn measure(&mut self, motion: &Motion) -> Result<(), SettingsError> {
        if !motion.fixes.is_empty() {
            self.antenna = motion.antenna.into();
        }
        if !motion.wheels.is_empty() {
            self.axle = motion.axle.into();
        }
        self.counts.imu += motion.imu.len() as u64;
        self.counts.wheels += motion.wheels.len() as u64;
        let mut estimator = match self.estimator.take() {
            Some(estimator) => estimator,
            // The IMU says which unit it is.
            None if motion.imu.is_empty() => return Ok(()),
            None => Estimator::new(settings_of(motion)?)?,
        };
        estimator.remount(&self.antenna, &self.axle);
        for sample in self.measured.samples(0, motion) {
            match &sample {
                Sample::Fix(fix) => self.fixes.add(fix, &self.antenna, motion.imu_variance),
                _ => {
                    self.since.get_or_insert(sample.stamp());
                    _ = estimator.take(&sample);
                }
            }
        }
        self.estimator = Some(estimator);
        Ok(())
    }

    /// Takes a sweep: points in the body frame at their own times, without the agent's body.
    ///
    /// # Errors
    /// A voxel's side that is none.
    pub fn sweep(&mut self, stamp: Nanos, cloud: &PointCloud) -> Result<Taken, SettingError> {
        self.counts.sweeps += 1;
        let taken = match self.settings.slope {
            0.0 => self.place(stamp, cloud)?,
            slope => self.place(stamp, &levelled(cloud, slope))?,
        };
        *match taken {
            Taken::Waiting => &mut self.counts.waiting,
            Taken::Registered => &mut self.counts.registered,
            Taken::FewPoints => &mut self.counts.few_points,
            Taken::Unfit => &mut self.counts.unfit,
            Taken::Misdated => &mut self.counts.misdated,
        } += 1;
        Ok(taken)
    }

    fn place(&mut self, stamp: Nanos, cloud: &PointCloud) -> Result<Taken, SettingError> {
        let newest = self.piece.as_ref().and_then(|piece| piece.track.last());
        if newest.is_some_and(|(newest, _)| stamp <= *newest) {
            return Ok(Taken::Misdated);
        }
        let Some(guess) = self.estimate_at(stamp) else {
            let knows_motion = self.estimator.as_ref().and_then(Estimator::estimate).is_some();
            self.misdated += 1;
            if knows_motion && self.misdated <= MISDATED {
                return Ok(Taken::Misdated);
            }
            self.break_off();
            self.set_out(stamp);
            return Ok(Taken::Waiting);
        };
        self.misdated = 0;
        let still = deskewed(cloud, stamp, |at| self.estimate_at(at));
        let cloud = still.as_ref().unwrap_or(cloud);
        let mut found = self.register(cloud, &guess);
        if let (Some(Ok(alignment)), Some(estimator)) = (&found, &mut self.estimator) {
            let verdict = estimator.take(&Sample::Scan(Box::new(ScanPose {
                stamp,
                map_from_body: alignment.map_from_body,
                information: alignment.information,
            })));
            // What the filter does not believe measures nothing.
            if !matches!(verdict, Verdict::Used) {
                found = Some(Err(Taken::Unfit));
            }
        }
        // A sweep that contradicts for long ends the estimate.
        let Some(estimate) = self.estimate_at(stamp) else {
            self.break_off();
            return Ok(Taken::Unfit);
        };
        let taken = match &found {
            None | Some(Ok(_)) => Taken::Registered,
            Some(Err(taken)) => *taken,
        };
        let found = found.and_then(Result::ok);
        self.follow(stamp);
        let pose = level_pose(&estimate);
        if taken != Taken::FewPoints && self.is_keyframe(&pose) {
            self.keep(&estimate, &pose, cloud, found.as_ref())?;
        }
        Ok(taken)
    }

    fn estimate_at(&self, stamp: Nanos) -> Option<Estimate> {
        self.estimator.as_ref()?.estimate_at(stamp)
    }

    /// Begins a piece at the origin of a frame of its own, once enough was measured.
    fn set_out(&mut self, stamp: Nanos) {
        let is_ready = self.since.is_some_and(|since| stamp.saturating_sub(since) >= SET_OUT);
        if let Some(estimator) = &mut self.estimator
            && is_ready
        {
            _ = estimator.take(&Sample::Scan(Box::new(ScanPose {
                stamp,
                map_from_body: Isometry3::identity(),
                information: Matrix6::identity() * ORIGIN,
            })));
        }
    }

    /// Ends the piece that went on.
    fn break_off(&mut self) {
        self.local = None;
        if let Some(piece) = self.piece.take() {
            self.since = None;
            self.pieces.extend((!piece.keyframes.is_empty()).then_some(piece));
        }
    }

    /// The sweep's pose by the local map; `None` without a map.
    fn register(&mut self, cloud: &PointCloud, guess: &Estimate) -> Option<Result<Alignment, Taken>> {
        let Some(local) = &self.local else {
            // The first of a piece needs points to be worth anything.
            let sample = self.sampler.sample(cloud);
            let enough = sample.len() >= registrar().min_points as usize;
            return (!enough).then_some(Err(Taken::FewPoints));
        };
        let start = level_pose(guess);
        let is_known = guess.position_sigma() <= TRACKED[0] && guess.heading_sigma() <= TRACKED[1];
        let searches: &[Search] = match is_known {
            true => &[Search::Track, Search::Wide],
            false => &[Search::Wide],
        };
        for search in searches {
            match self.registrar.align(local, cloud, &start, *search) {
                Ok(found) if found.is_settled() && found.structure_share >= self.settings.min_share => {
                    return Some(Ok(found));
                }
                Ok(_) | Err(AlignError::OffMap { .. } | AlignError::Guess(_)) => {}
                Err(AlignError::FewPoints { .. }) => return Some(Err(Taken::FewPoints)),
            }
        }
        Some(Err(Taken::Unfit))
    }

    /// Notes where the body was since the last sweep.
    fn follow(&mut self, stamp: Nanos) {
        let last = self
            .piece
            .as_ref()
            .and_then(|piece| piece.track.last().map(|(at, _)| *at));
        let mut at = last.map_or(stamp, |last| last.saturating_add(STEP));
        let mut stamps = Vec::new();
        while at < stamp {
            stamps.push(at);
            at += STEP;
        }
        stamps.push(stamp);
        let pose = |at: Nanos| self.estimate_at(at).map(|estimate| (at, level_pose(&estimate)));
        let poses: Vec<_> = stamps.into_iter().filter_map(pose).collect();
        self.piece.get_or_insert_default().track.extend(poses);
    }

    /// Whether a pose is far enough from the last keyframe.
    fn is_keyframe(&self, pose: &Isometry3<f64>) -> bool {
        let last = self.piece.as_ref().and_then(|piece| piece.keyframes.last());
        last.is_none_or(|last| {
            let step = last.odom_from_body.inv_mul(pose);
            step.translation.vector.norm() >= self.settings.apart[0]
                || yaw_of(&step.rotation).abs() >= self.settings.apart[1]
        })
    }

    fn keep(
        &mut self,
        estimate: &Estimate,
        pose: &Isometry3<f64>,
        cloud: &PointCloud,
        found: Option<&Alignment>,
    ) -> Result<(), SettingError> {
        let sample = self.sampler.sample(cloud);
        let keyframes = &mut self.piece.get_or_insert_default().keyframes;
        let keyframe = Keyframe::new(keyframes.last(), estimate, pose, &sample, found);
        keyframes.push(keyframe);
        let window = &keyframes[keyframes.len().saturating_sub(self.settings.window)..];
        self.local = map_of(
            window.iter().map(|keyframe| (keyframe, keyframe.odom_from_body)),
            self.settings.voxel_m,
        )?;
        Ok(())
    }

    /// What was driven.
    pub fn finish(mut self) -> Drive {
        let newest = self.estimator.as_ref().and_then(Estimator::estimate);
        if let Some(estimate) = newest
            && self.piece.is_some()
        {
            self.follow(estimate.stamp);
        }
        self.break_off();
        let faults = self.estimator.as_ref().map(Estimator::faults);
        Drive {
            pieces: self.pieces,
            fix_faults: self.fixes.faults(),
            fixes: self.fixes.taken(),
            faults: faults.unwrap_or_default(),
            counts: self.counts,
        }
    }
}

/// Settings of the filter for odometry.
fn settings_of(motion: &Motion) -> Result<Settings, SettingsError> {
    // Positions are not taken, so that it does not matter where the frame is.
    let frame = LocalFrame::new(Geodetic::default()).map_err(|_| SettingsError::NotFinite { name: "frame" })?;
    let mut settings = Settings::new(unit_of(motion.imu_variance), frame);
    [settings.scan.position_m, settings.scan.turn_rad] = SWEEP_ERRORS;
    settings.scans_to_begin = 1;
    settings.mounting = Mounting {
        body_from_imu: Isometry3::from_parts(motion.imu_position.into(), nalgebra::UnitQuaternion::identity()),
        ..Mounting::default()
    };
    Ok(settings)
}

//! Motion sensors: what they measured goes on to the log as it is, with where they are in the vehicle.

use nalgebra::{Isometry3, Translation3};
use realo_bags::messages::Measured;
use realo_logs::{ANTENNA_FRAME, AXLE_FRAME, Frames, IMU_FRAME, LogError, LogWriter, sensor_frame};
use realo_schemas::Nanos;

use super::Counted;
use super::agents::{Agent, Topic};
use super::clocks::AgentClock;
use super::small::{At, Motion};

/// What is still to be written of an agent's motion sensors, each in the order of its log times.
pub struct MotionQueue {
    motion: Motion,
    /// Messages that are written of the inertial unit, the receiver and the wheels.
    next: [usize; 3],
    written: [usize; 3],
    /// The vehicle frame from each of their frames.
    mounts: [Option<Isometry3<f64>>; 3],
}

impl MotionQueue {
    /// Of what a bag says; `height`: of the agent's frame over the ground, m.
    pub fn new(mut motion: Motion, agent: &Agent, frames: &Frames, height: f64, faults: &mut Counted) -> Self {
        fn ordered<T>(messages: &mut [At<Measured<T>>]) -> Option<(String, Nanos)> {
            messages.sort_by_key(|message| message.log_time);
            messages
                .first()
                .map(|first| (first.said.frame.clone(), first.said.stamp))
        }
        let firsts = [
            ordered(&mut motion.imu),
            ordered(&mut motion.fixes),
            ordered(&mut motion.wheels),
        ];
        let topics = [agent.imu.as_ref(), agent.receiver(), agent.wheels.as_ref()];
        let mut place = |first: Option<(String, Nanos)>, topic: Option<&Topic>| {
            let (frame, stamp) = first?;
            let vehicle_from_frame = Isometry3::from(Translation3::new(0.0, 0.0, height));
            match agent.map.mount(frames, &frame, stamp) {
                Ok(frame_from_sensor) => Some(vehicle_from_frame * frame_from_sensor),
                Err(reason) => {
                    let name = topic.map_or("", |topic| topic.name.as_str());
                    faults.add(name, format!("its sensor is nowhere: {reason}"));
                    None
                }
            }
        };
        let [imu, fixes, wheels] = firsts;
        let mounts = [place(imu, topics[0]), place(fixes, topics[1]), place(wheels, topics[2])];
        MotionQueue {
            motion,
            next: [0; 3],
            written: [0; 3],
            mounts,
        }
    }

    /// Messages that were written of the inertial unit, the receiver and the wheels.
    pub fn counts(&self) -> [usize; 3] {
        self.written
    }

    /// Writes what was there at a time of the log.
    pub fn write(
        &mut self,
        log: &mut LogWriter,
        agent: &str,
        clock: &AgentClock,
        until: Nanos,
    ) -> Result<(), LogError> {
        let times = |log_time: Nanos, stamp: Nanos| {
            let stamp = stamp.saturating_add(clock.stamp);
            (stamp, log_time.saturating_add(clock.ready).max(stamp))
        };
        let [imu, fix, wheels] = &mut self.next;
        let mut written = self.written;
        while let Some((stamp, ready, reading)) = due(&self.motion.imu, imu, until, times) {
            if let Some(pose) = self.mounts[0].filter(|_| stamp >= 0) {
                log.mount(agent, ready, &sensor_frame(agent, IMU_FRAME), &pose)?;
                log.imu(agent, stamp, ready, reading)?;
                written[0] += 1;
            }
        }
        while let Some((stamp, ready, reading)) = due(&self.motion.fixes, fix, until, times) {
            if let Some(pose) = self.mounts[1].filter(|_| stamp >= 0) {
                log.mount(agent, ready, &sensor_frame(agent, ANTENNA_FRAME), &pose)?;
                log.fix(agent, stamp, ready, reading)?;
                written[1] += 1;
            }
        }
        while let Some((stamp, ready, reading)) = due(&self.motion.wheels, wheels, until, times) {
            if let Some(pose) = self.mounts[2].filter(|_| stamp >= 0) {
                log.mount(agent, ready, &sensor_frame(agent, AXLE_FRAME), &pose)?;
                log.wheels(agent, stamp, ready, reading)?;
                written[2] += 1;
            }
        }
        self.written = written;
        Ok(())
    }
}

/// The next message that was there at a time: its stamp, when it was there, and what it says.
fn due<'a, T>(
    messages: &'a [At<Measured<T>>],
    next: &mut usize,
    until: Nanos,
    times: impl Fn(Nanos, Nanos) -> (Nanos, Nanos),
) -> Option<(Nanos, Nanos, &'a T)> {
    let At { log_time, said } = messages.get(*next)?;
    let (stamp, ready) = times(*log_time, said.stamp);
    if ready > until {
        return None;
    }
    *next += 1;
    Some((stamp, ready, &said.reading))
}

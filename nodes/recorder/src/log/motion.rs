//! Motion sensors of a message, each measurement as a message of its own in a log.

use nalgebra::Isometry3;
use realo_logs::{
    ANTENNA_FRAME, AXLE_FRAME, FixReading, IMU_FRAME, ImuReading, LogWriter, MapOrigin, WheelReading, sensor_frame,
};
use realo_operator::Error;
use realo_schemas::{Header, Motion};

use crate::RecorderError;

/// Writes what an agent's motion sensors gave, at the times at which it was measured and arrived.
///
/// `origin`: where the log's map is on the Earth; positions of a receiver need it.
///
/// # Errors
/// Positions without an origin; those of the writer.
pub(crate) fn write(
    log: &mut LogWriter,
    agent: &str,
    header: &Header,
    motion: &Motion,
    origin: Option<&MapOrigin>,
) -> Result<(), Error> {
    let mounts = [
        (IMU_FRAME, motion.imu.is_empty(), motion.imu_position),
        (ANTENNA_FRAME, motion.fixes.is_empty(), motion.antenna),
        (AXLE_FRAME, motion.wheels.is_empty(), motion.axle),
    ];
    for (sensor, is_silent, [x, y, z]) in mounts {
        if !is_silent {
            let at = Isometry3::translation(x, y, z);
            log.mount(agent, header.ready, &sensor_frame(agent, sensor), &at)?;
        }
    }
    for sample in &motion.imu {
        let reading = ImuReading {
            angular_rate: sample.angular_rate,
            specific_force: sample.specific_force,
            variance: motion.imu_variance,
        };
        log.imu(
            agent,
            sample.taken.stamp_in(header),
            sample.taken.arrival_in(header),
            &reading,
        )?;
    }
    for fix in &motion.fixes {
        let Some(origin) = origin else {
            return Err(RecorderError::NoOrigin(Box::new(header.clone())).into());
        };
        let [latitude, longitude, height] = origin.from_map(fix.position);
        let reading = FixReading {
            quality: Some(fix.quality),
            // Exactly 0 says that a height is not known.
            geodetic: [latitude, longitude, if fix.has_height { height } else { 0.0 }],
            covariance: fix.covariance,
        };
        log.fix(
            agent,
            fix.taken.stamp_in(header),
            fix.taken.arrival_in(header),
            &reading,
        )?;
    }
    for wheels in &motion.wheels {
        let reading = WheelReading {
            velocity: [wheels.speed, 0.0, 0.0],
            variance: wheels.variance,
        };
        log.wheels(
            agent,
            wheels.taken.stamp_in(header),
            wheels.taken.arrival_in(header),
            &reading,
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use nalgebra::Isometry3;
    use realo_logs::{AgentInfo, AgentKind, Log, LogInfo, LogWriter, Stream};
    use realo_operator::{Books, Sink};
    use realo_schemas::motion::Taken;
    use realo_schemas::{
        AgentState, FixQuality, GnssFix, Header, ImuSample, Kind, Motion, Nanos, PointCloud, PoseStatus, WheelSpeed,
    };

    use super::super::{Input, LogRecorder, Settings};

    const START: Nanos = 1_700_000_000_000_000_000;
    const MS: Nanos = 1_000_000;

    fn recorder(folder: &Path, origin: Option<[f64; 3]>) -> LogRecorder {
        let agent = AgentInfo {
            name: "cav1".into(),
            kind: AgentKind::Vehicle,
            footprint: None,
            sensor: String::new(),
            sensor_position: None,
        };
        let like = folder.join("like.mcap");
        let info = LogInfo {
            map_origin: origin,
            ..LogInfo::new("a test", vec![agent])
        };
        LogWriter::create(&like, &info).unwrap().finish().unwrap();
        LogRecorder::build(Settings {
            path: folder.join("cav1.mcap"),
            agent: "cav1".into(),
            kind: AgentKind::Vehicle,
            like,
            points: true,
        })
        .unwrap()
    }

    fn header(kind: Kind) -> Header {
        Header::origin(&"log".into(), &"cav1".into(), kind, 0, START, START + 60 * MS)
    }

    fn measured() -> Motion {
        let taken = |stamp: Nanos, arrival: Nanos| Taken {
            stamp: stamp * MS,
            arrival: -arrival * MS,
        };
        Motion {
            imu: (0..3)
                .map(|k| ImuSample {
                    taken: taken(10 * k, 40 - 10 * k),
                    angular_rate: [0.1, -0.2, 0.3 * k as f64],
                    specific_force: [0.5, 0.0, 9.8],
                })
                .collect(),
            imu_variance: Some([1e-6, 1e-4]),
            fixes: [true, false]
                .map(|has_height| GnssFix {
                    taken: taken(5, 3),
                    position: [120.5, -33.25, if has_height { 2.0 } else { -519.0 }],
                    has_height,
                    covariance: Some([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 4.0]),
                    quality: FixQuality::Differential,
                })
                .to_vec(),
            wheels: vec![WheelSpeed {
                taken: taken(7, 0),
                speed: -1.5,
                variance: None,
            }],
            imu_position: [0.5, 0.0, 0.4],
            antenna: [-0.5, 0.2, 1.5],
            axle: [-1.4, 0.0, 0.0],
        }
    }

    #[test]
    fn what_was_measured_is_read_back_when_and_where_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = recorder(folder.path(), Some([48.1, 11.6, 519.0]));
        let state = AgentState {
            map_from_body: Isometry3::identity(),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Recorded,
        };
        let motion = measured();
        recorder.accept(Input::Poses(header(Kind::AgentState), state)).unwrap();
        recorder
            .accept(Input::Motion(header(Kind::Motion), motion.clone()))
            .unwrap();
        recorder
            .accept(Input::Clouds(header(Kind::Points), PointCloud::empty()))
            .unwrap();
        recorder.finish(&Books::default()).unwrap();

        let log = Log::open(folder.path().join("cav1.mcap")).unwrap();
        let read = |stream: Stream| -> Vec<Motion> {
            let mut reader = log.read_all(&[("cav1", stream)]).unwrap();
            std::iter::from_fn(|| reader.next().unwrap())
                .map(|entry| entry.motion().unwrap())
                .collect()
        };
        let at = |taken: &Taken| Taken {
            stamp: START + taken.stamp,
            arrival: START + 60 * MS + taken.arrival,
        };
        let imu = read(Stream::Imu);
        assert_eq!(imu.len(), 3);
        for (read, sample) in imu.iter().zip(&motion.imu) {
            let expected = ImuSample {
                taken: at(&sample.taken),
                ..*sample
            };
            assert_eq!(
                (&read.imu[..], read.imu_variance),
                (&[expected][..], motion.imu_variance)
            );
            assert_eq!(read.imu_position, motion.imu_position);
        }
        let fixes = read(Stream::Fix);
        assert_eq!(fixes.len(), 2);
        for (read, fix) in fixes.iter().zip(&motion.fixes) {
            let found = read.fixes[0];
            assert_eq!((found.taken, found.has_height), (at(&fix.taken), fix.has_height));
            assert_eq!((found.covariance, found.quality), (fix.covariance, fix.quality));
            // A receiver without a height stands on the ellipsoid.
            for axis in 0..3 {
                assert!((found.position[axis] - fix.position[axis]).abs() < 2e-3, "{found:?}");
            }
            assert_eq!(read.antenna, motion.antenna);
        }
        let wheels = read(Stream::Wheels);
        let expected = WheelSpeed {
            taken: at(&motion.wheels[0].taken),
            ..motion.wheels[0]
        };
        assert_eq!((&wheels[0].wheels[..], wheels[0].axle), (&[expected][..], motion.axle));
    }

    #[test]
    fn positions_in_a_map_that_is_nowhere_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = recorder(folder.path(), None);
        let found = recorder
            .accept(Input::Motion(header(Kind::Motion), measured()))
            .unwrap_err()
            .to_string();
        assert!(found.contains("`map_origin`") && found.contains("`like`"), "{found}");
    }
}

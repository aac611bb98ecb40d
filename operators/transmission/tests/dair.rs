//! Sweeps of a vehicle and of a roadside unit at 1 cm, in the frame of the sensor and in that of its agent: a quarter of
//! their 16 bytes a point (x, y, z and intensity in f32).
//! Reads `$REALO_SHARED/data/dair`, which is in the layout of the original dataset.
//!
//! `cargo test --release -p realo-transmission --test dair -- --nocapture` says how many bytes, and how fast on this machine.

use std::path::{Path, PathBuf};
use std::time::Instant;

use realo_importer::{ROADSIDE, VEHICLE, lidar_height, read_pcd};
use realo_operator::Steps;
use realo_schemas::{Header, Kind, Message, Payload, PointCloud};
use realo_transmission::{Decoder, Encoder, EncoderConfig};

const STEP_M: f64 = 0.01;
/// Bytes of a point before it crosses and, at most, when it does.
const POINT: f64 = 16.0;
const CROSSING: f64 = 4.0;
/// Of which the fastest one counts.
const ROUNDS: usize = 9;

fn files(folder: &Path) -> Vec<PathBuf> {
    let files = std::fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    files.map(|file| file.unwrap().path()).collect()
}

/// A sweep of a sensor at such a height over the origin.
fn cloud(path: &Path, height: f64) -> PointCloud {
    let mut read = read_pcd(path).unwrap();
    read.z.iter_mut().for_each(|z| *z = (f64::from(*z) + height) as f32);
    let zeros = read.x.len();
    let (time, ring) = (vec![0; zeros], vec![0; zeros]);
    PointCloud::new(read.x, read.y, read.z, read.intensity, time, ring).expect("columns of one length")
}

/// What work gives, and the seconds of its fastest round.
fn timed<T>(mut work: impl FnMut() -> T) -> (T, f64) {
    let mut round = || {
        let begun = Instant::now();
        (work(), begun.elapsed().as_secs_f64())
    };
    let mut min = round();
    for _ in 1..ROUNDS {
        let (done, seconds) = round();
        min = (done, min.1.min(seconds));
    }
    min
}

/// Holds the cloud that came back against the one that was sent.
fn check(found: &PointCloud, sent: &PointCloud, path: &Path) {
    assert_eq!(found.intensity, sent.intensity, "{}", path.display());
    for (found, sent) in [(&found.x, &sent.x), (&found.y, &sent.y), (&found.z, &sent.z)] {
        // Half a step, and half of what separates numbers of f32 below 512 m.
        let bound = 0.5 * STEP_M + 0.5 * 2f64.powi(-15);
        let errors = found
            .iter()
            .zip(&**sent)
            .map(|(found, sent)| (f64::from(*found) - f64::from(*sent)).abs());
        let max = errors.fold(0.0, f64::max);
        assert!(found.len() == sent.len() && max <= bound, "{}: {max} m", path.display());
    }
}

#[test]
fn a_point_of_either_sensor_takes_a_quarter() {
    let Some(sample) = skipped::shared("data/dair") else {
        return;
    };
    let config = EncoderConfig {
        step_m: STEP_M,
        ..EncoderConfig::default()
    };
    let (mut encoder, mut decoder) = (Encoder::new(&config).unwrap(), Decoder::new(64 << 20).unwrap());
    let sensors = [("vehicle-side", VEHICLE), ("infrastructure-side", ROADSIDE)];
    let frames = sensors.map(|(side, agent)| [(side, 0.0), (side, lidar_height(agent))]);
    for (side, height) in frames.into_iter().flatten() {
        let files = files(&sample.join(side).join("velodyne"));
        assert!(files.len() >= 11, "{} sweeps", files.len());
        let (mut points, mut bytes, mut encoding, mut decoding) = (0.0, 0.0, 0.0, 0.0);
        for path in files {
            let sent = cloud(&path, height);
            let header = Header::origin(&"dair".into(), &side.into(), Kind::Points, 0, 0, 0);
            let message = Message::new(header, sent.clone());
            let untimed = &mut Steps::default();
            let (packet, took) = timed(|| encoder.encode(&message, untimed).unwrap().0);
            encoding += took;
            let (content, took) = timed(|| decoder.decode(&packet.bytes, untimed).unwrap());
            decoding += took;
            let Payload::PointCloud(found) = content.payload else {
                panic!("not points")
            };
            check(&found, &sent, &path);
            let crossing = packet.bytes.len() as f64;
            assert!(
                crossing <= CROSSING * sent.len() as f64,
                "{}: {crossing} bytes",
                path.display()
            );
            points += sent.len() as f64;
            bytes += crossing;
        }
        let rate = |seconds: f64| POINT * points / 1e6 / seconds;
        println!(
            "{side}, {height} m high: {:.2} bytes a point, encoder {:.0} MB/s, decoder {:.0} MB/s of {POINT} bytes a point",
            bytes / points,
            rate(encoding),
            rate(decoding)
        );
    }
}

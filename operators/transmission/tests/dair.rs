//! Sweeps of a vehicle and of a roadside unit at 1 cm: a quarter of their 16 bytes a point (x, y, z and intensity in f32).
//! Reads `$REALO_SHARED/data/dair`, which is in the layout of the original dataset.

use std::path::{Path, PathBuf};

use realo_importer::read_pcd;
use realo_operator::Steps;
use realo_schemas::{Header, Kind, Message, Payload, PointCloud};
use realo_transmission::{Decoder, Encoder, EncoderConfig};

const STEP_M: f64 = 0.01;
const BYTES_OF_A_POINT: f64 = 4.0;

fn files(folder: &Path) -> Vec<PathBuf> {
    let files = std::fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    files.map(|file| file.unwrap().path()).collect()
}

fn cloud(path: &Path) -> PointCloud {
    let read = read_pcd(path).unwrap();
    let count = read.x.len();
    PointCloud::new(read.x, read.y, read.z, read.intensity, vec![0; count], vec![0; count])
        .expect("columns of one length")
}

fn greatest_error(found: &[f32], sent: &[f32]) -> f64 {
    let errors = found
        .iter()
        .zip(sent)
        .map(|(found, sent)| (f64::from(*found) - f64::from(*sent)).abs());
    errors.fold(0.0, f64::max)
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
    for side in ["vehicle-side", "infrastructure-side"] {
        let files = files(&sample.join(side).join("velodyne"));
        assert!(files.len() >= 11, "{} sweeps", files.len());
        for path in files {
            let sent = cloud(&path);
            let header = Header::origin(&"dair".into(), &side.into(), Kind::Points, 0, 0, 0);
            let message = Message::new(header, sent.clone());
            let (packet, dropped) = encoder.encode(&message, &mut Steps::default()).unwrap();
            assert_eq!(dropped.points, 0);
            let bytes = packet.bytes.len() as f64 / sent.len() as f64;
            assert!(bytes <= BYTES_OF_A_POINT, "{}: {bytes} bytes a point", path.display());
            let content = decoder.decode(&packet.bytes, &mut Steps::default()).unwrap();
            let Payload::PointCloud(found) = content.payload else {
                panic!("not points")
            };
            assert_eq!(found.len(), sent.len());
            assert_eq!(found.intensity, sent.intensity);
            for (found, sent) in [(&found.x, &sent.x), (&found.y, &sent.y), (&found.z, &sent.z)] {
                // Half a step, and half of what separates numbers of f32 below 512 m.
                let bound = 0.5 * STEP_M + 0.5 * 2f64.powi(-15);
                let error = greatest_error(found, sent);
                assert!(error <= bound, "{}: {error} m", path.display());
            }
        }
    }
}

//! How long a message of a collaborator takes the guard: 40 cars and 20 pedestrians that both see, a pose that is 3 m and 2° wrong.
//!
//! `cargo run --release -p realo-fusion-guard --example time`

use std::time::Instant;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2};
use realo_fusion_guard::{Ego, Limits, Noise, Origin, Reach, Record, Said, View, judge, objects};
use realo_schemas::geometry::transform_box;
use realo_schemas::{Box3, PointCloud};

fn town() -> Vec<Box3> {
    let place = |n: usize| {
        let (sin, cos) = libm::sincos(2.4 * n as f64);
        let range = 6.0 + 0.9 * n as f64;
        ([range * cos, range * sin], 0.37 * n as f64)
    };
    let object = |n: usize| {
        let ([x, y], yaw) = place(n);
        let (class, size) = if n % 3 == 2 {
            ("Pedestrian", [0.6, 0.6, 1.7])
        } else {
            ("Car", [4.5, 1.9, 1.6])
        };
        Box3::new(class, [x, y, 0.8], size, yaw)
    };
    (0..60).map(object).collect()
}

/// Flat ground as 128 beams see it.
fn sweep() -> Option<PointCloud> {
    let (mut x, mut y, mut ring) = (vec![], vec![], vec![]);
    for beam in 0..128u16 {
        let range = 3.0 + 0.5 * f64::from(beam);
        for column in 0..1800 {
            let (sin, cos) = libm::sincos(f64::from(column) * std::f64::consts::TAU / 1800.0);
            x.push((range * cos) as f32);
            y.push((range * sin) as f32);
            ring.push(beam);
        }
    }
    let n = x.len();
    PointCloud::new(x, y, vec![0.0f32; n], vec![9u8; n], vec![0; n], ring)
}

fn median(mut call: impl FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..51)
        .map(|_| {
            let start = Instant::now();
            call();
            1000.0 * start.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let right = Isometry3::from_parts(
        Translation3::new(30.0, 12.0, 0.0),
        UnitQuaternion::from_euler_angles(0.0, 0.0, 2.0),
    );
    let wrong = Isometry3::from_parts(
        Translation3::new(32.1, 9.9, 0.0),
        UnitQuaternion::from_euler_angles(0.0, 0.0, 2.035),
    );
    let theirs: Vec<Box3> = town()
        .iter()
        .map(|object| transform_box(&right.inverse(), object))
        .collect();
    let own = objects(&town(), &Isometry3::identity(), 0.0, 256);
    let sweep = sweep().ok_or("columns of one length")?;
    let limits = Limits {
        noise: Noise {
            place_m: 0.3,
            heading_rad: 0.07,
            pose_m: 5.0,
            pose_rad: 0.1,
        },
        reach: Reach {
            metres: 12.0,
            turn: 0.21,
        },
        clock_s: 0.0,
        max_boxes: 256,
        max_objects: 64,
        moves: false,
    };
    let origin = Origin {
        ego_from_sender: wrong,
        sender: Vector2::new(32.1, 9.9),
        age_s: 0.0,
        stated: None,
    };
    let view = View::of(&sweep);
    let ego = Ego {
        objects: &own,
        own: own.len(),
        view: Some(&view),
    };
    let said = Said {
        boxes: &theirs,
        impossible: 0,
    };
    let found = judge(&said, &ego, &origin, &Record::default(), &limits)?;
    println!(
        "the ego's sweep of {} points: {:.2} ms",
        sweep.len(),
        median(|| drop(View::of(&sweep)))
    );
    let judged = median(|| drop(judge(&said, &ego, &origin, &Record::default(), &limits)));
    println!(
        "a message of {} boxes: {judged:.2} ms; corrected by {:.2} m",
        theirs.len(),
        found.shift.metres()
    );
    Ok(())
}

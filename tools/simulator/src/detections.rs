//! What a detector might have made of a sweep: the simulated "recorded detections".
//!
//! The noise model. An object with n own points at range R (m) is found with probability `1 − exp(−n/8)`, if n is at
//! smallest `detection_min_points`. Its box errs by
//!
//! | what | standard deviation |
//! |---|---|
//! | position along x and y, m | `0.05 + 0.001·R + 0.25/√n` |
//! | height of the centre, m | half of that |
//! | length, width, height | `2 % + 15 %/√n` of each |
//! | yaw, degrees | `1 + 15/√n`; beyond that, one in 40 boxes of vehicles is turned by half a turn |
//! | velocity along x and y, m/s | 0.3 |
//!
//! and its score is `1/(1 + exp(−(0.9·ln n − 1.6 + 0.6·N(0,1))))`. False alarms: on average 1.2 a sweep, Poisson, with
//! the size of a car or a pedestrian anywhere within 80 m, scores uniform in [0.05, 0.45].

use realo_schemas::{Box3, Boxes};

use crate::options::Options;
use crate::random::Stream;

const FALSE_ALARMS: f64 = 1.2;

/// The recorded detections of a sweep, from the truth in the agent's body frame and the own points on each object.
pub(crate) fn detect(options: &Options, truth: &[Box3], points: &[u32], mut draws: Stream) -> Boxes {
    let seen = truth
        .iter()
        .zip(points)
        .filter(|(_, n)| **n >= options.detection_min_points.max(1));
    if options.noise_free_detections {
        return Boxes(
            seen.map(|(object, _)| Box3 {
                track: None,
                ..object.clone()
            })
            .collect(),
        );
    }
    let mut boxes: Vec<Box3> = seen
        .filter_map(|(object, n)| perceive(object, f64::from(*n), &mut draws))
        .collect();
    for _ in 0..poisson(FALSE_ALARMS, &mut draws) {
        boxes.push(imagine(&mut draws));
    }
    Boxes(boxes)
}

fn perceive(object: &Box3, n: f64, draws: &mut Stream) -> Option<Box3> {
    let [x, y, z] = object.center;
    let range = (x * x + y * y).sqrt();
    let few = 1.0 / n.sqrt();
    // Every object takes the same number of draws, found or not.
    let noise: [f64; 10] = std::array::from_fn(|_| draws.normal());
    let (found, turned) = (draws.chance(1.0 - libm::exp(-n / 8.0)), draws.chance(0.025));
    let place = 0.05 + 0.001 * range + 0.25 * few;
    let scale = |k: usize| (1.0 + (0.02 + 0.15 * few) * noise[k]).clamp(0.5, 1.6);
    let half_turn = if turned && object.length > 2.5 {
        std::f64::consts::PI
    } else {
        0.0
    };
    let yaw = object.yaw + (1.0 + 15.0 * few).to_radians() * noise[6] + half_turn;
    let strength = 0.9 * libm::log(n) - 1.6 + 0.6 * noise[7];
    found.then(|| Box3 {
        center: [x + place * noise[0], y + place * noise[1], z + 0.5 * place * noise[2]],
        length: object.length * scale(3),
        width: object.width * scale(4),
        height: object.height * scale(5),
        yaw: realo_schemas::geometry::normalize_yaw(yaw),
        velocity: object
            .velocity
            .map(|[vx, vy, _]| [vx + 0.3 * noise[8], vy + 0.3 * noise[9], 0.0]),
        class: object.class.clone(),
        score: (1.0 / (1.0 + libm::exp(-strength))) as f32,
        track: None,
        covariance: Some([place * place, 0.0, 0.0, 0.0, place * place, 0.0, 0.0, 0.0, {
            let yaw = (1.0 + 15.0 * few).to_radians();
            yaw * yaw
        }]),
    })
}

fn imagine(draws: &mut Stream) -> Box3 {
    let car = draws.chance(0.6);
    let [length, width, height] = if car { [4.3, 1.9, 1.55] } else { [0.7, 0.6, 1.7] };
    let range = 80.0 * draws.unit().sqrt();
    let (sin, cos) = libm::sincos(draws.between(0.0, std::f64::consts::TAU));
    Box3 {
        center: [range * cos, range * sin, height / 2.0 + 0.1 * draws.normal()],
        length,
        width,
        height,
        yaw: draws.between(-std::f64::consts::PI, std::f64::consts::PI),
        velocity: Some([0.0; 3]),
        class: if car { "Car" } else { "Pedestrian" }.into(),
        score: draws.between(0.05, 0.45) as f32,
        track: None,
        covariance: None,
    }
}

/// A Poisson draw by counting exponential gaps.
fn poisson(mean: f64, draws: &mut Stream) -> usize {
    let mut at = draws.exponential(1.0);
    let mut n = 0;
    while at < mean {
        n += 1;
        at += draws.exponential(1.0);
    }
    n
}

//! A sweep with so many points as one can look at.

use realo_schemas::{Message, Payload, PointCloud};

/// Points of a sweep that stay, about.
const WANTED: usize = 12_000;
/// Points that are looked at for each that stays: the rest of a sweep is passed over unread.
const LOOKS: usize = 6;
/// Points below this height above the ground say least, m.
const GROUND_M: f32 = 0.3;
/// So much rarer they are.
const GROUND_SHARE: f32 = 0.15;
/// Points further than this are as rare as they come, m.
const FAR_M: f32 = 60.0;

/// The message, with some of the points if it is a sweep of many.
pub(super) fn thinned(message: Message) -> Message {
    match &message.payload {
        Payload::PointCloud(cloud) if cloud.len() > WANTED => Message {
            payload: some_of(cloud).into(),
            ..message
        },
        _ => message,
    }
}

/// Some points: many of what is far or high, as a sensor sees little of it, and few of the ground around it.
fn some_of(cloud: &PointCloud) -> PointCloud {
    let step = (cloud.len() / (WANTED * LOOKS)).max(1);
    let looked: Vec<(usize, f32)> = (0..cloud.len())
        .step_by(step)
        .map(|at| (at, weight(cloud.x[at], cloud.y[at], cloud.z[at])))
        .collect();
    let share = share_of(&looked);
    let kept = looked.into_iter().filter(|(at, weight)| draw(*at) < share * weight);
    let kept: Vec<usize> = kept.map(|(at, _)| at).collect();
    PointCloud {
        x: kept.iter().map(|at| cloud.x[*at]).collect(),
        y: kept.iter().map(|at| cloud.y[*at]).collect(),
        z: kept.iter().map(|at| cloud.z[*at]).collect(),
        intensity: kept.iter().map(|at| cloud.intensity[*at]).collect(),
        time: kept.iter().map(|at| cloud.time[*at]).collect(),
        ring: kept.iter().map(|at| cloud.ring[*at]).collect(),
    }
}

/// How much a point says, 0 to 1: on a surface that is twice as far there is a quarter of the points.
fn weight(x: f32, y: f32, z: f32) -> f32 {
    let near = ((x * x + y * y) / (FAR_M * FAR_M)).min(1.0);
    match z < GROUND_M {
        true => GROUND_SHARE * near,
        false => near.max(0.01),
    }
}

/// The factor of weights by which about [`WANTED`] points stay: one of weight 1 or more by then stays for sure.
fn share_of(looked: &[(usize, f32)]) -> f32 {
    let kept = |share: f32| looked.iter().map(|(_, weight)| (share * weight).min(1.0)).sum::<f32>();
    let mut share = WANTED as f32 / kept(1.0).max(1.0);
    for _ in 0..3 {
        let stay = kept(share);
        if stay > 0.9 * WANTED as f32 {
            break;
        }
        share *= WANTED as f32 / stay.max(1.0);
    }
    share
}

/// A number in [0, 1) of a place, the same each time.
fn draw(at: usize) -> f32 {
    let mixed = (at as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mixed = (mixed ^ mixed >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    (mixed >> 40) as f32 / (1u64 << 24) as f32
}

#[cfg(test)]
mod tests {
    use realo_schemas::{Header, Kind};

    use super::*;

    /// A ground plane as 128 beams see it, and a wall of 600 points, 50 m ahead.
    fn sweep() -> PointCloud {
        let mut points = Vec::new();
        for beam in 0..128 {
            let range = 2.0 + 0.4 * beam as f32;
            for step in 0..1800 {
                let (sin, cos) = (step as f32 * std::f32::consts::TAU / 1800.0).sin_cos();
                points.push([range * cos, range * sin, 0.0]);
            }
        }
        points.extend((0..600).map(|at| [50.0, at as f32 * 0.01, 1.5]));
        let column = |axis: usize| points.iter().map(|point: &[f32; 3]| point[axis]).collect::<Vec<f32>>();
        let n = points.len();
        PointCloud::new(
            column(0),
            column(1),
            column(2),
            vec![0u8; n],
            vec![0i32; n],
            vec![0u16; n],
        )
        .unwrap()
    }

    #[test]
    fn about_the_wanted_points_stay_and_more_of_what_is_high_and_far() {
        let cloud = sweep();
        let thin = some_of(&cloud);
        assert!((8_000..=14_000).contains(&thin.len()), "{} points", thin.len());
        let share = |cloud: &PointCloud| cloud.z.iter().filter(|z| **z > 1.0).count() as f32 / cloud.len() as f32;
        assert!(
            share(&thin) > 2.0 * share(&cloud),
            "{} of {}",
            share(&thin),
            share(&cloud)
        );
        assert_eq!(some_of(&cloud), thin, "the same each time");
    }

    #[test]
    fn a_small_sweep_and_other_messages_stay_as_they_are() {
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Points, 0, 0, 0);
        let small = PointCloud::new(vec![1.0], vec![1.0], vec![1.0], vec![1u8], vec![1], vec![1u16]).unwrap();
        let message = Message::new(header, small);
        assert_eq!(thinned(message.clone()), message);
    }
}

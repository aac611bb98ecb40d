//! Bodies of walkers and riders.

use super::vehicles::TYRE;
use crate::solid::{Part, Shape, Solid};

/// Somebody on two wheels; `frame` is half the machine's own width.
pub(crate) fn rider([length, width, height]: [f64; 3], paint: f64, frame: f64) -> Solid {
    let (l, h, w) = (length / 2.0, height, width / 2.0);
    let radius: f64 = if frame > 0.05 { 0.26 } else { 0.34 };
    let tread = frame.max(0.03);
    let wheel = |x: f64| {
        Part::solid(
            Shape::Wheel {
                x,
                z: radius,
                radius,
                low: -tread,
                high: tread,
            },
            TYRE,
        )
    };
    let (hip, shoulder) = (0.5 * h, 0.84 * h);
    let leg = |y: f64| {
        Part::solid(
            Shape::Post {
                x: 0.0,
                y,
                radius: 0.075,
                low: 0.2,
                high: hip + 0.05,
                swing: 0.08,
            },
            0.25,
        )
    };
    let bar = 0.58 * h;
    Solid::new(vec![
        wheel(-l + radius),
        wheel(l - radius),
        Part::block(
            [-l + radius, -frame, 0.3],
            [l - radius, frame, 0.46 * h],
            0.3 * paint + 0.05,
        ),
        Part::block([0.42 * l, -w, bar], [0.42 * l + 0.06, w, bar + 0.06], 0.2),
        leg(-0.13),
        leg(0.13),
        Part::solid(
            Shape::Ball {
                center: [-0.02, 0.0, (hip + shoulder) / 2.0],
                radii: [0.2, 0.22, 0.24 * h],
            },
            0.15 + 0.5 * paint,
        ),
        Part::block(
            [0.0, -w + 0.08, 0.7 * h],
            [0.44 * l, w - 0.08, 0.7 * h + 0.1],
            0.15 + 0.5 * paint,
        ),
        Part::solid(
            Shape::Ball {
                center: [0.08, 0.0, h - 0.13],
                radii: [0.11, 0.1, 0.13],
            },
            0.3,
        ),
    ])
}

pub(crate) fn walker(size: [f64; 3], cloth: f64) -> Solid {
    Solid::new(figure(size, cloth, 0.0))
}

/// The parts of somebody on foot whose middle is `x` ahead of the body's.
pub(crate) fn figure([length, width, height]: [f64; 3], cloth: f64, x: f64) -> Vec<Part> {
    let (l, h, w) = (length / 2.0, height, width / 2.0);
    let (hip, shoulder) = (0.5 * h, 0.84 * h);
    let leg = 0.045 * h;
    let arm = 0.03 * h;
    let limb = |y: f64, radius: f64, low: f64, high: f64, swing: f64| {
        Part::solid(
            Shape::Post {
                x,
                y,
                radius,
                low,
                high,
                swing,
            },
            cloth,
        )
    };
    let head = 0.07 * h;
    vec![
        limb(-0.3 * w, leg, 0.0, hip, l - leg),
        limb(0.3 * w, leg, 0.0, hip, -(l - leg)),
        limb(-w + arm, arm, 0.45 * h, shoulder, -(l - arm) * 0.7),
        limb(w - arm, arm, 0.45 * h, shoulder, (l - arm) * 0.7),
        Part::solid(
            Shape::Ball {
                center: [x, 0.0, 0.66 * h],
                radii: [0.075 * h, w - 1.6 * arm, 0.21 * h],
            },
            cloth,
        ),
        Part::solid(
            Shape::Ball {
                center: [x + 0.02, 0.0, h - 0.085 * h],
                radii: [head, 0.9 * head, 0.085 * h],
            },
            0.4,
        ),
    ]
}

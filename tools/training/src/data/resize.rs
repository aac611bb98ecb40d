//! Objects of other sizes: recorded ones are not as large as ours.

use super::outline::{Outline, Outlines};
use super::sample::Scene;
use crate::random::Stream;

/// How far outside its box a point still lies on an object, m: objects move during a sweep.
const MARGIN: f32 = 0.15;

/// What rises less above the ground below an object is ground, m.
const ABOVE_GROUND: f32 = 0.1;

/// Makes each object greater or smaller along its length, width and height, by a factor each, about its middle on the ground, with the
/// points on it.
pub(crate) fn resize(scene: &mut Scene, [min, max]: [f64; 2], draws: &mut Stream) {
    if min == max {
        return;
    }
    let (mut outlines, mut factors) = (Vec::new(), Vec::new());
    for object in scene.objects.iter_mut().chain(&mut scene.faint) {
        let by = [(); 3].map(|()| draws.between(min, max));
        outlines.push(Outline::new(&object.hwl, MARGIN));
        factors.push(by.map(|factor| factor as f32));
        let [_, _, z, height, width, length, _] = &mut object.hwl;
        *z += 0.5 * *height * (by[2] - 1.0);
        [*length, *width, *height] = [*length * by[0], *width * by[1], *height * by[2]];
    }
    let outlines = Outlines::new(outlines);
    let [x, y, z] = &mut scene.columns;
    for ((x, y), z) in x.iter_mut().zip(y).zip(z) {
        let Some((number, outline)) = outlines.at([*x, *y, *z]) else {
            continue;
        };
        let (ground, [along, across]) = (outline.heights[0] + MARGIN, outline.local([*x, *y]));
        if *z - ground < ABOVE_GROUND {
            continue;
        }
        let [of_length, of_width, of_height] = factors[number];
        [*x, *y] = outline.place([along * of_length, across * of_width]);
        *z = ground + (*z - ground) * of_height;
    }
}

#[cfg(test)]
mod tests {
    use crate::targets::Object;

    use super::*;

    /// A car on ground at a height of 0.5 m, with points on its corners and half way up, on the ground below it, and beside it.
    fn scene() -> Scene {
        let car = Object {
            class: 0,
            hwl: [20.0, 4.0, 1.3, 1.6, 1.9, 4.5, 0.7],
        };
        let mut scene = Scene {
            objects: vec![car],
            ..Scene::default()
        };
        let outline = Outline::new(&scene.objects[0].hwl, 0.0);
        for corner in [[2.2, 0.9], [2.2, -0.9], [-2.2, -0.9], [-2.2, 0.9]] {
            let [x, y] = outline.place(corner);
            scene.push([x, y, 1.3], 0);
        }
        scene.push([20.0, 4.0, 0.52], 0);
        scene.push([20.0, 12.0, 1.3], 0);
        scene
    }

    #[test]
    fn objects_are_resized_with_their_points_and_nothing_else_moves() {
        let before = scene();
        let outline = Outline::new(&before.objects[0].hwl, 0.0);
        let mut sizes = [(); 3].map(|()| Vec::new());
        for number in 0..100 {
            let mut scene = scene();
            resize(&mut scene, [0.8, 1.3], &mut Stream::new(1, "test", number));
            let [x, y, z, height, width, length, yaw] = scene.objects[0].hwl;
            assert!((z - height / 2.0 - 0.5).abs() < 1e-9, "it stands on the ground");
            assert_eq!((x, y, yaw), (20.0, 4.0, 0.7));
            let by = [length / 4.5, width / 1.9, height / 1.6];
            sizes.iter_mut().zip(by).for_each(|(sizes, by)| sizes.push(by));
            let by = by.map(|factor| factor as f32);
            for (point, was) in scene.iter().zip(before.iter()).take(4) {
                let ([a, b], [along, across]) = (outline.local([point[0], point[1]]), outline.local([was[0], was[1]]));
                let off = [a - along * by[0], b - across * by[1], point[2] - 0.5 - 0.8 * by[2]];
                assert!(off.iter().all(|off| off.abs() < 1e-4), "{number}: off by {off:?}");
            }
            assert!(scene.iter().skip(4).eq(before.iter().skip(4)));
        }
        for sizes in sizes {
            let [min, max] = [f64::min, f64::max].map(|of| sizes.iter().copied().reduce(of).unwrap());
            assert!(
                (0.8..0.85).contains(&min) && (1.25..1.3).contains(&max),
                "{min} to {max}"
            );
        }
        let mut same = scene();
        resize(&mut same, [1.0, 1.0], &mut Stream::new(1, "test", 0));
        assert_eq!(same, before);
    }
}

//! More background around far objects, or none. Cars that vehicles recorded beyond 50 m stand beside hedges and below the crowns of
//! trees, among more points than simulated ones, and what learned from these alone takes them for background; those that a
//! roadside unit recorded across a wide junction stand among fewer.

use crate::targets::Object;

use super::cells::{CellMap, Cells};
use super::outline::{Outline, Outlines};
use super::sample::Scene;
use crate::random::Stream;

/// Objects further from the ego, m, are far.
const FAR: f32 = 30.0;

/// How far the middle of a piece lies from an object's, m.
const ASIDE: [f64; 2] = [0.0, 7.0];

/// How far a piece reaches from its middle, m.
const REACH: f32 = 4.0;

/// By how much a piece may have been nearer or further than where it comes to, m: points are as dense as a sensor makes them there.
const ALIKE: f32 = 8.0;

/// How high above the ground background is, m.
const HEIGHTS: std::ops::Range<f32> = 0.3..6.0;

/// What is left free around objects and above them, m.
const GAP: f32 = 0.25;

/// Pieces beside an object at most.
const MOST: usize = 2;

/// How far from the middle of an object there is nothing once its surroundings are cleared, m, and from which height above ground to which.
const CLEARED: f32 = 8.0;
const CLEARED_HEIGHTS: std::ops::Range<f32> = 0.3..3.5;

/// Side of the cells whose lowest points tell the ground, m.
const CELL: f32 = 4.0;

/// Puts background of other places, which is as far from the ego, around each far object with a probability, and as much anywhere else,
/// so that it reports of no object. It may stand on a road, and in front of what is still seen behind it: foliage lets rays through.
pub(crate) fn crowd(scene: &mut Scene, probability: f64, draws: &mut Stream) {
    let objects: Vec<Object> = scene.seen().copied().collect();
    if probability == 0.0 || !objects.iter().any(is_far) {
        return;
    }
    let outlines = outlines(&objects);
    let background = Background::new(scene, &outlines);
    for object in &objects {
        let [x, y, z, height, ..] = object.hwl.map(|number| number as f32);
        if !is_far(object) || !draws.chance(probability) {
            continue;
        }
        let ground = z - 0.5 * height;
        for _ in 0..1 + draws.below(MOST) {
            let far = draws.between(ASIDE[0], ASIDE[1]);
            let [dx, dy] = anywhere(far, draws);
            let beside = [x + dx, y + dy];
            let elsewhere = anywhere(f64::from(beside[0].hypot(beside[1])), draws);
            for place in [beside, elsewhere] {
                for ([x, y, up], source) in background.piece(place, draws) {
                    let point = [x, y, ground + up];
                    if outlines.at(point).is_none() {
                        scene.push(point, source);
                    }
                }
            }
        }
    }
}

/// Takes, with a probability, the background around all far objects away, and as much anywhere else, so that what is missing reports of no
/// object.
pub(crate) fn clear(scene: &mut Scene, probability: f64, draws: &mut Stream) {
    if !draws.chance(probability) {
        return;
    }
    let objects: Vec<Object> = scene.seen().copied().collect();
    let mut places = Vec::new();
    for object in objects.iter().filter(|object| is_far(object)) {
        let [x, y] = [object.hwl[0], object.hwl[1]];
        places.extend([[x as f32, y as f32], anywhere(x.hypot(y), draws)]);
    }
    let mut cleared = Cells::new(CELL);
    for (number, place) in places.iter().enumerate() {
        cleared.add(number as u32, *place, CLEARED);
    }
    let (outlines, lowest) = (outlines(&objects), Lowest::of(scene));
    let stays = |point: [f32; 3]| {
        let [x, y, z] = point;
        let is_within = |number: &u32| {
            let [px, py] = places[*number as usize];
            (px - x).hypot(py - y) < CLEARED
        };
        !cleared.at([x, y]).iter().any(is_within)
            || !CLEARED_HEIGHTS.contains(&(z - lowest.at([x, y])))
            || outlines.at(point).is_some()
    };
    scene.retain(stays);
}

/// A place so far, m, in any direction.
fn anywhere(distance: f64, draws: &mut Stream) -> [f32; 2] {
    let (sin, cos) = (draws.unit() * std::f64::consts::TAU).sin_cos();
    [cos, sin].map(|part| (distance * part) as f32)
}

fn is_far(object: &Object) -> bool {
    object.hwl[0].hypot(object.hwl[1]) >= FAR.into()
}

/// The lowest point of each cell, which reports the ground.
struct Lowest {
    cells: Cells,
    lowest: CellMap<f32>,
}

impl Lowest {
    fn of(scene: &Scene) -> Self {
        let cells = Cells::new(CELL);
        let mut lowest: CellMap<f32> = CellMap::default();
        for [x, y, z] in scene.iter() {
            let min = lowest.entry(cells.cell([x, y])).or_insert(z);
            *min = min.min(z);
        }
        Lowest { cells, lowest }
    }

    /// That of the cell of one of the points.
    fn at(&self, place: [f32; 2]) -> f32 {
        self.lowest[&self.cells.cell(place)]
    }
}

fn outlines(objects: &[Object]) -> Outlines {
    Outlines::new(objects.iter().map(|object| Outline::new(&object.hwl, GAP)).collect())
}

/// What stands beside objects, by how far it is.
struct Background {
    /// x, y, height above the ground below, and the number of the sweep.
    points: Vec<([f32; 3], u8)>,
    /// Numbers of the points, by their distance.
    by_distance: Vec<(f32, u32)>,
    cells: Cells,
}

impl Background {
    fn new(scene: &Scene, outlines: &Outlines) -> Self {
        let mut cells = Cells::new(CELL);
        let lowest = Lowest::of(scene);
        let (mut points, mut by_distance) = (Vec::new(), Vec::new());
        for ([x, y, z], source) in scene.iter().zip(&scene.sources) {
            let distance = x.hypot(y);
            if distance < FAR - ALIKE {
                continue;
            }
            let up = z - lowest.at([x, y]);
            if !HEIGHTS.contains(&up) || outlines.at([x, y, z]).is_some() {
                continue;
            }
            let number = points.len() as u32;
            cells.add(number, [x, y], 0.0);
            by_distance.push((distance, number));
            points.push(([x, y, up], *source));
        }
        by_distance.sort_by(|a, b| a.0.total_cmp(&b.0));
        Background {
            points,
            by_distance,
            cells,
        }
    }

    /// A piece that is as far from the ego as a place, turned about the ego and moved along the ray to this place.
    fn piece(&self, [x, y]: [f32; 2], draws: &mut Stream) -> Vec<([f32; 3], u8)> {
        let distance = x.hypot(y);
        let from = self.by_distance.partition_point(|(at, _)| *at < distance - ALIKE);
        let until = self.by_distance.partition_point(|(at, _)| *at <= distance + ALIKE);
        if from == until {
            return Vec::new();
        }
        let (source, number) = self.by_distance[from + draws.below(until - from)];
        let ([from_x, from_y, _], _) = self.points[number as usize];
        let (sin, cos) = (y.atan2(x) - from_y.atan2(from_x)).sin_cos();
        let along = (distance - source) / distance;
        let near = self.cells.near([from_x, from_y], REACH);
        near.map(|number| self.points[number as usize])
            .filter(|([px, py, _], _)| (px - from_x).hypot(py - from_y) < REACH)
            .map(|([px, py, up], source)| {
                let turned = [cos * px - sin * py + along * x, sin * px + cos * py + along * y, up];
                (turned, source)
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Flat ground, a hedge at (0, 60) and two cars, of which one is far.
    fn scene() -> Scene {
        let mut scene = Scene::default();
        let car = |x: f64, y: f64| Object {
            class: 0,
            hwl: [x, y, 0.8, 1.6, 1.9, 4.5, 0.4],
        };
        scene.objects = vec![car(12.0, 3.0), car(58.0, 8.0)];
        scene.ego_points = vec![9, 9];
        for step in 0..160 {
            let along = step as f32 - 80.0;
            [-62.0, 0.0, 8.0, 62.0]
                .iter()
                .for_each(|y| scene.push([along, *y, 0.1], 0));
        }
        for step in 0..60 {
            scene.push([0.1 * step as f32 - 3.0, 61.0, 0.4 + 0.02 * step as f32], 0);
        }
        scene
    }

    #[test]
    fn pieces_come_beside_far_objects_and_as_often_elsewhere_and_leave_objects_free() {
        let before = scene();
        let count = before.iter().count();
        let outlines = outlines(&before.objects);
        let mut more = [Vec::new(), Vec::new()];
        for number in 0..40 {
            let mut crowded = scene();
            crowd(&mut crowded, 1.0, &mut Stream::new(1, "crowd", number));
            let points: Vec<[f32; 3]> = crowded.iter().collect();
            assert_eq!(
                points[..count],
                before.iter().collect::<Vec<_>>(),
                "nothing that was there moves"
            );
            for [x, y, z] in &points[count..] {
                assert!(
                    (0.3..1.7).contains(z) && outlines.at([*x, *y, *z]).is_none(),
                    "({x}, {y}, {z})"
                );
                let distance = x.hypot(*y);
                assert!((47.0..70.0).contains(&distance), "{distance} m, the car at 58.5");
            }
            let is_beside = |[x, y, _]: &&[f32; 3]| (x - 58.0).hypot(y - 8.0) < 12.0;
            let beside = points[count..].iter().filter(is_beside).count();
            more[0].push(beside);
            more[1].push(points.len() - count - beside);
        }
        for more in more {
            assert!(more.iter().filter(|more| **more > 20).count() > 25, "{more:?}");
        }
        let mut same = scene();
        crowd(&mut same, 0.0, &mut Stream::new(1, "crowd", 0));
        assert_eq!(same, before);
    }

    #[test]
    fn background_goes_around_far_objects_and_elsewhere_and_nothing_else_does() {
        let mut before = scene();
        // On the far car, beside it below 0.3 m, well above it, and beside the near one.
        for point in [[58.0, 8.0, 1.0], [58.0, 12.0, 0.2], [58.0, 12.0, 4.5], [12.0, 6.0, 1.0]] {
            before.push(point, 0);
        }
        (0..50).for_each(|step| before.push([56.0 + 0.07 * step as f32, 12.0, 1.0], 0));
        let points: Vec<[f32; 3]> = before.iter().collect();
        let hedge = |point: &[f32; 3]| point[1] == 61.0;
        let mut thinner = 0;
        for number in 0..40 {
            let mut cleared = before.clone();
            clear(&mut cleared, 1.0, &mut Stream::new(1, "clear", number));
            let left: Vec<[f32; 3]> = cleared.iter().collect();
            let gone = |point: &&[f32; 3]| !left.contains(point);
            let beside = |point: &[f32; 3]| point[1] == 12.0 && point[2] == 1.0;
            assert_eq!(points.iter().filter(|p| beside(p)).filter(gone).count(), 50);
            assert!(points.iter().filter(|p| !beside(p) && !hedge(p)).all(|p| !gone(&p)));
            thinner += usize::from(points.iter().filter(|p| hedge(p)).any(|p| gone(&p)));
        }
        assert!(
            (1..15).contains(&thinner),
            "the hedge lost something in {thinner} of 40"
        );
        let mut same = before.clone();
        clear(&mut same, 0.0, &mut Stream::new(1, "clear", 0));
        assert_eq!(same, before);
    }

    #[test]
    fn where_there_is_no_background_none_is_added() {
        let mut empty = scene();
        let bare = |point: &[f32; 3]| point[2] < 0.3;
        let ground: Vec<[f32; 3]> = empty.iter().filter(bare).collect();
        let mut without = Scene {
            objects: std::mem::take(&mut empty.objects),
            ..Scene::default()
        };
        ground.iter().for_each(|point| without.push(*point, 0));
        crowd(&mut without, 1.0, &mut Stream::new(1, "crowd", 0));
        assert_eq!(without.iter().count(), ground.len());
    }
}

//! What a network took for an object where there is none: background that is pasted into samples, so that it learns better.

use std::sync::Arc;

use realo_nn::decode::Detection;
use realo_schemas::geometry::{Footprint, iou_exceeds};

use super::outline::Outline;
use super::sample::Scene;
use crate::random::Stream;
use crate::validate::footprint;

/// Scores from which a box without an object is a decoy: where graphs begin to count boxes.
const LEAST_SCORE: f32 = 0.2;

/// A box that overlaps more than this with an object is a poor box, not a false one.
const OVERLAP: f64 = 0.05;

/// Points that a decoy has at least: fewer are no object's either.
const LEAST_POINTS: usize = 5;

/// Decoys that are kept; of more the surest.
const MOST: usize = 512;

/// How far around a box its points are taken, m.
const MARGIN: f32 = 0.3;

/// What rises so far above the ground, m, is not ground.
const ABOVE_GROUND: f32 = 0.3;

/// A piece of background.
#[derive(Clone, Debug, PartialEq)]
struct Decoy {
    score: f32,
    /// In the frame of the ego that saw them, above the ground below them, m.
    points: Vec<[f32; 3]>,
}

impl Decoy {
    /// Where it stands and how far it reaches from there, m.
    fn place(&self) -> ([f32; 2], f32) {
        let count = self.points.len() as f32;
        let mean = [0, 1].map(|axis| self.points.iter().map(|point| point[axis]).sum::<f32>() / count);
        let far = |[x, y, _]: &[f32; 3]| (x - mean[0]).hypot(y - mean[1]);
        (mean, self.points.iter().map(far).fold(0.0, f32::max))
    }
}

/// The decoys of one look at frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decoys(Vec<Decoy>);

impl Decoys {
    /// How many there are.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Takes what a network found in a scene where no object is.
    pub(crate) fn add(&mut self, scene: &Scene, found: &[Detection]) {
        let objects: Vec<Footprint> = scene.seen().map(|object| footprint(&object.hwl)).collect();
        for detection in found.iter().filter(|detection| detection.score >= LEAST_SCORE) {
            let outline = footprint(&detection.hwl.map(f64::from));
            if objects.iter().any(|object| iou_exceeds(object, &outline, OVERLAP)) {
                continue;
            }
            let Some(ground) = ground(scene, [detection.hwl[0], detection.hwl[1]]) else {
                continue;
            };
            let outline = Outline::new(&detection.hwl.map(f64::from), MARGIN);
            let points: Vec<[f32; 3]> = scene
                .iter()
                .filter(|point| outline.holds(*point))
                .map(|[x, y, z]| [x, y, z - ground])
                .filter(|point| point[2] > 0.0)
                .collect();
            if points.iter().filter(|point| point[2] > ABOVE_GROUND).count() >= LEAST_POINTS {
                let score = detection.score;
                self.0.push(Decoy { score, points });
            }
        }
        self.0.sort_by(|a, b| b.score.total_cmp(&a.score));
        self.0.truncate(MOST);
    }

    /// Pastes some into a scene, at most so many, each where it is as far from the ego as it was, so that it is as dense as a sensor
    /// makes it there, on free ground.
    pub(crate) fn paste(&self, scene: &mut Scene, most: usize, draws: &mut Stream) {
        if self.is_empty() {
            return;
        }
        for _ in 0..draws.below(most + 1) {
            let decoy = &self.0[draws.below(self.len())];
            let (sin, cos) = (draws.unit() * std::f64::consts::TAU).sin_cos();
            let (sin, cos) = (sin as f32, cos as f32);
            let turned = |[x, y]: [f32; 2]| [cos * x - sin * y, sin * x + cos * y];
            let (place, reach) = decoy.place();
            let place = turned(place);
            let Some(ground) = ground(scene, place) else { continue };
            let near = |x: f32, y: f32, margin: f32| (x - place[0]).hypot(y - place[1]) < reach + margin;
            let stands_there = scene
                .iter()
                .any(|[x, y, z]| z > ground + ABOVE_GROUND && near(x, y, MARGIN));
            let belongs_to_an_object = scene.seen().any(|object| {
                let [x, y, .., width, length, _] = object.hwl.map(|number| number as f32);
                near(x, y, 0.5 * length.hypot(width))
            });
            if stands_there || belongs_to_an_object {
                continue;
            }
            for [x, y, z] in &decoy.points {
                let [x, y] = turned([*x, *y]);
                scene.push([x, y, z + ground], 0);
            }
        }
    }

    /// As rows of the decoy's number, its score, x, y, z.
    pub(crate) fn to_numbers(&self) -> Vec<f32> {
        let rows = |(number, decoy): (usize, &Decoy)| -> Vec<[f32; 5]> {
            let row = |[x, y, z]: &[f32; 3]| [number as f32, decoy.score, *x, *y, *z];
            decoy.points.iter().map(row).collect()
        };
        self.0.iter().enumerate().flat_map(rows).flatten().collect()
    }

    /// The decoys of such rows.
    pub(crate) fn from_numbers(numbers: &[f32]) -> Self {
        let mut decoys: Vec<(f32, Decoy)> = Vec::new();
        for &[number, score, x, y, z] in numbers.as_chunks::<5>().0 {
            match decoys.last_mut() {
                Some((last, decoy)) if *last == number => decoy.points.push([x, y, z]),
                _ => {
                    let points = vec![[x, y, z]];
                    decoys.push((number, Decoy { score, points }));
                }
            }
        }
        Decoys(decoys.into_iter().map(|(_, decoy)| decoy).collect())
    }
}

/// Decoys by the step from which on samples have them, the last two of them: batches are made ahead.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Supply(Vec<(u64, Arc<Decoys>)>);

impl Supply {
    /// Decoys of a look at frames, for the samples from a step on.
    pub(crate) fn add(&mut self, step: u64, decoys: Decoys) {
        self.0.push((step, decoys.into()));
        let old = self.0.len().saturating_sub(2);
        self.0.drain(..old);
    }

    /// Those of a step.
    pub(crate) fn at(&self, step: u64) -> Option<Arc<Decoys>> {
        let begun = self.0.iter().rev().find(|(from, _)| *from <= step);
        begun.map(|(_, decoys)| decoys.clone())
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (u64, &Decoys)> {
        self.0.iter().map(|(step, decoys)| (*step, &**decoys))
    }
}

/// Height of the lowest point within 2 m of a place; `None` where there is none.
fn ground(scene: &Scene, [x, y]: [f32; 2]) -> Option<f32> {
    let near = scene.iter().filter(|point| (point[0] - x).hypot(point[1] - y) < 2.0);
    near.map(|point| point[2]).min_by(f32::total_cmp)
}

#[cfg(test)]
mod tests {
    use crate::targets::Object;

    use super::*;

    fn found(x: f32, y: f32, score: f32) -> Detection {
        Detection {
            class: 0,
            score,
            hwl: [x, y, 0.8, 1.6, 2.0, 4.0, 0.0],
        }
    }

    /// Ground at a height all around and a block of points at (20, 5); an object at (-20, 0).
    fn scene(height: f32) -> Scene {
        let mut scene = Scene::default();
        for x in -40..40 {
            for y in -40..40 {
                scene.push([x as f32, y as f32, height], 0);
            }
        }
        for i in 0..40 {
            let i = i as f32;
            scene.push([19.0 + 0.05 * i, 5.0, height + 0.02 + 0.03 * i], 0);
            scene.push([-20.0 + 0.05 * i, 0.0, height + 0.02 + 0.03 * i], 0);
        }
        scene.objects.push(Object {
            class: 0,
            hwl: [-20.0, 0.0, 0.8, 1.6, 2.0, 4.0, 0.0],
        });
        scene
    }

    fn mined() -> Decoys {
        let mut decoys = Decoys::default();
        let unsure = found(20.0, 5.0, 0.1);
        let empty = found(0.0, 20.0, 0.9);
        let poor = found(-18.0, 0.5, 0.9);
        decoys.add(&scene(0.1), &[poor, empty, found(20.0, 5.0, 0.4), unsure]);
        decoys
    }

    #[test]
    fn what_is_found_where_no_object_is_becomes_a_decoy() {
        let decoys = mined();
        assert_eq!(decoys.len(), 1);
        let ([x, y], reach) = decoys.0[0].place();
        assert!(
            (x - 20.0).abs() < 0.2 && (y - 5.0).abs() < 0.2 && reach < 1.5,
            "{x} {y} {reach}"
        );
        assert!(decoys.0[0].points.iter().all(|point| (0.0..1.3).contains(&point[2])));
    }

    #[test]
    fn an_object_with_too_few_points_to_count_is_no_decoy() {
        let mut scene = scene(0.1);
        let hwl = [20.0, 5.0, 0.8, 1.6, 2.0, 4.0, 0.0];
        scene.faint.push(Object { class: 0, hwl });
        let mut decoys = Decoys::default();
        decoys.add(&scene, &[found(20.0, 5.0, 0.9)]);
        assert!(decoys.is_empty());
    }

    #[test]
    fn decoys_stand_on_free_ground_as_far_away_as_they_were() {
        let decoys = mined();
        let count = decoys.0[0].points.len();
        let mut pasted = 0;
        for number in 0..200 {
            let (mut scene, before) = (scene(-0.7), scene(-0.7));
            decoys.paste(&mut scene, 1, &mut Stream::new(1, "test", number));
            let new: Vec<[f32; 3]> = scene.iter().skip(before.iter().count()).collect();
            assert!(new.is_empty() || new.len() == count);
            pasted += usize::from(!new.is_empty());
            for [x, y, z] in &new {
                assert!((x.hypot(*y) - 20.6).abs() < 1.2, "{x} {y}");
                assert!((-0.7..0.6).contains(z), "{z}");
                assert!((x + 20.0).hypot(*y) > 2.2, "on the object: {x} {y}");
                assert!((x - 20.0).hypot(y - 5.0) > 1.0, "on what stands there: {x} {y}");
            }
            assert_eq!(scene.objects, before.objects);
        }
        assert!((50..150).contains(&pasted), "{pasted} of 200");
        let mut nothing = scene(0.0);
        Decoys::default().paste(&mut nothing, 9, &mut Stream::new(1, "test", 0));
        assert_eq!(nothing, scene(0.0));
    }

    #[test]
    fn a_step_has_the_decoys_that_were_found_before_it() {
        let mut supply = Supply::default();
        assert_eq!(supply.at(100), None);
        supply.add(10, Decoys::default());
        supply.add(20, mined());
        let counts = [9, 10, 19, 20, 99].map(|step| supply.at(step).map(|decoys| decoys.len()));
        assert_eq!(counts, [None, Some(0), Some(0), Some(1), Some(1)]);
        supply.add(30, Decoys::default());
        assert_eq!(supply.iter().map(|(step, _)| step).collect::<Vec<_>>(), [20, 30]);
    }

    #[test]
    fn decoys_come_back_from_their_numbers() {
        let mut decoys = mined();
        // A second one of the same score.
        decoys.0.push(Decoy {
            score: decoys.0[0].score,
            points: vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
        });
        assert_eq!(Decoys::from_numbers(&decoys.to_numbers()), decoys);
        assert_eq!(Decoys::from_numbers(&[]), Decoys::default());
    }
}

use std::fmt;
use std::hint::black_box;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use eyre::{Result, ensure};
use realo_cli::Progress;
use realo_nms::{Index, Settings, keep};
use realo_schemas::geometry::Footprint;
use serde::Serialize;

const BOXES: usize = 1000;
const ROUNDS: usize = 60;
const SETS: u64 = 5;
const THRESHOLD: f64 = 0.15;
const ANCHOR: &str = "powerboxesrs rtree_rotated_nms";

/// Rotated NMS of 1,000 cars, this project's against `powerboxesrs`, interleaved in one process and thread.
#[derive(Serialize)]
pub struct Nms {
    boxes: usize,
    threshold: f64,
    scenes: Vec<Scene>,
}

#[derive(Serialize)]
struct Scene {
    name: &'static str,
    /// Boxes that each method keeps, by set.
    kept: Vec<usize>,
    /// Sets on which the anchor panicked; others took their place.
    anchor_panicked: u64,
    methods: Vec<Method>,
}

#[derive(Serialize)]
struct Method {
    name: &'static str,
    minimum_ms: f64,
    median_ms: f64,
    /// Minimum over the anchor's minimum.
    minimum_ratio: f64,
    /// Median over the rounds of this method's time over the anchor's in the same round.
    paired_ratio: f64,
    /// What the ratio should not exceed.
    goal: Option<f64>,
}

/// Boxes as rows of x, y, length, width (m), yaw (rad), and their scores, all different.
struct Set {
    rows: Vec<[f64; 5]>,
    scores: Vec<f32>,
    /// The same for the anchor, in degrees.
    anchor_rows: Vec<f64>,
    anchor_scores: Vec<f64>,
}

/// Times all methods on all scenes.
///
/// # Errors
/// If two methods keep different boxes.
pub fn bench(progress: &Progress) -> Result<Nms> {
    let scenes: [(&str, Place); 3] = [
        ("scattered over 200×80 m", |random, _| {
            [random.range(-100.0, 100.0), random.range(-40.0, 40.0)]
        }),
        ("in 50 heaps", |random, heaps| {
            let [x, y] = heaps[random.below(heaps.len())];
            [x + random.range(-1.0, 1.0), y + random.range(-1.0, 1.0)]
        }),
        ("all on one spot", |random, _| {
            [random.range(-0.2, 0.2), random.range(-0.2, 0.2)]
        }),
    ];
    progress.count("scenes", scenes.len() as f64);
    let scenes = scenes
        .into_iter()
        .map(|(name, place)| scene(name, place).inspect(|_| progress.add(1.0)))
        .collect::<Result<_>>()?;
    Ok(Nms {
        boxes: BOXES,
        threshold: THRESHOLD,
        scenes,
    })
}

type Place = fn(&mut Random, &[[f64; 2]]) -> [f64; 2];
type Run = fn(&Set) -> Vec<u32>;

const METHODS: [(&str, Option<f64>, Run); 4] = [
    (ANCHOR, None, anchor),
    ("grid", Some(0.25), |set| own(set, Index::Grid)),
    ("rtree", Some(0.6), |set| own(set, Index::Rtree)),
    ("brute", None, |set| own(set, Index::Brute)),
];

fn own(set: &Set, index: Index) -> Vec<u32> {
    let footprint = |[x, y, length, width, yaw]: &[f64; 5]| Footprint::new([*x, *y], *length, *width, *yaw);
    let footprints: Vec<Footprint> = set.rows.iter().map(footprint).collect();
    keep(
        &footprints,
        &set.scores,
        &Settings {
            threshold: THRESHOLD,
            index,
            ..Settings::default()
        },
    )
}

fn anchor(set: &Set) -> Vec<u32> {
    let kept =
        powerboxesrs::nms::rtree_rotated_nms_slice(&set.anchor_rows, &set.anchor_scores, THRESHOLD, f64::NEG_INFINITY);
    kept.into_iter().map(|index| index as u32).collect()
}

/// What the anchor keeps; `None` where it panics, which it does on some heaps.
fn guarded_anchor(set: &Set) -> Option<Vec<u32>> {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| ()));
    let kept = catch_unwind(AssertUnwindSafe(|| anchor(set)));
    std::panic::set_hook(hook);
    kept.ok()
}

fn scene(name: &'static str, place: Place) -> Result<Scene> {
    let (mut sets, mut anchor_panicked) = (Vec::new(), 0);
    for seed in 0u64.. {
        let set = make_set(seed, place);
        match guarded_anchor(&set) {
            Some(kept) => sets.push((set, kept)),
            None => anchor_panicked += 1,
        }
        if sets.len() as u64 == SETS {
            break;
        }
        ensure!(anchor_panicked < 1000, "{ANCHOR} panics on every set of boxes {name}");
    }
    for (set, kept) in &sets {
        for (method, _, run) in &METHODS[1..] {
            ensure!(run(set) == *kept, "{name}: {method} and {ANCHOR} keep different boxes");
        }
    }
    let mut times = vec![Vec::new(); METHODS.len()];
    for _ in 0..ROUNDS {
        for (set, _) in &sets {
            for (times, (_, _, run)) in times.iter_mut().zip(&METHODS) {
                let start = Instant::now();
                black_box(run(black_box(set)));
                times.push(start.elapsed().as_secs_f64() * 1e3);
            }
        }
    }
    let kept = sets.iter().map(|(_, kept)| kept.len()).collect();
    let methods = METHODS
        .iter()
        .zip(&times)
        .map(|((name, goal, _), own)| method(name, *goal, own, &times[0]))
        .collect();
    Ok(Scene {
        name,
        kept,
        anchor_panicked,
        methods,
    })
}

fn method(name: &'static str, goal: Option<f64>, times: &[f64], anchor: &[f64]) -> Method {
    let minimum = |times: &[f64]| times.iter().copied().fold(f64::INFINITY, f64::min);
    Method {
        name,
        minimum_ms: minimum(times),
        median_ms: median(times.to_vec()),
        minimum_ratio: minimum(times) / minimum(anchor),
        paired_ratio: median(times.iter().zip(anchor).map(|(own, anchor)| own / anchor).collect()),
        goal,
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn make_set(seed: u64, place: Place) -> Set {
    let mut random = Random(seed);
    let heaps: Vec<[f64; 2]> = (0..50)
        .map(|_| [random.range(-100.0, 100.0), random.range(-40.0, 40.0)])
        .collect();
    let mut car = || {
        let [x, y] = place(&mut random, &heaps);
        [
            x,
            y,
            random.range(4.0, 5.0),
            random.range(1.7, 2.1),
            random.range(-3.0, 3.0),
        ]
    };
    let rows: Vec<[f64; 5]> = (0..BOXES).map(|_| car()).collect();
    let mut scores: Vec<f32> = (0..BOXES).map(|rank| (rank + 1) as f32 / BOXES as f32).collect();
    for i in (1..BOXES).rev() {
        scores.swap(i, random.below(i + 1));
    }
    let in_degrees = |[x, y, length, width, yaw]: &[f64; 5]| [*x, *y, *length, *width, yaw.to_degrees()];
    Set {
        anchor_rows: rows.iter().flat_map(in_degrees).collect(),
        anchor_scores: scores.iter().map(|score| f64::from(*score)).collect(),
        rows,
        scores,
    }
}

/// SplitMix64: the same boxes on every machine.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn range(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.next()) * n as u128) >> 64) as usize
    }
}

impl fmt::Display for Nms {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "{} boxes, IoU > {}, one thread; ms: minimum, median; share of {ANCHOR}",
            self.boxes, self.threshold
        )?;
        for scene in &self.scenes {
            write!(f, "\n{}: keeps {:?}", scene.name, scene.kept)?;
            if scene.anchor_panicked > 0 {
                write!(f, "; {ANCHOR} panicked on {} further sets", scene.anchor_panicked)?;
            }
            for method in &scene.methods {
                write!(
                    f,
                    "\n  {:<31} {:7.3} {:7.3}",
                    method.name, method.minimum_ms, method.median_ms
                )?;
                write!(
                    f,
                    "  minima {:5.2}, paired {:5.2}",
                    method.minimum_ratio, method.paired_ratio
                )?;
                if let Some(goal) = method.goal {
                    write!(f, " (goal: at most {goal})")?;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_are_the_same_each_time_and_have_distinct_scores() {
        let place: Place = |random, _| [random.range(-1.0, 1.0), 0.0];
        let (one, other) = (make_set(3, place), make_set(3, place));
        assert_eq!((&one.rows, &one.scores), (&other.rows, &other.scores));
        let mut scores = one.scores.clone();
        scores.sort_by(f32::total_cmp);
        scores.dedup();
        assert_eq!(scores.len(), BOXES);
    }

    #[test]
    fn medians_and_ratios() {
        let found = method("m", None, &[2.0, 1.0, 3.0], &[4.0, 4.0, 3.0]);
        assert_eq!((found.minimum_ms, found.median_ms), (1.0, 2.0));
        assert_eq!((found.minimum_ratio, found.paired_ratio), (1.0 / 3.0, 0.5));
    }
}

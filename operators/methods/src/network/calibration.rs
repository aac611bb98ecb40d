//! What bytes stand for: the largest result of every layer that they keep, found over some sweeps.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use realo_kernels::bev::BevView;
use realo_kernels::conv::Pool;
use realo_nn::layers::{Layers, MapId};
use realo_nn::model::Precision;
use realo_nn::weights::Weights;

use super::error::NetworkError;
use super::options::NetworkOptions;
use super::pillarer::Pillarer;
use super::section::Section;
use crate::arch::Model;
use crate::detect::pillars::Points;

/// Looks at the maps of a network in f32, for [`Model::activations`].
pub struct Calibration {
    pillarer: Pillarer,
    canvas: String,
    /// The layers from the canvas to each map, by the key of the layer that makes it.
    sections: Vec<(String, Section)>,
    results: BTreeMap<String, Histogram>,
}

impl Calibration {
    /// Of a model, with no sweep looked at.
    ///
    /// # Errors
    /// Those of [`Section::new`].
    pub fn new(model: &Model, weights: &Weights) -> Result<Self, NetworkError> {
        let layers = Layers::of(model);
        let options = NetworkOptions {
            precision: Some(Precision::F32),
            ..NetworkOptions::default()
        };
        let read: Vec<(String, MapId)> = layers.read_in_bytes();
        let others = read.into_iter().filter(|(_, map)| *map != layers.canvas);
        let pool = Arc::new(Mutex::new(Pool::new(options.threads)));
        let section = |(key, map)| {
            let section = Section::on(Arc::clone(&pool), model, weights, options, [layers.canvas, map])?;
            Ok((key, section))
        };
        Ok(Calibration {
            pillarer: Pillarer::new(model, weights),
            canvas: layers.key(layers.canvas),
            sections: others.map(section).collect::<Result<_, NetworkError>>()?,
            results: BTreeMap::new(),
        })
    }

    /// Looks at a sweep, in the frame that [`Pillarer::run`] takes.
    ///
    /// # Errors
    /// Those of [`Section::run`], and [`NetworkError::NotFinite`].
    pub fn observe(&mut self, points: &Points) -> Result<(), NetworkError> {
        let (canvas, _) = self.pillarer.run(points);
        let cells = canvas.cells();
        let size = [canvas.rows(), canvas.columns(), canvas.channels()];
        note(&mut self.results, &self.canvas, &cells)?;
        let [rows, columns, channels] = size;
        let view = BevView {
            rows,
            columns,
            channels,
            data: &cells,
        };
        for (key, section) in &mut self.sections {
            let map = section.run(view)?;
            note(&mut self.results, key, &map.data)?;
        }
        Ok(())
    }

    /// The largest result of each layer that bytes keep best. A layer that never gave more than 0 counts as having given 1.
    pub fn activations(&self) -> BTreeMap<String, f32> {
        let results = self.results.iter();
        results
            .map(|(key, histogram)| (key.clone(), histogram.best_limit()))
            .collect()
    }
}

fn note(results: &mut BTreeMap<String, Histogram>, layer: &str, numbers: &[f32]) -> Result<(), NetworkError> {
    if !numbers.iter().all(|number| number.is_finite()) {
        return Err(NetworkError::NotFinite { layer: layer.into() });
    }
    results.entry(layer.into()).or_default().add(numbers);
    Ok(())
}

/// How often positive results occurred, in bins of equal width from 0 on; they grow by pairs as results do.
#[derive(Clone, Debug)]
struct Histogram {
    width: f64,
    counts: Vec<u64>,
}

const BINS: usize = 4096;
/// Width of a bin before any result, 2^-40: results of sound networks are far greater.
const FINEST: f64 = 1.0 / (1u64 << 40) as f64;

impl Default for Histogram {
    fn default() -> Self {
        Histogram {
            width: FINEST,
            counts: vec![0; BINS],
        }
    }
}

impl Histogram {
    fn add(&mut self, numbers: &[f32]) {
        let max = f64::from(numbers.iter().copied().fold(0.0, f32::max));
        while max >= self.width * BINS as f64 {
            let pairs = self.counts.chunks_exact(2).map(|pair| pair[0] + pair[1]);
            self.counts = pairs.chain([0; BINS / 2]).collect();
            self.width *= 2.0;
        }
        // 0 is kept whatever bytes stand for.
        for number in numbers.iter().filter(|number| **number > 0.0) {
            self.counts[((f64::from(*number) / self.width) as usize).min(BINS - 1)] += 1;
        }
    }

    /// The limit at which rounding to 255 steps and cutting off what is greater lose least: the sum of the squares of both.
    fn best_limit(&self) -> f32 {
        let Some(last) = self.counts.iter().rposition(|count| *count > 0) else {
            return 1.0;
        };
        // From behind: numbers beyond a bin, the sum of how far and of its square.
        let (mut beyond, mut sum, mut squares) = (0.0, 0.0, 0.0);
        let all: u64 = self.counts.iter().sum();
        let mut best = (f64::INFINITY, 0.0);
        for bin in (0..=last).rev() {
            let limit = (bin + 1) as f64 * self.width;
            let step = limit / 255.0;
            let rounded = step * step / 12.0 * (all as f64 - beyond);
            let lost = rounded + squares;
            if lost < best.0 {
                best = (lost, limit);
            }
            // The next limit lies a width lower: what lies beyond it is farther by that.
            let count = self.counts[bin] as f64;
            squares += 2.0 * self.width * sum + beyond * self.width * self.width;
            sum += beyond * self.width;
            let half = self.width / 2.0;
            (beyond, sum, squares) = (beyond + count, sum + count * half, squares + count * half * half);
        }
        best.1 as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn loss(numbers: &[f32], limit: f32) -> f64 {
        let step = limit / 255.0;
        let error = |number: f32| number - (number / step).round().min(255.0) * step;
        numbers.iter().map(|number| f64::from(error(*number)).powi(2)).sum()
    }

    #[test]
    fn a_few_great_numbers_are_cut_off_and_even_ones_are_kept() {
        let even: Vec<f32> = (0..100_000).map(|i| 8.0 * i as f32 / 100_000.0).collect();
        let mut histogram = Histogram::default();
        histogram.add(&even);
        assert!(
            (7.9..8.05).contains(&histogram.best_limit()),
            "{}",
            histogram.best_limit()
        );
        // Two of a hundred thousand lie far out.
        let mut few = even.clone();
        few.extend([60.0, 61.0]);
        histogram.add(&[60.0, 61.0]);
        let limit = histogram.best_limit();
        assert!((8.0..60.0).contains(&limit), "{limit}");
        for other in [0.8 * limit, 1.25 * limit, 61.0] {
            assert!(
                loss(&few, limit) < 1.02 * loss(&few, other),
                "{limit} loses more than {other}"
            );
        }
    }

    #[test]
    fn no_result_above_zero_counts_as_one() {
        let mut histogram = Histogram::default();
        histogram.add(&[0.0, -3.0]);
        assert_eq!(histogram.best_limit(), 1.0);
    }

    #[test]
    fn small_results_have_fine_limits_and_what_is_no_number_is_reported() {
        let small: Vec<f32> = (0..10_000).map(|i| 1e-7 * i as f32 / 10_000.0).collect();
        let mut results = BTreeMap::new();
        note(&mut results, "layer", &small).unwrap();
        let limit = results["layer"].best_limit();
        assert!((0.95e-7..1.05e-7).contains(&limit), "{limit}");
        for number in [f32::NAN, f32::INFINITY] {
            let error = note(&mut results, "layer", &[1.0, number]).unwrap_err().to_string();
            assert!(error.contains("`layer`"), "{error}");
        }
    }
}

//! AdamW (Loshchilov and Hutter 2019) with clipped gradients and a one-cycle learning rate.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::layers::with_numbers;
use crate::network::{Gradients, Network};

/// How weights are moved.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OptimizerSettings {
    /// Largest learning rate.
    pub rate: f64,
    /// Share of the steps in which the rate rises.
    pub warm_up: f64,
    /// Share of a weight that a step at learning rate 1 takes away.
    pub decay: f64,
    /// Gradients longer than this are shortened to it.
    pub clip: f64,
}

impl Default for OptimizerSettings {
    fn default() -> Self {
        OptimizerSettings {
            rate: 2e-3,
            warm_up: 0.1,
            decay: 0.01,
            clip: 10.0,
        }
    }
}

impl OptimizerSettings {
    /// The learning rate of a step of so many: from a tenth up to the largest, then down to a thousandth, along cosines
    /// (Smith 2018).
    pub fn rate_at(&self, step: u64, steps: u64) -> f64 {
        let share = step as f64 / steps.max(1) as f64;
        let between =
            |from: f64, to: f64, at: f64| to + (from - to) * 0.5 * (1.0 + (std::f64::consts::PI * at.min(1.0)).cos());
        match share < self.warm_up {
            true => self.rate * between(0.1, 1.0, share / self.warm_up),
            false => self.rate * between(1.0, 1e-3, (share - self.warm_up) / (1.0 - self.warm_up)),
        }
    }
}

const BETAS: [f64; 2] = [0.9, 0.99];
const EPS: f32 = 1e-8;

/// Averages of the gradients and of their squares, by parameter; empty for what is not trained.
#[derive(Clone, Debug, PartialEq)]
pub struct AdamW {
    /// Averages of the gradients.
    pub first: Vec<Vec<f32>>,
    /// Averages of their squares.
    pub second: Vec<Vec<f32>>,
    /// Steps so far.
    pub steps: u64,
}

impl AdamW {
    /// Before the first step.
    pub fn new(network: &Network) -> Self {
        let zeros = |_| {
            let of = |p: &crate::network::Parameter| vec![0.0; if p.trained { p.value.elem_count() } else { 0 }];
            network.parameters().iter().map(of).collect::<Vec<_>>()
        };
        AdamW {
            first: zeros(0),
            second: zeros(1),
            steps: 0,
        }
    }

    /// Moves the network against its gradients; returns their length before clipping.
    ///
    /// # Errors
    /// Those of candle.
    pub fn step(
        &mut self,
        network: &mut Network,
        gradients: &Gradients,
        rate: f64,
        how: &OptimizerSettings,
    ) -> candle_core::Result<f64> {
        self.steps += 1;
        let squares = |g: &Vec<f32>| g.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>();
        let norm = gradients.iter().flatten().map(squares).sum::<f64>().sqrt();
        let clip = if norm > how.clip { how.clip / norm } else { 1.0 } as f32;
        let bias = BETAS.map(|beta| 1.0 - beta.powi(self.steps.min(1 << 20) as i32));
        let [b1, b2] = BETAS.map(|beta| beta as f32);
        let (rate_now, root) = ((rate / bias[0]) as f32, (1.0 / bias[1].sqrt()) as f32);
        let moved: Vec<(usize, Vec<f32>)> = (self.first.par_iter_mut().zip(&mut self.second).enumerate())
            .filter_map(|(index, (first, second))| {
                let (parameter, gradient) = (&network.parameters()[index], gradients[index].as_ref()?);
                let keep = if parameter.decayed {
                    1.0 - (rate * how.decay) as f32
                } else {
                    1.0
                };
                let mut values = with_numbers(&parameter.value, |values| Ok(values.to_vec())).ok()?;
                for (((value, m), v), g) in values.iter_mut().zip(first).zip(second).zip(gradient) {
                    let g = g * clip;
                    *m = b1 * *m + (1.0 - b1) * g;
                    *v = b2 * *v + (1.0 - b2) * g * g;
                    *value = *value * keep - rate_now * *m / (v.sqrt() * root + EPS);
                }
                Some((index, values))
            })
            .collect();
        for (index, values) in moved {
            network.set(index, values)?;
        }
        Ok(norm)
    }
}

#[cfg(test)]
mod tests {
    use realo_methods::Model;

    use super::*;

    fn network() -> Network {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/lite.toml");
        Network::random(&Model::read(&path).unwrap(), 1).unwrap()
    }

    fn values(network: &Network) -> Vec<Vec<f32>> {
        let of = |p: &crate::network::Parameter| with_numbers(&p.value, |values| Ok(values.to_vec())).unwrap();
        network.parameters().iter().map(of).collect()
    }

    fn gradients(network: &Network, value: f32) -> Gradients {
        let of = |p: &crate::network::Parameter| p.trained.then(|| vec![value; p.value.elem_count()]);
        network.parameters().iter().map(of).collect()
    }

    #[test]
    fn the_rate_rises_and_falls() {
        let how = OptimizerSettings::default();
        let at = |step| how.rate_at(step, 1000);
        assert!((at(0) - how.rate * 0.1).abs() < 1e-12);
        assert!((at(100) - how.rate).abs() < 1e-12);
        assert!((at(1000) - how.rate * 1e-3).abs() < 1e-12);
        assert!((0..100).all(|step| at(step) < at(step + 1)));
        assert!((100..1000).all(|step| at(step) > at(step + 1)));
    }

    #[test]
    fn a_first_step_is_as_long_as_the_rate_whatever_the_gradient() {
        let how = OptimizerSettings {
            decay: 0.0,
            ..OptimizerSettings::default()
        };
        for gradient in [1e-3, -50.0] {
            let mut network = network();
            let before = values(&network);
            let all = gradients(&network, gradient);
            let mut adam = AdamW::new(&network);
            let norm = adam.step(&mut network, &all, 1e-2, &how).unwrap();
            let count: usize = all.iter().flatten().map(Vec::len).sum();
            let expected = f64::from(gradient.abs()) * (count as f64).sqrt();
            assert!((norm - expected).abs() < 1e-3 * expected, "{norm}, not {expected}");
            let moved = values(&network);
            for ((parameter, before), after) in network.parameters().iter().zip(&before).zip(&moved) {
                let step = if parameter.trained {
                    -1e-2 * gradient.signum()
                } else {
                    0.0
                };
                for (before, after) in before.iter().zip(after) {
                    assert!((after - before - step).abs() < 1e-4, "{before} to {after}");
                }
            }
        }
    }

    #[test]
    fn weights_decay_and_offsets_do_not() {
        let mut network = network();
        let before = values(&network);
        let none = gradients(&network, 0.0);
        let how = OptimizerSettings {
            decay: 0.5,
            ..OptimizerSettings::default()
        };
        AdamW::new(&network).step(&mut network, &none, 0.1, &how).unwrap();
        for ((parameter, before), after) in network.parameters().iter().zip(&before).zip(&values(&network)) {
            let keep = if parameter.trained && parameter.decayed {
                0.95
            } else {
                1.0
            };
            let same = before
                .iter()
                .zip(after)
                .all(|(b, a)| (a - b * keep).abs() <= 1e-6 * b.abs());
            assert!(same, "{keep}");
        }
    }
}

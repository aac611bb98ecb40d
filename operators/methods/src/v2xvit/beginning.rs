//! The numbers that training begins with: the transformer gives the ego's map as it is.

use realo_nn::tensors::{Role, TensorSpec};

use crate::method;

/// The slowest sine of the first table of delays has this many times the period of the fastest.
const PERIODS: f64 = 1e4;

/// The table of delays that training begins with, `[delays, channels]`: sines and cosines in turn, slower from pair to pair.
pub fn initial_delays(delays: usize, channels: usize) -> Vec<f32> {
    let of = |delay: usize, channel: usize| {
        let pair = (channel - channel % 2) as f64;
        let angle = delay as f64 * libm::exp(-pair * libm::log(PERIODS) / channels as f64);
        let wave = if channel.is_multiple_of(2) {
            libm::sin(angle)
        } else {
            libm::cos(angle)
        };
        (wave / (channels as f64).sqrt()) as f32
    };
    let all = (0..delays).flat_map(|delay| (0..channels).map(move |channel| (delay, channel)));
    all.map(|(delay, channel)| of(delay, channel)).collect()
}

/// Layers whose results are added to a map.
const ADDED: [&str; 4] = [".fn.a_linears.", ".to_out.0.", ".fn.net.3.", ".rte.emb.lin."];

/// The numbers of a tensor; `normal` draws from a normal distribution of deviation 1.
pub fn initial(spec: &TensorSpec, normal: &mut dyn FnMut() -> f64) -> Vec<f32> {
    let count = spec.count();
    match spec.role {
        Role::Delays => initial_delays(spec.shape[0], spec.shape[1]),
        Role::Weight { .. } if ADDED.iter().any(|part| spec.key.contains(part)) => vec![0.0; count],
        Role::Weight { .. } if spec.key.ends_with(".pos_embedding") => vec![0.0; count],
        // A matrix for each head: to begin with the relation changes nothing.
        Role::Weight { fan_in } if spec.key.contains(".relation_") => {
            let diagonal = |at: usize| (at % (fan_in * fan_in)).is_multiple_of(fan_in + 1);
            (0..count).map(|at| f32::from(u8::from(diagonal(at)))).collect()
        }
        _ => method::initial(spec, normal),
    }
}

//! A network that begins as a narrower one (Net2WiderNet, Chen et al. 2016): it has channels of the narrower one several times, and
//! what reads such a channel shares its weight out among them, so that both compute the same.

use std::collections::HashMap;

use realo_methods::Model;
use realo_nn::layers::{ConvLayer, Layer, Layers, MapId};
use realo_nn::tensors::{Role, TensorSpec};
use realo_nn::weights::{self, Weights, WeightsError};

use crate::random::Stream;

/// A channel's part of a weight before the parts are made to add up, smallest and largest. Were all alike, the copies of a channel would
/// learn alike for ever.
const PART: [f64; 2] = [0.5, 1.5];

/// A model with as many channels as another one; everything else stays.
pub(crate) fn as_wide_as(other: &Model, model: &Model) -> Model {
    let mut model = model.clone();
    model.pillars.channels = other.pillars.channels;
    model.backbone.channels.clone_from(&other.backbone.channels);
    model.backbone.up_channels.clone_from(&other.backbone.up_channels);
    let plain = model.shrink.iter_mut().zip(&other.shrink);
    for (layer, other) in plain.chain(model.refine.iter_mut().zip(&other.refine)) {
        layer.channels = other.channels;
    }
    model
}

/// Whether each map has at least as many channels as that of a model which differs in channels only; one with more layers does not.
pub(crate) fn is_wider(model: &Model, narrow: &Model) -> bool {
    let (wide, narrow) = (Layers::of(model), Layers::of(narrow));
    let mut steps = wide.steps().iter().zip(narrow.steps());
    wide.steps().len() == narrow.steps().len() && steps.all(|(a, b)| wide.size(a.to)[2] >= narrow.size(b.to)[2])
}

/// The weights of a model that [is wider](is_wider) than the one whose weights are given, and computes the same.
///
/// # Errors
/// [`WeightsError`] if the models differ in more than channels.
pub(crate) fn widened(model: &Model, narrow: &Model, weights: &Weights, seed: u64) -> Result<Weights, WeightsError> {
    let (wide, narrow) = (Layers::of(model), Layers::of(narrow));
    // Of each channel of a map the one of the narrower network that it repeats.
    let mut origins: HashMap<MapId, Vec<usize>> = HashMap::new();
    let mut tensors = HashMap::new();
    for (step, before) in wide.steps().iter().zip(narrow.steps()) {
        let (channels, fewer) = (wide.size(step.to)[2], narrow.size(before.to)[2]);
        let read: Vec<&Vec<usize>> = step.from.iter().filter_map(|map| origins.get(map)).collect();
        let origin = match &step.layer {
            Layer::Join => {
                let sizes = before.from.iter().map(|map| narrow.size(*map)[2]);
                let starts = sizes.scan(0, |start, size| Some(std::mem::replace(start, *start + size)));
                let parts = read.iter().zip(starts);
                parts
                    .flat_map(|(part, start)| part.iter().map(move |at| start + at))
                    .collect()
            }
            Layer::Fuse(_) => read.first().map_or_else(Vec::new, |first| (*first).clone()),
            Layer::Points(_) | Layer::Convolution(_) => {
                (0..channels).map(|channel| channel % fewer).collect::<Vec<_>>()
            }
        };
        for spec in step.layer.tensors() {
            let old = weights.tensor(&spec.key);
            let data = match (&step.layer, spec.role) {
                (Layer::Convolution(layer), Role::Weight { .. }) => {
                    let mut draws = Stream::new(seed, &spec.key, 0);
                    shared_out(layer, old, [read[0], &origin], &mut draws)
                }
                // Rows of the linear layer, and what there is once for each channel.
                _ => {
                    let each = spec.count() / origin.len().max(1);
                    let rows = origin.iter().flat_map(|channel| &old[channel * each..][..each]);
                    rows.copied().collect()
                }
            };
            let TensorSpec { key, shape, .. } = spec;
            tensors.insert(key, weights::Tensor { shape, data });
        }
        origins.insert(step.to, origin);
    }
    Weights::new(model, tensors)
}

/// The weights of a convolution whose inputs and outputs repeat those of a narrower one.
fn shared_out(layer: &ConvLayer, old: &[f32], [inputs, outputs]: [&[usize]; 2], draws: &mut Stream) -> Vec<f32> {
    let taps = layer.kernel * layer.kernel;
    let count = |origins: &[usize]| origins.iter().max().map_or(0, |last| last + 1);
    let [fewer_inputs, fewer_outputs] = [inputs, outputs].map(count);
    // Where a weight lies among so many inputs and outputs.
    let at = |input: usize, output: usize, [inputs, outputs]: [usize; 2]| match layer.transposed {
        true => (input * outputs + output) * taps,
        false => (output * inputs + input) * taps,
    };
    let mut new = vec![0.0; inputs.len() * outputs.len() * taps];
    for (output, of) in outputs.iter().enumerate() {
        for tap in 0..taps {
            let parts: Vec<f64> = inputs.iter().map(|_| draws.between(PART[0], PART[1])).collect();
            let mut sums = vec![0.0; fewer_inputs];
            for (input, part) in inputs.iter().zip(&parts) {
                sums[*input] += part;
            }
            for (input, part) in parts.iter().enumerate() {
                let from = inputs[input];
                let weight = f64::from(old[at(from, *of, [fewer_inputs, fewer_outputs]) + tap]);
                new[at(input, output, [inputs.len(), outputs.len()]) + tap] = (weight * part / sums[from]) as f32;
            }
        }
    }
    new
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::data::Member;
    use crate::data::{Scene, gather};
    use crate::layers::with_numbers;
    use crate::network::Network;
    use crate::tape::Tape;

    fn narrow() -> Model {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/lite.toml");
        let mut model = Model::read(&path).unwrap();
        (model.grid.x, model.grid.y) = ([-6.4, 6.4], [-6.4, 6.4]);
        with_channels(&model, 4, [4, 6, 8], [4, 4, 4], 6)
    }

    fn with_channels(model: &Model, pillars: usize, blocks: [usize; 3], up: [usize; 3], shrink: usize) -> Model {
        let mut model = model.clone();
        model.pillars.channels = pillars;
        (model.backbone.channels, model.backbone.up_channels) = (blocks.into(), up.into());
        model.shrink[0].channels = shrink;
        model.validate().unwrap();
        model
    }

    #[test]
    fn one_with_more_layers_is_no_wider_one() {
        let narrow = narrow();
        let mut refining = narrow.clone();
        refining.refine = narrow.shrink.clone();
        assert!(is_wider(&narrow, &narrow) && !is_wider(&refining, &narrow));
    }

    /// A network of other numbers in each channel.
    fn network(model: &Model) -> Network {
        let mut number = 0..;
        let values = |spec: &TensorSpec| {
            let mut draws = Stream::new(2, "widened", number.next().unwrap());
            let value = |_| match spec.role {
                Role::Weight { fan_in } => ((2.0 / fan_in as f64).sqrt() * draws.normal()) as f32,
                Role::NormWeight | Role::RunningVariance => draws.between(0.5, 2.0) as f32,
                _ => draws.between(-0.5, 0.5) as f32,
            };
            (0..spec.count()).map(value).collect()
        };
        Network::with(model, values).unwrap()
    }

    /// Scores and deltas of some points.
    fn heads(network: &Network) -> [Vec<f32>; 2] {
        let mut draws = Stream::new(4, "points", 0);
        let mut scene = Scene::default();
        (0..600).for_each(|_| scene.push([6.0, 6.0, 2.0].map(|far| draws.between(-far, far) as f32), 0));
        let (batch, _) = gather(network.model(), vec![scene.sample(network.model())]);
        let heads = network
            .forward(&mut Tape::forward_only(), &batch, &[vec![Member::EGO]], false)
            .unwrap();
        [heads.scores, heads.deltas].map(|map| with_numbers(&map, |values| Ok(values.to_vec())).unwrap())
    }

    #[test]
    fn a_wider_network_computes_the_same_and_no_two_of_its_channels_learn_alike() {
        let model = narrow();
        let old = network(&model);
        let weights = old.weights().unwrap();
        for wide in [
            with_channels(&model, 4, [4, 6, 8], [4, 4, 4], 6),
            with_channels(&model, 6, [7, 6, 20], [4, 5, 12], 9),
        ] {
            assert!(is_wider(&wide, &model));
            let new = widened(&wide, &model, &weights, 7).unwrap();
            let new = Network::with(&wide, |spec| new.tensor(&spec.key).to_vec()).unwrap();
            for (old, new) in heads(&old).iter().zip(&heads(&new)) {
                assert!(old.iter().any(|value| value.abs() > 0.1), "nothing to compare");
                let off = old.iter().zip(new).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(off < 1e-4, "{off} between the two");
            }
        }
        // Channels 6 and 7 of the shrunk map repeat 0 and 1 of it.
        let wide = with_channels(&model, 4, [4, 6, 8], [4, 4, 4], 8);
        let new = widened(&wide, &model, &weights, 7).unwrap();
        let key = Layers::of(&wide).key(Layers::of(&wide).scores);
        let [read, repeated] = [0, 6].map(|input| {
            let rows = new.tensor(&format!("{key}.weight")).chunks_exact(8);
            rows.map(|row| row[input]).collect::<Vec<f32>>()
        });
        let ratios: Vec<f32> = read.iter().zip(&repeated).map(|(a, b)| a / b).collect();
        assert!(ratios.iter().any(|ratio| (ratio - ratios[0]).abs() > 0.1), "{ratios:?}");
    }

    #[test]
    fn a_narrower_network_is_none_that_is_wider() {
        let model = narrow();
        let less = with_channels(&model, 4, [4, 6, 7], [4, 4, 4], 9);
        assert!(!is_wider(&less, &model));
        assert_eq!(as_wide_as(&less, &model), less);
    }
}

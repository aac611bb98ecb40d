//! Training through the fusion of several agents' maps, and the weights that a training begins with.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

use candle_core::{Tensor, TensorId, Var};
use rayon::prelude::*;
use realo_kernels::agents;
use realo_kernels::bev::BevMap;
use realo_kernels::conv::Pool;
use realo_methods::method::{Back, Descent};
use realo_methods::tensors::{Agent, AgentMap, OwnMap, Tensors};
use realo_methods::{AnyMethod, Arch, Kernels, Loaded, Model};
use realo_nn::layers::FuseLayer;
use realo_nn::model::{ClassAnchor, Grid};
use realo_nn::tensors::TensorSpec;
use realo_nn::weights::{self, Weights};

use crate::TrainError;
use crate::checkpoint::differences;
use crate::data::Member;
use crate::layers::{MapShape, buffer, tensor, with_numbers};
use crate::network::{Network, Parameter, inner, outer};
use crate::tape::{Gradients, Tape};
use crate::train::option;
use crate::widen::{as_wide_as, is_wider, widened};

/// Whether a model fuses the maps of several agents.
pub fn fuses(model: &Model) -> bool {
    model.arch.method().is_some()
}

/// The weights that a training begins with.
pub(crate) struct Start {
    pub weights: Arc<Weights>,
    /// Name and digest of the model file that they come from.
    pub identity: String,
}

/// The weights that a model begins with, of a narrower detector those of one that computes the same; `None` for random ones.
///
/// # Errors
/// [`TrainError`] if the file of a model whose encoder is another one's is not given, not to be had, or makes other maps.
pub(crate) fn start(model: &Model, file: Option<&Path>, seed: u64) -> Result<Option<Start>, TrainError> {
    if model.encoder.is_some() && !fuses(model) {
        return Err(TrainError::Model {
            model: model.name.clone(),
            reason: "it takes its `encoder` from another file, but all of it would be trained: leave `encoder` out"
                .into(),
        });
    }
    if let Some(compressor) = &model.compressor {
        return Err(TrainError::Model {
            model: model.name.clone(),
            reason: format!(
                "it takes its `compressor` from `{compressor}`: train that model, or leave `compressor` out"
            ),
        });
    }
    let Some(file) = file else {
        return match model.encoder {
            None => Ok(None),
            Some(_) => Err(option(
                "from",
                "a model file with weights whose encoder is taken, as --from models/lite.toml, since this model names an `encoder`",
                "none",
            )),
        };
    };
    let loaded = realo_methods::load(file, Kernels::auto(1))?;
    let Loaded {
        model: of_file,
        weights,
        identity,
        ..
    } = loaded;
    if !fuses(model) && other_maps(model, &as_wide_as(model, &of_file)).is_empty() && is_wider(model, &of_file) {
        let weights = Arc::new(widened(model, &of_file, &weights, seed)?);
        return Ok(Some(Start { weights, identity }));
    }
    match &other_maps(model, &of_file)[..] {
        [] => Ok(Some(Start { weights, identity })),
        found => Err(TrainError::OtherMaps {
            model: model.name.clone(),
            from: file.into(),
            differences: found.join("; "),
        }),
    }
}

/// In which settings a model's maps are not those of another one's encoder, as `name: expected, found`; empty if they are. The
/// range of the grid may differ.
fn other_maps(model: &Model, encoder: &Model) -> Vec<String> {
    let classes = |of: &Model| -> Vec<ClassAnchor> {
        let alike = |class: &ClassAnchor| ClassAnchor {
            matched: 0.0,
            unmatched: 0.0,
            ..class.clone()
        };
        of.classes.iter().map(alike).collect()
    };
    // What does not change a map, nor what the heads read in it.
    let maps = |of: &Model| Model {
        classes: classes(of),
        matching: model.matching,
        name: String::new(),
        weights: None,
        encoder: None,
        compressor: None,
        sha256: Default::default(),
        arch: Arch::default(),
        precision: model.precision,
        score_threshold: model.score_threshold,
        refine: model.refine.clone(),
        activations: Default::default(),
        grid: Grid {
            x: model.grid.x,
            y: model.grid.y,
            ..of.grid
        },
        ..of.clone()
    };
    let reported = differences(&maps(model), &maps(encoder)).into_iter();
    reported
        .map(|(name, expected, found)| format!("{name}: expected {expected}, found {found}"))
        .collect()
}

/// A network that begins with all tensors of given weights that it has; what they lack begins at random.
///
/// # Errors
/// Those of candle.
pub(crate) fn beginning(model: &Model, weights: &Weights, seed: u64) -> candle_core::Result<Network> {
    Network::beginning(model, seed, |spec| {
        weights.find(&spec.key).filter(|numbers| numbers.len() == spec.count())
    })
}

impl Network {
    /// Its tensors as inference takes them.
    ///
    /// # Errors
    /// [`TrainError::Weights`] if a number is not finite.
    pub(crate) fn weights(&self) -> Result<Weights, TrainError> {
        let tensor = |parameter: &Parameter| -> candle_core::Result<_> {
            let data = with_numbers(&parameter.value, |values| Ok(values.to_vec()))?;
            let shape = parameter.value.dims().to_vec();
            Ok((parameter.name.clone(), weights::Tensor { shape, data }))
        };
        let tensors = self.parameters().iter().map(tensor);
        let tensors = tensors.collect::<candle_core::Result<_>>()?;
        Ok(Weights::new(self.model(), tensors)?)
    }
}

/// A sample's agents' maps and the map that was made of them.
struct Fused {
    maps: Vec<Tensor>,
    made: Tensor,
}

/// Fuses the maps of each sample's agents, which follow each other in a batch, as a batch with a map for each sample.
///
/// # Errors
/// Those of candle; maps of other agents than the parties have.
pub(crate) fn fuse(
    network: &Network,
    tape: &mut Tape,
    layer: &FuseLayer,
    maps: &Tensor,
    parties: &[Vec<Member>],
) -> candle_core::Result<Tensor> {
    let Some(method) = network.model().arch.method() else {
        candle_core::bail!("a model that fuses nothing has no fusion");
    };
    let shape = MapShape::of(maps.shape())?;
    let agents: usize = parties.iter().map(Vec::len).sum();
    if shape.batch != agents {
        candle_core::bail!("{} maps of {agents} agents", shape.batch);
    }
    // Without weights it leaves what one agent sees as it is.
    if layer.tensors.is_empty() && parties.iter().all(|party| party.len() == 1) {
        return Ok(maps.clone());
    }
    let numbers = |spec: &TensorSpec| {
        let value = with_numbers(network.value(&spec.key), |numbers| Ok(numbers.to_vec()))?;
        Ok((spec.key.clone(), value))
    };
    let weights = layer.tensors.iter().map(numbers);
    let weights = Weights::of_part(weights.collect::<candle_core::Result<_>>()?);
    match method.descent(layer, &weights) {
        Some(fusion) => {
            let own = |spec: &TensorSpec| (spec.key.clone(), network.value(&spec.key).clone());
            let weights = layer.tensors.iter().map(own).collect();
            fuse_by_kernel(fusion, tape, (maps, weights), shape, parties)
        }
        None => fuse_by_operation(network, tape, (method, layer), (maps, shape), parties),
    }
}

/// As [`fuse`], of a fusion that candle leads gradients back through.
fn fuse_by_operation(
    network: &Network,
    tape: &mut Tape,
    (method, layer): (&dyn AnyMethod, &FuseLayer),
    (maps, shape): (&Tensor, MapShape),
    parties: &[Vec<Member>],
) -> candle_core::Result<Tensor> {
    let records = tape.records();
    let variable = |value: Tensor| match records {
        true => Var::from_tensor(&value).map(Var::into_inner),
        false => Ok(value),
    };
    let own = |spec: &TensorSpec| -> candle_core::Result<_> {
        let value = network.value(&spec.key);
        Ok((spec.key.clone(), value.id(), variable(value.clone())?))
    };
    let weights = layer.tensors.iter().map(own).collect::<candle_core::Result<Vec<_>>>()?;
    let named = weights.iter().map(|(key, _, value)| (key.clone(), value.clone()));
    let tensors = Tensors::new(named.collect());
    let sample = |(first, party): (usize, &Vec<Member>)| -> candle_core::Result<Fused> {
        let map = |image: usize| {
            let cells = with_numbers(maps, |numbers| Ok(inner(&shape, numbers, image)))?;
            variable(tensor(cells, (shape.rows, shape.columns, shape.channels))?)
        };
        let maps = (first..first + party.len())
            .map(map)
            .collect::<candle_core::Result<Vec<_>>>()?;
        let agents: Vec<Agent> = party
            .iter()
            .zip(&maps)
            .map(|(member, map)| agent(member, map.clone()))
            .collect();
        let made = method.operation(layer, &tensors, &agents)?;
        Ok(Fused { maps, made })
    };
    let fused = samples(parties).map(sample).collect::<candle_core::Result<Vec<_>>>()?;
    let to = MapShape {
        batch: fused.len(),
        ..shape
    };
    let mut made = buffer(to.len());
    for (fused, image) in fused.iter().zip(made.chunks_exact_mut(to.image())) {
        let cells = fused.made.contiguous()?;
        with_numbers(&cells, |cells| {
            outer(&to, image, cells);
            Ok(())
        })?;
    }
    let made = tensor(made, to.dims())?;
    let from = maps.id();
    let weights = weights.into_iter().map(|(_, id, value)| (id, value)).collect();
    tape.record(&made, move |gradient| {
        lead_back(&fused, weights, gradient, [shape, to], from)
    });
    Ok(made)
}

/// As [`fuse`], of a fusion that leads gradients back itself, with its weights by their keys.
fn fuse_by_kernel(
    fusion: Box<dyn Descent>,
    tape: &mut Tape,
    (maps, weights): (&Tensor, BTreeMap<String, Tensor>),
    shape: MapShape,
    parties: &[Vec<Member>],
) -> candle_core::Result<Tensor> {
    let parties = parties.to_vec();
    let to = MapShape {
        batch: parties.len(),
        ..shape
    };
    let mut made = buffer(to.len());
    let ways_back: Vec<Back> = with_numbers(maps, |numbers| {
        let samples = samples(&parties).zip(made.par_chunks_exact_mut(to.image()));
        let ways_back = samples.map(|((first, party), image)| {
            let maps = own_maps(&shape, numbers, first, party);
            let (fused, back) = fusion.run(&agents(party, &maps), &mut pool());
            outer(&to, image, &fused);
            back
        });
        Ok(ways_back.collect())
    })?;
    let made = tensor(made, to.dims())?;
    let maps = maps.clone();
    tape.record(&made, move |gradient| {
        let mut of_maps = buffer(shape.len());
        let mut images = of_maps.chunks_exact_mut(shape.image());
        let of_samples: Vec<Vec<&mut [f32]>> = parties
            .iter()
            .map(|party| images.by_ref().take(party.len()).collect())
            .collect();
        let of_weights: Vec<_> = with_numbers(&maps, |numbers| {
            with_numbers(gradient, |gradient| {
                let samples = samples(&parties).zip(of_samples).zip(ways_back).enumerate();
                let of_weights = samples.map(|(sample, (((first, party), images), back))| {
                    let maps = own_maps(&shape, numbers, first, party);
                    let found = back(&agents(party, &maps), &inner(&to, gradient, sample), &mut pool());
                    let images = images.into_iter().zip(found.maps);
                    images.for_each(|(image, cells)| outer(&shape, image, &cells));
                    found.tensors
                });
                Ok(of_weights.collect())
            })
        })?;
        let mut gradients = vec![(maps.id(), tensor(of_maps, shape.dims())?)];
        // One sample after the other, so that the sum is the same every time.
        for (key, numbers) in of_weights.into_iter().flatten() {
            let weight = &weights[&key];
            gradients.push((weight.id(), tensor(numbers, weight.shape().clone())?));
        }
        Ok(gradients)
    });
    Ok(made)
}

/// Each sample's agents, with the place of the first one's map in the batch.
fn samples(parties: &[Vec<Member>]) -> impl IndexedParallelIterator<Item = (usize, &Vec<Member>)> {
    let firsts = parties
        .iter()
        .scan(0, |next, party| Some(std::mem::replace(next, *next + party.len())));
    firsts.zip(parties).collect::<Vec<_>>().into_par_iter()
}

/// Threads of one sample: all of them, since samples differ in how long they take.
fn pool() -> Pool {
    Pool::new(rayon::current_num_threads())
}

/// The maps of a sample's agents, without borders.
fn own_maps(shape: &MapShape, numbers: &[f32], first: usize, party: &[Member]) -> Vec<BevMap> {
    let map = |image: usize| BevMap {
        rows: shape.rows,
        columns: shape.columns,
        channels: shape.channels,
        data: inner(shape, numbers, image),
    };
    (first..first + party.len()).map(map).collect()
}

fn agents<'a>(party: &[Member], maps: &'a [BevMap]) -> Vec<agents::Agent<'a>> {
    let agent = |(member, map): (&Member, &'a BevMap)| agents::Agent {
        warp: member.warp,
        roadside: member.roadside,
        delay: member.delay,
        ..agents::Agent::beside(map)
    };
    party.iter().zip(maps).map(agent).collect()
}

fn agent(member: &Member, map: Tensor) -> Agent {
    let Member {
        warp, roadside, delay, ..
    } = *member;
    Agent {
        map: AgentMap::Own(OwnMap {
            map,
            confidence: None,
            warp,
        }),
        roadside,
        delay,
    }
}

/// The gradients of the maps and weights of fusions, from that of what they made.
fn lead_back(
    fused: &[Fused],
    weights: Vec<(TensorId, Tensor)>,
    gradient: &Tensor,
    [shape, to]: [MapShape; 2],
    from: TensorId,
) -> candle_core::Result<Gradients> {
    let descents = fused.par_iter().enumerate().map(|(sample, fused)| {
        let along = with_numbers(gradient, |numbers| Ok(inner(&to, numbers, sample)))?;
        let along = tensor(along, (to.rows, to.columns, to.channels))?;
        (&fused.made * along)?.sum_all()?.backward()
    });
    let descents = descents.collect::<candle_core::Result<Vec<_>>>()?;
    let mut of_maps = buffer(shape.len());
    let mut images = of_maps.chunks_exact_mut(shape.image());
    let mut of_weights: HashMap<TensorId, Tensor> = HashMap::new();
    for (fused, found) in fused.iter().zip(&descents) {
        for (map, image) in fused.maps.iter().zip(images.by_ref()) {
            if let Some(cells) = found.get(map) {
                with_numbers(&cells.contiguous()?, |cells| {
                    outer(&shape, image, cells);
                    Ok(())
                })?;
            }
        }
        for (id, value) in &weights {
            let Some(part) = found.get(value) else { continue };
            let sum = match of_weights.get(id) {
                None => part.clone(),
                Some(sum) => (sum + part)?,
            };
            of_weights.insert(*id, sum);
        }
    }
    let weights = of_weights.into_iter().map(|(id, sum)| Ok((id, sum.contiguous()?)));
    let mut gradients = weights.collect::<candle_core::Result<Gradients>>()?;
    gradients.push((from, tensor(of_maps, shape.dims())?));
    Ok(gradients)
}

#[cfg(test)]
mod tests {
    use realo_kernels::warp::Warp;
    use realo_methods::attfuse;
    use realo_nn::anchors::Anchors;
    use realo_nn::model::{Architecture, Sharing, Shrink};
    use realo_nn::tensors::Role;

    use super::*;
    use crate::data::{Batch, Scene};
    use crate::freeze::{Frozen, Part};
    use crate::layers::PillarBatch;
    use crate::loss::{Loss, LossWeights};
    use crate::random::Stream;
    use crate::targets::{Object, assign};

    /// A shipped model on a small grid.
    fn model(name: &str, compression: usize) -> Model {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../../models/{name}.toml"));
        let mut model = Model::read(&path).unwrap();
        (model.grid.x, model.grid.y) = ([-6.4, 6.4], [-6.4, 6.4]);
        model.encoder = None;
        model.refine.clear();
        model.arch.set_compression(compression);
        model.validate().unwrap();
        model
    }

    /// A network all of whose tensors take part.
    fn network(model: &Model) -> Network {
        let mut number = 0..;
        let values = |spec: &TensorSpec| {
            let mut draws = Stream::new(5, "test", number.next().unwrap());
            let fan_in = match spec.role {
                Role::Weight { fan_in } => fan_in,
                _ => 16,
            };
            let deviation = (1.0 / fan_in as f64).sqrt();
            let number = |_| (deviation * draws.normal()).abs().max(0.05) as f32;
            let signed = |(index, value): (usize, f32)| if index % 3 == 0 { -value } else { value };
            let positive: Vec<f32> = (0..spec.count()).map(number).collect();
            match spec.role {
                Role::RunningVariance => positive,
                _ => positive.into_iter().enumerate().map(signed).collect(),
            }
        };
        Network::with(model, values).unwrap()
    }

    /// An ego with a vehicle whose map is two frames old and a roadside unit beside it, and an ego that is alone.
    fn batch(model: &Model) -> Batch {
        let pillars = (0..4).map(|agent| {
            let mut draws = Stream::new(9, "points", agent);
            let mut scene = Scene::default();
            (0..600).for_each(|_| scene.push([6.0, 6.0, 1.5].map(|far| draws.between(-far, far) as f32), 0));
            scene.pillars(model)
        });
        let pillars = PillarBatch::new(&model.grid, &model.pillars, pillars.collect());
        let (sin, cos) = 0.3f64.sin_cos();
        let vehicle = Member {
            warp: Warp([[cos, -sin, 2.3], [sin, cos, -1.4]]),
            roadside: false,
            delay: 2,
            own: false,
        };
        let unit = Member {
            warp: Warp([[0.0, -1.0, 13.0], [1.0, 0.0, -3.0]]),
            roadside: true,
            delay: 0,
            own: false,
        };
        let object = |class: usize, x: f64| Object {
            class,
            hwl: [x, 1.0, 0.8, 1.6, 1.7, 4.0, 0.3],
        };
        let targets = assign(&Anchors::of(model), &[object(0, 3.0), object(1, -5.0), object(2, -2.0)]);
        Batch {
            pillars: Arc::new(pillars),
            parties: vec![vec![Member::EGO, vehicle, unit], vec![Member::EGO]],
            targets: vec![targets.clone(), targets],
            lessons: vec![None, None],
        }
    }

    fn loss_of(network: &Network, batch: &Batch) -> f64 {
        let pass = network.clone().pass(batch, &LossWeights::default()).unwrap();
        pass.losses.iter().map(Loss::total).sum()
    }

    /// How many tensors have a gradient to speak of, and by how much it is off the slope of the loss along it.
    fn slopes(model: &Model) -> Vec<(String, f64)> {
        let (network, batch) = (network(model), batch(model));
        let pass = network.clone().pass(&batch, &LossWeights::default()).unwrap();
        let mut off = Vec::new();
        for (index, (parameter, gradient)) in network.parameters().iter().zip(&pass.gradients).enumerate() {
            let Some(gradient) = gradient else {
                // Only the ego asks and answers in the last round, and it is a vehicle.
                let unused = ["prior_feed", "q_linears.1", "a_linears.1"]
                    .iter()
                    .any(|part| parameter.name.contains(part));
                assert!(!parameter.trained || unused, "{} has no gradient", parameter.name);
                continue;
            };
            let length = gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            // Less is lost in the loss's rounding.
            if length < 3.0 {
                continue;
            }
            let values = with_numbers(&parameter.value, |values| Ok(values.to_vec())).unwrap();
            let step = 2e-3;
            let moved = |sign: f64| {
                let mut network = network.clone();
                let along = values.iter().zip(gradient);
                let along = along.map(|(value, g)| value + (sign * step * f64::from(*g) / length) as f32);
                network.set(index, along.collect()).unwrap();
                loss_of(&network, &batch)
            };
            let slope = (moved(1.0) - moved(-1.0)) / (2.0 * step);
            off.push((parameter.name.clone(), (slope - length).abs() / length));
        }
        off
    }

    #[test]
    fn gradients_are_the_slopes_of_the_loss() {
        for (name, compression) in [
            ("lite-attfuse", 0),
            ("lite-attfuse", 4),
            ("lite-attfuse whole", 4),
            ("lite-fcooper", 0),
            ("lite-v2xvit", 0),
        ] {
            let mut model = model(name.split(' ').next().expect("a name"), compression);
            if name.ends_with("whole") {
                let sharing = Sharing {
                    compress_own: false,
                    ..model.arch.sharing().expect("it shares")
                };
                model.arch = attfuse::Settings(sharing).into();
            }
            let off = slopes(&model);
            assert!(
                off.len() > 20,
                "{name}: only {} tensors have a gradient to speak of",
                off.len()
            );
            let encoder = off.iter().filter(|(key, _)| key.starts_with("backbone")).count();
            assert!(encoder > 5, "{name}: {encoder} of the encoder");
            for (key, off) in off {
                // A maximum and a ReLU have edges.
                assert!(off < 0.08, "{name}: {key} is off by {off}");
            }
        }
    }

    #[test]
    fn what_is_frozen_has_no_gradients_and_keeps_its_statistics() {
        let model = model("lite-attfuse", 8);
        let mut frozen = network(&model);
        frozen.freeze(&Frozen::of(&model, &[Part::Encoder]));
        let before = frozen.clone();
        let pass = frozen.pass(&batch(&model), &LossWeights::default()).unwrap();
        let of_encoder: Vec<String> = frozen.layers().encoder().map(|spec| spec.key).collect();
        let numbers =
            |network: &Network, key: &str| with_numbers(network.value(key), |values| Ok(values.to_vec())).unwrap();
        let mut of_compressor = 0;
        for (parameter, gradient) in frozen.parameters().iter().zip(&pass.gradients) {
            let (name, is_encoder) = (&parameter.name, of_encoder.contains(&parameter.name));
            if is_encoder || !name.contains(".running_") {
                assert_eq!(gradient.is_none(), is_encoder, "{name}");
                assert_eq!(numbers(&before, name), numbers(&frozen, name), "{name}");
            }
            of_compressor += usize::from(name.starts_with("naive_compressor") && !is_encoder);
        }
        assert!(of_compressor >= 12, "{of_compressor} tensors of the compressor learn");
    }

    #[test]
    fn layers_before_the_heads_begin_by_changing_nothing() {
        let plain = model("lite-fcooper", 0);
        let weights = network(&plain).weights().unwrap();
        let mut refining = plain.clone();
        refining.refine = vec![
            Shrink {
                kernel: 3,
                channels: 64
            };
            2
        ];
        let begun = beginning(&refining, &weights, 1).unwrap();
        assert_eq!(begun.parameters().len(), network(&plain).parameters().len() + 4);
        let (batch, of_loss) = (batch(&plain), LossWeights::default());
        let loss = |network: &Network| network.clone().pass(&batch, &of_loss).unwrap().losses;
        let (before, after) = (loss(&beginning(&plain, &weights, 1).unwrap()), loss(&begun));
        for (before, after) in before.iter().zip(&after) {
            assert!((before.total() - after.total()).abs() < 1e-4, "{before:?} {after:?}");
        }
    }

    #[test]
    fn what_weights_lack_begins_at_random_and_the_rest_as_it_is() {
        let whole = model("lite-attfuse", 0);
        let weights = network(&whole).weights().unwrap();
        let compressing = model("lite-attfuse", 8);
        let network = beginning(&compressing, &weights, 1).unwrap();
        let (mut kept, mut drawn) = (0, 0);
        for parameter in network.parameters() {
            let numbers = with_numbers(&parameter.value, |values| Ok(values.to_vec())).unwrap();
            match weights.find(&parameter.name) {
                Some(given) => {
                    assert_eq!(given, numbers);
                    kept += 1;
                }
                None => drawn += 1,
            }
        }
        assert!(kept > 40 && drawn > 5, "{kept} kept, {drawn} drawn");
    }
}

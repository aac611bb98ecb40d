//! Training of a fusion that has weights of its own, and of the heads behind it. What leads from points to the maps
//! that are fused is another model's and stays as it is.

use std::collections::HashSet;
use std::path::Path;
use std::sync::Arc;

use crate::loss::{HeadMaps, Loss, LossWeights, loss};
use crate::targets::Targets;
use candle_core::{Tensor, Var};
use realo_methods::Arch;
use realo_methods::Model;
use realo_methods::method::Learning;
use realo_methods::tensors::{Agent, Tensors};
use realo_methods::{Kernels, Loaded};
use realo_nn::layers::{Layer, Layers};
use realo_nn::model::{Architecture, ClassAnchor, Grid};
use realo_nn::tensors::TensorSpec;
use realo_nn::weights::{self, Weights};

use crate::TrainError;
use crate::checkpoint::differences;
use crate::layers::{tensor, with_numbers};
use crate::network::{Network, Parameter, Pass};
use crate::random::Stream;
use crate::train::option;
use crate::widen::{as_wide_as, is_wider, widened};

/// How the fusion of a model is trained; of a detector of one agent, not at all.
pub(crate) fn learning(model: &Model) -> Learning {
    model
        .arch
        .method()
        .map_or(Learning::Nothing, |method| method.learning())
}

/// Whether a model's fusion has weights that are trained here, its encoder's not.
pub fn learns_to_fuse(model: &Model) -> bool {
    learning(model) == Learning::OnMaps
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
/// [`TrainError`] if the model cannot be trained so, the file of one that learns to fuse is not given, not to be had, or makes
/// other maps.
pub(crate) fn start(model: &Model, file: Option<&Path>, seed: u64) -> Result<Option<Start>, TrainError> {
    let refuse = |reason: &str| TrainError::Model {
        model: model.name.clone(),
        reason: reason.into(),
    };
    if learning(model) == Learning::Never {
        let title = model.arch.title();
        return Err(refuse(&format!("the fusion of {title} cannot be trained here")));
    }
    if learns_to_fuse(model) && model.arch.sharing().is_some_and(|sharing| sharing.compression > 0) {
        return Err(refuse(
            "its `arch.compression` is not 0, and compressors are not trained here",
        ));
    }
    if model.encoder.is_some() && !learns_to_fuse(model) {
        return Err(refuse(
            "it takes its `encoder` from another file, but all of it would be trained: leave `encoder` out",
        ));
    }
    let Some(file) = file else {
        return match learns_to_fuse(model) {
            false => Ok(None),
            true => Err(option(
                "from",
                "a model file with weights whose encoder is taken, as --from models/lite.toml, since this model learns to fuse",
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
    if !learns_to_fuse(model) && other_maps(model, &as_wide_as(model, &of_file)).is_empty() && is_wider(model, &of_file)
    {
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

/// Keys of what training leaves as it is.
pub(crate) fn frozen(model: &Model, layers: &Layers) -> HashSet<String> {
    match learns_to_fuse(model) {
        true => layers.encoder().map(|spec| spec.key).collect(),
        false => HashSet::new(),
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
        sha256: Default::default(),
        arch: Arch::default(),
        precision: model.precision,
        score_threshold: model.score_threshold,
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

/// A network whose encoder and heads are another one's, and whose fusion, if it has weights, gives the ego's map as it is.
///
/// # Errors
/// Those of candle.
pub(crate) fn beginning(model: &Model, encoder: &Weights, seed: u64) -> candle_core::Result<Network> {
    let of_fusion: HashSet<String> = of_fusion(&Layers::of(model)).map(|spec| spec.key).collect();
    let mut number = 0..;
    Network::with(model, |spec| match model.arch.method() {
        Some(method) if of_fusion.contains(&spec.key) => {
            let mut draws = Stream::new(seed, "fusion", number.next().unwrap_or(0));
            method.initial(spec, &mut || draws.normal())
        }
        _ => encoder.tensor(&spec.key).to_vec(),
    })
}

fn of_fusion(layers: &Layers) -> impl Iterator<Item = TensorSpec> {
    let steps = layers.steps().iter();
    let fusions = steps.filter(|step| matches!(step.layer, Layer::Fuse(_)));
    fusions.flat_map(|step| step.layer.tensors())
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

    /// Forward and backward pass of the fusion and the heads, of a batch of agents' maps with the targets of its samples.
    ///
    /// # Errors
    /// Those of candle; a model whose fusion or heads are no such layers.
    pub(crate) fn pass_on_maps(
        &self,
        samples: &[Vec<Agent>],
        targets: &[Targets],
        settings: &LossWeights,
    ) -> candle_core::Result<Pass> {
        let parameters = self.parameters().iter();
        let variables = parameters.map(|parameter| {
            parameter
                .trained
                .then(|| Var::from_tensor(&parameter.value))
                .transpose()
        });
        let variables: Vec<Option<Var>> = variables.collect::<candle_core::Result<_>>()?;
        let named = self.parameters().iter().zip(&variables);
        let named = named
            .filter_map(|(parameter, variable)| Some((parameter.name.clone(), variable.as_ref()?.as_tensor().clone())));
        let fusion = Fusing {
            arch: &self.model().arch,
            layers: self.layers(),
            tensors: Tensors::new(named.collect()),
        };
        let mut pass = Pass {
            losses: Vec::new(),
            gradients: vec![None; variables.len()],
        };
        for (agents, targets) in samples.iter().zip(targets) {
            let (loss, descent) = fusion.loss(agents, targets, settings, samples.len())?;
            pass.losses.push(loss);
            let found = descent.backward()?;
            for (variable, sum) in variables.iter().zip(&mut pass.gradients) {
                let Some(gradient) = variable.as_ref().and_then(|variable| found.get(variable)) else {
                    continue;
                };
                let gradient = gradient.flatten_all()?.to_vec1::<f32>()?;
                match sum {
                    None => *sum = Some(gradient),
                    Some(sum) => sum.iter_mut().zip(gradient).for_each(|(sum, part)| *sum += part),
                }
            }
        }
        Ok(pass)
    }
}

/// A fusion and the heads behind it, whose tensors gradients lead to.
struct Fusing<'a> {
    arch: &'a Arch,
    layers: &'a Layers,
    tensors: Tensors,
}

impl Fusing<'_> {
    /// A sample's share of the loss, and a number whose gradient is the loss's.
    fn loss(
        &self,
        agents: &[Agent],
        targets: &Targets,
        settings: &LossWeights,
        batch: usize,
    ) -> candle_core::Result<(Loss, Tensor)> {
        let Some((method, layer)) = self.arch.method().zip(self.layers.fusion()) else {
            candle_core::bail!("a model that fuses nothing is not trained on maps");
        };
        let fused = method.operation(layer, &self.tensors, agents)?;
        let [scores, deltas] = [self.layers.scores, self.layers.deltas].map(|head| self.head(head, &fused));
        let (scores, deltas) = (scores?, deltas?);
        let (mut of_scores, mut of_deltas) = (vec![0.0; scores.elem_count()], vec![0.0; deltas.elem_count()]);
        let mut gradient = HeadMaps {
            scores: &mut of_scores[..],
            deltas: &mut of_deltas[..],
        };
        let loss = with_numbers(&scores, |scores| {
            with_numbers(&deltas, |deltas| {
                Ok(loss(
                    &HeadMaps { scores, deltas },
                    targets,
                    settings,
                    batch,
                    &mut gradient,
                ))
            })
        })?;
        let along = |head: &Tensor, gradient: Vec<f32>| (head * tensor(gradient, head.shape().clone())?)?.sum_all();
        Ok((loss, (along(&scores, of_scores)? + along(&deltas, of_deltas)?)?))
    }

    /// What a head makes of the fused map, `[cells, outputs]`.
    fn head(&self, head: realo_nn::layers::MapId, fused: &Tensor) -> candle_core::Result<Tensor> {
        match &self.layers.between(&[self.layers.fused], &[head])[..] {
            [step]
                if let Layer::Convolution(layer) = &step.layer
                    && layer.kernel == 1 =>
            {
                let weight = self.tensors.get(&layer.weight_key())?.flatten_from(1)?;
                let made = fused.flatten_to(1)?.matmul(&weight.t()?)?;
                match layer.bias_key() {
                    Some(key) => made.broadcast_add(self.tensors.get(&key)?),
                    None => Ok(made),
                }
            }
            _ => candle_core::bail!("expected heads of one layer that looks at one cell"),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::targets::{Object, assign};
    use realo_methods::tensors::{AgentMap, Placed};
    use realo_nn::anchors::Anchors;
    use realo_nn::tensors::Role;

    use super::*;

    fn model() -> Model {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/lite-v2xvit.toml");
        let mut model = Model::read(&path).unwrap();
        (model.grid.x, model.grid.y) = ([-6.4, 6.4], [-6.4, 6.4]);
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

    /// An ego of a kind, a vehicle whose map is two frames old, and a roadside unit that covers half of the map.
    fn agents(model: &Model, roadside: bool) -> Vec<Agent> {
        let [rows, columns] = model.map_size();
        let channels = 64;
        let agent = |number: u64, covered: usize| {
            let mut draws = Stream::new(9, "maps", number);
            let mut numbers = |count: usize| (0..count).map(|_| draws.unit() as f32).collect::<Vec<f32>>();
            let reach: Vec<f32> = (0..rows * columns)
                .map(|cell| f32::from(u8::from(cell < covered)))
                .collect();
            Agent {
                map: AgentMap::Placed(Placed {
                    map: tensor(numbers(rows * columns * channels), (rows, columns, channels)).unwrap(),
                    reach: tensor(reach.clone(), (rows, columns, 1)).unwrap(),
                    covered: tensor(reach, (rows, columns, 1)).unwrap(),
                }),
                roadside: number == 2 || number == 0 && roadside,
                delay: if number == 1 { 2 } else { 0 },
            }
        };
        let all = rows * columns;
        vec![agent(0, all), agent(1, all), agent(2, all / 2)]
    }

    fn targets(model: &Model) -> Vec<Targets> {
        let object = |class: usize, x: f64| Object {
            class,
            hwl: [x, 1.0, 0.8, 1.6, 1.7, 4.0, 0.3],
        };
        let targets = assign(&Anchors::of(model), &[object(0, 3.0), object(1, -5.0), object(2, -2.0)]);
        vec![targets.clone(), targets]
    }

    fn loss_of(network: &Network, samples: &[Vec<Agent>], targets: &[Targets]) -> f64 {
        let pass = network.pass_on_maps(samples, targets, &LossWeights::default()).unwrap();
        pass.losses.iter().map(Loss::total).sum()
    }

    #[test]
    fn gradients_are_the_slopes_of_the_loss() {
        let model = model();
        let network = network(&model);
        let samples = [false, true].map(|roadside| agents(&model, roadside));
        let targets = targets(&model);
        let pass = network
            .pass_on_maps(&samples, &targets, &LossWeights::default())
            .unwrap();
        let mut checked = 0;
        for (index, (parameter, gradient)) in network.parameters().iter().zip(&pass.gradients).enumerate() {
            let Some(gradient) = gradient else {
                let unused = parameter.name.contains("prior_feed");
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
                loss_of(&network, &samples, &targets)
            };
            let slope = (moved(1.0) - moved(-1.0)) / (2.0 * step);
            assert!(
                (slope - length).abs() < 0.05 * length,
                "{}: a slope of {slope}, a gradient of {length}",
                parameter.name
            );
            checked += 1;
        }
        assert!(checked > 40, "only {checked} tensors have a gradient to speak of");
    }

    #[test]
    fn a_fusion_begins_as_the_egos_map() {
        let model = model();
        let weights = network(&model).weights().unwrap();
        let network = beginning(&model, &weights, 1).unwrap();
        let tensors = network.parameters().iter();
        let tensors = tensors.map(|parameter| (parameter.name.clone(), parameter.value.clone()));
        let agents = agents(&model, false);
        let (method, layer) = (model.arch.method().unwrap(), network.layers().fusion().unwrap());
        let fused = method
            .operation(layer, &Tensors::new(tensors.collect()), &agents)
            .unwrap();
        let numbers = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(numbers(&fused), numbers(&agents[0].placed().unwrap().map));
    }
}

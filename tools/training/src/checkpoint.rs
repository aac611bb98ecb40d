//! The state of a training: one file, replaced as a whole.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};

use realo_methods::Model;
use realo_nn::layers::Layers;
use realo_nn::tensors::TensorSpec;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::TrainError;
use crate::curve::{Curve, Point};
use crate::data::{Augmentation, Decoys, Supply, write_whole};
use crate::freeze::Frozen;
use crate::layers::with_numbers;
use crate::network::Network;
use crate::optimizer::{AdamW, OptimizerSettings};

/// Names of the tensors of decoys, with the step from which on samples have them.
const DECOYS: &str = "decoys.";

/// Everything that the next step depends on, and how it came to this.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// The network.
    pub network: Network,
    /// The optimizer.
    pub optimizer: AdamW,
    /// Loss and learning rate of all steps so far.
    pub curve: Curve,
    /// What is pasted into samples.
    pub supply: Supply,
    /// What must not change between the parts of a training.
    pub plan: TrainingPlan,
}

/// The settings that decide what every step does, but the learning rate, which a training that diverged needs lower.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingPlan {
    /// The model.
    pub model: Model,
    /// Parts of the network that stay as they are.
    pub frozen: Frozen,
    /// Of all draws.
    pub seed: u64,
    /// Samples of a step.
    pub batch: usize,
    /// Steps in all.
    pub steps: u64,
    /// Whether batch norms keep their statistics.
    pub frozen_norms: bool,
    /// Probability that a step sees parts of the range.
    pub parts: f64,
    /// How weights are moved; its rate does not count.
    pub optimizer: OptimizerSettings,
    /// How samples are drawn.
    pub augmentation: Augmentation,
    /// Where frames come from, in words.
    pub data: String,
    /// The weights that it began with, if they were not random.
    pub from: Option<String>,
    /// Whose maps were examples.
    #[serde(default)]
    pub teacher: Option<String>,
}

impl TrainingPlan {
    /// In which settings two plans differ, as `name: was, now asked for`; empty for the same plan.
    pub fn differences(&self, asked: &TrainingPlan) -> Vec<String> {
        let mut asked = asked.clone();
        asked.optimizer.rate = self.optimizer.rate;
        let reported = differences(self, &asked).into_iter();
        reported
            .map(|(name, was, asked)| format!("{name}: was {was}, now {asked} is asked for"))
            .collect()
    }
}

/// What differs between two of plain data: name, first and second value.
pub(crate) fn differences<T: Serialize>(a: &T, b: &T) -> Vec<(String, Value, Value)> {
    let [a, b] = [a, b].map(|data| serde_json::to_value(data).expect("plain data"));
    let mut found = Vec::new();
    match (&a, &b) {
        // A key that one of them leaves out is null there.
        (Value::Object(first), Value::Object(second)) => {
            let keys: BTreeSet<&String> = first.keys().chain(second.keys()).collect();
            for key in keys {
                let [a, b] = [first, second].map(|object| object.get(key).unwrap_or(&Value::Null));
                differ(key, a, b, &mut found);
            }
        }
        _ => differ("", &a, &b, &mut found),
    }
    found
}

fn differ(name: &str, a: &Value, b: &Value, found: &mut Vec<(String, Value, Value)>) {
    if let (Value::Object(first), Value::Object(second)) = (a, b)
        && first.keys().eq(second.keys())
    {
        for (key, a) in first {
            let name = if name.is_empty() {
                key.clone()
            } else {
                format!("{name}.{key}")
            };
            differ(&name, a, &second[key], found);
        }
    } else if a != b {
        found.push((name.into(), a.clone(), b.clone()));
    }
}

impl Checkpoint {
    /// Writes the state; a kill or a full disk leaves the one before.
    ///
    /// # Errors
    /// [`TrainError::Write`].
    pub fn write(&self, path: &Path) -> Result<(), TrainError> {
        let mut tensors = Tensors::default();
        let parameters = self.network.parameters().iter().enumerate();
        for (index, parameter) in parameters {
            let shape = parameter.value.dims();
            with_numbers(&parameter.value, |values| {
                tensors.add_f32(parameter.name.clone(), shape, values);
                Ok(())
            })?;
            if parameter.trained {
                tensors.add_f32(
                    format!("adam.first.{}", parameter.name),
                    shape,
                    &self.optimizer.first[index],
                );
                tensors.add_f32(
                    format!("adam.second.{}", parameter.name),
                    shape,
                    &self.optimizer.second[index],
                );
            }
        }
        let points = self
            .curve
            .points
            .iter()
            .flat_map(|point| point.to_numbers())
            .flat_map(f64::to_le_bytes)
            .collect();
        tensors.0.push((
            "curve".into(),
            Dtype::F64,
            vec![self.curve.points.len(), Point::NUMBERS],
            points,
        ));
        for (step, decoys) in self.supply.iter() {
            let numbers = decoys.to_numbers();
            tensors.add_f32(format!("{DECOYS}{step}"), &[numbers.len()], &numbers);
        }
        let plan = serde_json::to_string(&self.plan).expect("plans are plain data");
        let about = HashMap::from([
            ("plan".to_string(), plan),
            ("steps".to_string(), self.optimizer.steps.to_string()),
        ]);
        write_whole(path, &tensors.serialize(about))
    }

    /// Reads a state.
    ///
    /// # Errors
    /// [`TrainError::Read`]; [`TrainError::Checkpoint`] if it is none, or one of another model.
    pub fn read(path: &Path, model: &Model) -> Result<Self, TrainError> {
        let bytes = std::fs::read(path).map_err(|error| TrainError::Read {
            path: path.into(),
            error,
        })?;
        Checkpoint::parse(&bytes, model).map_err(|reason| TrainError::Checkpoint {
            path: path.into(),
            reason,
        })
    }

    fn parse(bytes: &[u8], model: &Model) -> Result<Self, String> {
        let (_, about) = SafeTensors::read_metadata(bytes)
            .map_err(|error| format!("expected the state of a training in safetensors, found none: {error}"))?;
        let about = about.metadata().clone().unwrap_or_default();
        let field = |key: &str| about.get(key).ok_or(format!("expected metadata `{key}`, found none"));
        let plan: TrainingPlan = serde_json::from_str(field("plan")?).map_err(|error| format!("`plan`: {error}"))?;
        let reported = field("steps")?;
        let steps = reported.parse().ok().filter(|steps| *steps <= plan.steps);
        let steps =
            steps.ok_or_else(|| format!("`steps`: expected 0 to {} of the plan, found `{reported}`", plan.steps))?;
        let file = StateFile(SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?);
        let mut network = file.network(model)?;
        network.freeze(&plan.frozen);
        let optimizer = file.optimizer(&network, steps)?;
        Ok(Checkpoint {
            network,
            optimizer,
            supply: file.supply()?,
            curve: file.curve()?,
            plan,
        })
    }
}

/// The tensors of a checkpoint; what is read of them has the shape that it must have.
struct StateFile<'a>(SafeTensors<'a>);

impl StateFile<'_> {
    fn network(&self, model: &Model) -> Result<Network, String> {
        let mut values = HashMap::new();
        for spec in Layers::of(model).tensors() {
            let read = self.numbers(&spec.key, &spec.shape)?;
            values.insert(spec.key, read);
        }
        let mut value = |spec: &TensorSpec| values.remove(&spec.key).expect("every tensor has been read");
        Network::with(model, &mut value).map_err(|error| error.to_string())
    }

    /// The optimizer's moments of the parameters that are trained.
    fn optimizer(&self, network: &Network, steps: u64) -> Result<AdamW, String> {
        let mut optimizer = AdamW {
            steps,
            ..AdamW::new(network)
        };
        for (index, parameter) in network.parameters().iter().enumerate().filter(|(_, p)| p.trained) {
            let shape = parameter.value.dims();
            optimizer.first[index] = self.numbers(&format!("adam.first.{}", parameter.name), shape)?;
            optimizer.second[index] = self.numbers(&format!("adam.second.{}", parameter.name), shape)?;
        }
        Ok(optimizer)
    }

    fn supply(&self) -> Result<Supply, String> {
        let names = self.0.names().into_iter();
        let steps = names.filter_map(|name| name.strip_prefix(DECOYS)?.parse::<u64>().ok());
        let mut supply = Supply::default();
        for step in steps.collect::<BTreeSet<u64>>() {
            let name = format!("{DECOYS}{step}");
            let view = self.0.tensor(&name).map_err(|error| error.to_string())?;
            supply.add(step, Decoys::from_numbers(&self.numbers(&name, view.shape())?));
        }
        Ok(supply)
    }

    fn curve(&self) -> Result<Curve, String> {
        let curve = self.0.tensor("curve").map_err(|error| error.to_string())?;
        if curve.shape().last() != Some(&Point::NUMBERS) {
            let found = curve.shape();
            return Err(format!(
                "expected `curve` of {} numbers a step, found {found:?}",
                Point::NUMBERS
            ));
        }
        let numbers = curve.data().as_chunks::<8>().0.iter();
        let numbers: Vec<f64> = numbers.map(|bytes| f64::from_le_bytes(*bytes)).collect();
        let points = numbers.as_chunks::<{ Point::NUMBERS }>().0.iter();
        Ok(Curve {
            points: points.map(Point::from_numbers).collect(),
        })
    }

    /// The finite f32 numbers of a tensor of this shape.
    fn numbers(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, String> {
        let view = self
            .0
            .tensor(name)
            .map_err(|_| format!("expected `{name}` {shape:?}, found none"))?;
        if view.dtype() != Dtype::F32 || view.shape() != shape {
            return Err(format!(
                "expected `{name}` F32 {shape:?}, found {:?} {:?}",
                view.dtype(),
                view.shape()
            ));
        }
        let numbers = view.data().as_chunks::<4>().0.iter();
        let numbers: Vec<f32> = numbers.map(|bytes| f32::from_le_bytes(*bytes)).collect();
        match numbers.iter().all(|number| number.is_finite()) {
            true => Ok(numbers),
            false => Err(format!("expected finite numbers in `{name}`, found others")),
        }
    }
}

/// Writes a network as the files of weights that inference reads; of two, the second gets the encoder.
///
/// # Errors
/// [`TrainError::Write`].
pub fn write_weights(network: &Network, files: &[PathBuf]) -> Result<(), TrainError> {
    let of_encoder: HashSet<String> = network.layers().encoder().map(|spec| spec.key).collect();
    let mut parts: Vec<Tensors> = files.iter().map(|_| Tensors::default()).collect();
    for parameter in network.parameters() {
        let part = match of_encoder.contains(&parameter.name) {
            true => files.len() - 1,
            false => 0,
        };
        with_numbers(&parameter.value, |values| {
            parts[part].add_f32(parameter.name.clone(), parameter.value.dims(), values);
            Ok(())
        })?;
    }
    let mut parts = parts.iter().zip(files);
    parts.try_for_each(|(tensors, path)| write_whole(path, &tensors.serialize(HashMap::new())))
}

#[derive(Default)]
struct Tensors(Vec<(String, Dtype, Vec<usize>, Vec<u8>)>);

impl Tensors {
    fn add_f32(&mut self, name: String, shape: &[usize], values: &[f32]) {
        let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.0.push((name, Dtype::F32, shape.to_vec(), bytes));
    }

    fn serialize(&self, about: HashMap<String, String>) -> Vec<u8> {
        let views = self.0.iter().map(|(name, dtype, shape, bytes)| {
            let view = TensorView::new(*dtype, shape.clone(), bytes).expect("bytes of the tensor's shape");
            (name.as_str(), view)
        });
        safetensors::serialize(views, Some(about)).expect("views that were checked")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_comes_back_with_its_decoys() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/lite.toml");
        let model = Model::read(&path).unwrap();
        let network = Network::random(&model, 1).unwrap();
        let mut supply = Supply::default();
        supply.add(100, Decoys::default());
        supply.add(
            1000,
            Decoys::from_numbers(&[0.0, 0.5, 1.0, 2.0, 0.4, 0.0, 0.5, 1.1, 2.0, 0.5]),
        );
        let mut state = Checkpoint {
            optimizer: AdamW::new(&network),
            network,
            curve: Curve::default(),
            supply,
            plan: TrainingPlan {
                model: model.clone(),
                frozen: Frozen::default(),
                seed: 1,
                batch: 2,
                steps: 2000,
                frozen_norms: false,
                parts: 0.5,
                optimizer: OptimizerSettings::default(),
                augmentation: Augmentation::default(),
                data: "a test".into(),
                from: None,
                teacher: None,
            },
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        state.write(&path).unwrap();
        let read = Checkpoint::read(&path, &model).unwrap();
        assert_eq!((read.supply, &read.plan), (state.supply.clone(), &state.plan));

        let refused = |state: &Checkpoint| {
            state.write(&path).unwrap();
            Checkpoint::read(&path, &model).map(|_| ()).unwrap_err().to_string()
        };
        state.optimizer.steps = 2001;
        let error = refused(&state);
        assert!(
            error.contains("`steps`: expected 0 to 2000 of the plan, found `2001`"),
            "{error}"
        );
        state.optimizer.steps = 7;
        state.optimizer.first[0][0] = f32::NAN;
        let error = refused(&state);
        assert!(error.contains("expected finite numbers in `adam.first."), "{error}");
    }
}

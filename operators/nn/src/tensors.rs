//! The tensors of layers: keys, shapes, and what they are.

/// A tensor of a layer.
#[derive(Clone, Debug, PartialEq)]
pub struct TensorSpec {
    /// Key in the file of weights.
    pub key: String,
    /// Size of each dimension.
    pub shape: Vec<usize>,
    /// What it is.
    pub role: Role,
}

/// What a tensor is in its layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Factors of a layer; each result is a sum of `fan_in` products.
    Weight {
        /// Products of a sum.
        fan_in: usize,
    },
    /// Summands of a layer.
    Bias,
    /// Factors of a batch norm.
    NormWeight,
    /// Summands of a batch norm.
    NormBias,
    /// What each delay adds, a row each; trained from sines on.
    Delays,
    /// Running mean of a batch norm.
    RunningMean,
    /// Running variance of a batch norm.
    RunningVariance,
}

/// The parts of a batch norm, in the order of the state dict.
const NORM_PARTS: [(&str, Role); 4] = [
    ("weight", Role::NormWeight),
    ("bias", Role::NormBias),
    ("running_mean", Role::RunningMean),
    ("running_var", Role::RunningVariance),
];

/// Key of a part of a batch norm.
///
/// # Panics
/// If a batch norm has no such part.
pub fn norm_key(norm: &str, part: Role) -> String {
    let named = NORM_PARTS.iter().find(|(_, role)| *role == part);
    let (name, _) = named.expect("a part of a batch norm");
    format!("{norm}.{name}")
}

impl Role {
    /// Whether gradients move it; running statistics follow the batches instead.
    pub fn is_trained(self) -> bool {
        !matches!(self, Role::RunningMean | Role::RunningVariance)
    }
}

impl TensorSpec {
    /// Numbers that it holds.
    pub fn count(&self) -> usize {
        self.shape.iter().product()
    }

    /// Those of a batch norm.
    pub(crate) fn norm(key: &str, channels: usize) -> impl Iterator<Item = TensorSpec> {
        NORM_PARTS.into_iter().map(move |(part, role)| TensorSpec {
            key: format!("{key}.{part}"),
            shape: vec![channels],
            role,
        })
    }
}

/// The tensors of a fusion, as they are put together.
#[derive(Debug, Default)]
pub struct Specs(pub Vec<TensorSpec>);

impl Specs {
    /// Adds a tensor.
    pub fn push(&mut self, key: String, shape: Vec<usize>, role: Role) {
        self.0.push(TensorSpec { key, shape, role });
    }

    /// Adds factors, whose results are sums of `fan_in` products.
    pub fn weight(&mut self, key: &str, shape: Vec<usize>, fan_in: usize) {
        self.push(key.into(), shape, Role::Weight { fan_in });
    }

    /// Adds a linear layer, `[outputs, inputs]`.
    pub fn linear(&mut self, key: &str, inputs: usize, outputs: usize, bias: bool) {
        self.weight(&format!("{key}.weight"), vec![outputs, inputs], inputs);
        if bias {
            self.push(format!("{key}.bias"), vec![outputs], Role::Bias);
        }
    }

    /// Adds a norm.
    pub fn norm(&mut self, key: &str, channels: usize) {
        self.push(format!("{key}.weight"), vec![channels], Role::NormWeight);
        self.push(format!("{key}.bias"), vec![channels], Role::NormBias);
    }
}

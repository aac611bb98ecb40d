use std::io;
use std::path::PathBuf;

use realo_logs::LogError;
use realo_nn::model::ModelError;
use realo_nn::weights::WeightsError;

use crate::data::LeftOut;

/// Why there is no training, or no more of it. What was saved before stays.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A file cannot be read.
    #[error("cannot read `{}`: {error}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// A file cannot be written.
    #[error(
        "cannot write `{}`: {error}; nothing of it was left, and a file that was there before stays as it was: {}",
        path.display(),
        remedy(error)
    )]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// A file of training data is damaged.
    #[error("`{}` is no frame of training data: {reason}; remove it and it will be made again", path.display())]
    Cache {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A checkpoint that does not fit.
    #[error("checkpoint `{}`: {reason}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// Expected and found.
        reason: String,
    },
    /// A folder in which another training is at work.
    #[error("another training writes into `{}`: wait for its end, or choose another --out", folder.display())]
    Busy {
        /// The folder.
        folder: PathBuf,
    },
    /// A file that would be overwritten.
    #[error("`{}` is there already; --force replaces it", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// Options that cannot be met.
    #[error("training option `{field}`: expected {expected}, found {found}")]
    Option {
        /// The option.
        field: &'static str,
        /// What it takes.
        expected: &'static str,
        /// What came.
        found: String,
    },
    /// A model that training has no data for.
    #[error("model `{model}` does not go with the training data: {reason}")]
    Model {
        /// Its name.
        model: String,
        /// Why.
        reason: String,
    },
    /// A model whose weights cannot be begun with.
    #[error(
        "`{}` makes other maps than `{model}`: {differences}; name a model file that `{model}` extends, or one with the \
         same layers",
        from.display()
    )]
    OtherMaps {
        /// The model that is trained.
        model: String,
        /// The file of the other.
        from: PathBuf,
        /// What differs.
        differences: String,
    },
    /// A class without a single object.
    #[error(
        "class `{class}` does not appear in the training data ({frames} frames were looked at); it cannot be learnt"
    )]
    AbsentClass {
        /// The class.
        class: String,
        /// Frames that were searched.
        frames: usize,
    },
    /// A log without ground truth.
    #[error("`{}` has no ground truth of agent `{agent}`: nothing can be learnt from it; simulate or import a log with labels", path.display())]
    NoTruth {
        /// The log.
        path: PathBuf,
        /// The agent.
        agent: String,
    },
    /// Logs of which all is left out.
    #[error("no frame is left of {}:{}", listed(logs), reasons(left_out))]
    NoFrames {
        /// The logs.
        logs: Vec<PathBuf>,
        /// Why.
        left_out: Vec<LeftOut>,
    },
    /// A log whose classes are not known.
    #[error("`{}`: {error}; import or simulate it again with a protocol that is known", path.display())]
    Protocol {
        /// The log.
        path: PathBuf,
        /// What is wrong with its protocol.
        error: realo_scoring::ProtocolError,
    },
    /// The loss, the gradient or a weight is no number any more.
    #[error("diverged at step {step}, loss {loss}; {}", after_diverging(*saved))]
    Diverged {
        /// The step.
        step: u64,
        /// The loss.
        loss: f64,
        /// Whether there is a checkpoint of a step before.
        saved: bool,
    },
    /// A thread that prepares samples has ended without a word.
    #[error("the threads that prepare samples have stopped")]
    Stopped,
    /// The model file.
    #[error(transparent)]
    ModelFile(#[from] ModelError),
    /// The file of weights.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// What runs the weights.
    #[error(transparent)]
    Network(#[from] realo_methods::network::NetworkError),
    /// What loads model and weights.
    #[error(transparent)]
    Load(#[from] realo_methods::LoadError),
    /// A log.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The simulator.
    #[error(transparent)]
    Simulation(#[from] realo_simulator::Error),
    /// A layer.
    #[error("layer: {0}")]
    Layer(#[from] candle_core::Error),
}

fn listed(logs: &[PathBuf]) -> String {
    let names: Vec<String> = logs.iter().map(|log| format!("`{}`", log.display())).collect();
    names.join(", ")
}

/// A line each.
fn reasons(left_out: &[LeftOut]) -> String {
    left_out.iter().map(|reason| format!("\n  {reason}")).collect()
}

/// What to do after a training that diverged.
fn after_diverging(saved: bool) -> &'static str {
    match saved {
        true => "the checkpoint before is unharmed: --resume goes on from it, with a lower --rate",
        false => {
            "no checkpoint was written before it: begin again with a lower --rate, and see by `realo info` whether the poses and boxes \
             of logs are what they should be"
        }
    }
}

/// What to do where a file cannot be written.
fn remedy(error: &io::Error) -> &'static str {
    use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    match error.kind() {
        StorageFull | QuotaExceeded | FileTooLarge => {
            "free space there, then --resume goes on from the last checkpoint; or choose other folders (--out, --cache)"
        }
        _ => "choose another folder (--out, --cache)",
    }
}

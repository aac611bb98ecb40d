//! Why there is no model.

use std::path::PathBuf;

use crate::bounded::ReadError;

/// Why there is no model.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The file cannot be read.
    #[error("{}: {error}", path.display())]
    Read {
        /// The model file.
        path: PathBuf,
        /// What failed.
        error: ReadError,
    },
    /// A file of weights in place of a model file.
    #[error("{}: expected a model file (.toml), found weights; {mend}", path.display())]
    Weights {
        /// The file.
        path: PathBuf,
        /// What to give instead.
        mend: String,
    },
    /// It is not a model file.
    #[error("{}: {error}", path.display())]
    Syntax {
        /// The model file.
        path: PathBuf,
        /// Where and why.
        error: Box<toml::de::Error>,
    },
    /// What it extends.
    #[error("{}: `extends`: {reason}", path.display())]
    Extends {
        /// The model file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// It looks at points in a frame that nobody can bring them to.
    #[error(
        "{}: `lidar_height`: expected metres, found none: sweeps reach the network in the agent's body frame, on the ground; \
         say how far above it the LiDAR stood, or take a model of `frame = \"body\"`",
        path.display()
    )]
    Frame {
        /// The model file.
        path: PathBuf,
    },
    /// The model of a file.
    #[error("{}: {error}", path.display())]
    File {
        /// The model file.
        path: PathBuf,
        /// What is wrong with it.
        error: Box<ModelError>,
    },
    /// It describes no network that can be built.
    #[error("model `{name}` does not fit together: {}", problems.join("; "))]
    Invalid {
        /// The model's name.
        name: String,
        /// Everything that was found.
        problems: Vec<String>,
    },
}

//! Why a sensor's file cannot be.

/// A sensor that cannot be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SensorError {
    /// No built-in sensor has the name.
    #[error("no sensor `{name}`; there are {known}, or the path of a file that ends in .toml")]
    Unknown {
        /// The name that came.
        name: String,
        /// Names that there are.
        known: String,
    },
    /// A file that cannot be read.
    #[error("{path}: {reason}")]
    Unreadable {
        /// The file.
        path: String,
        /// Why.
        reason: String,
    },
    /// A file that says what no sensor can be.
    #[error("{path}: `{field}`: expected {expected}, found {found}")]
    Field {
        /// The file.
        path: String,
        /// The field.
        field: String,
        /// What it takes.
        expected: String,
        /// What came.
        found: String,
    },
}

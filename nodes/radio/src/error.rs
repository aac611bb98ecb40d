use std::path::PathBuf;

use realo_schemas::Kind;

use crate::keys::{KeyError, NAME};

/// Why a radio cannot be, or does not send something.
#[derive(Debug, thiserror::Error)]
pub enum RadioError {
    /// A name that no agent can have.
    #[error("setting `agent`: expected {NAME}, found `{0}`")]
    Agent(String),
    /// A site that is not one.
    #[error("setting `site`: expected names with / between them, each {NAME}, found `{0}`")]
    Site(String),
    /// No address.
    #[error(
        "settings `listen`, `connect`: expected an address in one of them at least, such as listen=tcp/0.0.0.0:7447; \
         found none, and so nobody to exchange packets with"
    )]
    Nobody,
    /// Two addresses that need one port.
    #[error(
        "setting `listen`: expected ports of their own for each, which takes the one behind it too, found {first} and {second}"
    )]
    Ports {
        /// One.
        first: String,
        /// The other.
        second: String,
    },
    /// A key without those that are trusted, or the other way round.
    #[error(
        "setting `{missing}`: expected a file, for `{given}` has one: who signs must know whom to trust, and the other way round"
    )]
    HalfSealed {
        /// The setting that has a file.
        given: &'static str,
        /// The setting that has none.
        missing: &'static str,
    },
    /// A file of keys that cannot be used.
    #[error("setting `{setting}`: {error}")]
    Keys {
        /// The setting.
        setting: &'static str,
        /// Why.
        #[source]
        error: KeyError,
    },
    /// The key of another agent.
    #[error("setting `key`: {}: expected the key of `{agent}` (setting `agent`), found that of `{found}`", .file.display())]
    OtherKey {
        /// Its file.
        file: PathBuf,
        /// Who this is.
        agent: String,
        /// Whose key it is.
        found: String,
    },
    /// A packet of something that does not cross.
    #[error("a packet of {0}, which no link carries")]
    Kind(Kind),
}

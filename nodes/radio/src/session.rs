//! Sessions of Zenoh as the radio wants them.

use std::path::{Path, PathBuf};
use std::time::Duration;

use realo_schemas::{Name, Nanos};
use serde_json::Value;
use zenoh::{Session, Wait};

use crate::endpoint::Endpoint;
use crate::station::MOST_BYTES;

/// Settings that are the radio's, as Zenoh names them.
const OURS: [&str; 4] = ["mode", "listen", "connect", "scouting"];

/// What fails between agents.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// Zenoh does not do it.
    #[error("{what}: {reason}; {mend}")]
    Zenoh {
        /// What was tried.
        what: String,
        /// What zenoh says.
        reason: String,
        /// The next thing to try.
        mend: &'static str,
    },
    /// A file of settings that is none.
    #[error("setting `zenoh`: {path}: {reason}")]
    Settings {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

/// Where and as whom an agent takes part.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// First part of all keys.
    pub site: String,
    /// Who this is.
    pub agent: Name,
    /// Where others connect to this agent.
    pub listen: Vec<Endpoint>,
    /// Whom it connects to.
    pub connect: Vec<Endpoint>,
    /// A peer of whom nothing was heard for so long has gone.
    pub lease: Duration,
    /// A file of further settings of Zenoh; empty for none.
    pub zenoh: PathBuf,
    /// What this machine's wall clock is off by at most, ns; `None`: what the kernel says.
    pub clock_error: Option<Nanos>,
}

impl Default for Place {
    fn default() -> Self {
        Place {
            site: "realo".into(),
            agent: Name::default(),
            listen: Vec::new(),
            connect: Vec::new(),
            lease: Duration::from_secs(2),
            zenoh: PathBuf::new(),
            clock_error: None,
        }
    }
}

pub(crate) fn zenoh_error(what: impl Into<String>, error: &dyn std::fmt::Display) -> NetworkError {
    NetworkError::Zenoh {
        what: what.into(),
        reason: without_places(&error.to_string()),
        mend: "look whether the address is this machine's and the ports are free",
    }
}

/// An error of zenoh without the places in its sources.
fn without_places(error: &str) -> String {
    let mut kept: Vec<String> = Vec::new();
    for word in error.split(' ') {
        if word.contains(".rs:") && kept.last().is_some_and(|before| before == "at") {
            kept.pop();
            if let Some(last) = kept.last_mut().filter(|_| word.contains(']')) {
                last.push(']');
            }
        } else {
            kept.push(word.into());
        }
    }
    kept.join(" ")
}

/// A session at the addresses, `after` ports behind them.
pub(crate) fn open(place: &Place, after: u16) -> Result<Session, NetworkError> {
    let texts = |endpoints: &[Endpoint]| -> Vec<String> { endpoints.iter().map(|known| known.text(after)).collect() };
    let (listen, connect) = (texts(&place.listen), texts(&place.connect));
    let what = format!("listen on [{}], connect to [{}]", listen.join(", "), connect.join(", "));
    let lease = place.lease.as_millis();
    let config = serde_json::json!({
        "mode": "peer",
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "listen": { "endpoints": listen, "exit_on_failure": true },
        "connect": {
            "endpoints": connect,
            "timeout_ms": -1,
            "exit_on_failure": false,
            "retry": { "period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5 },
        },
        // Two agents on one machine would measure its memory instead of their link.
        "transport": {
            "link": { "tx": { "lease": lease, "keep_alive": 4 }, "rx": { "max_message_size": MOST_BYTES } },
            "shared_memory": { "enabled": false },
        },
    });
    let mut config = zenoh::Config::from_json5(&config.to_string()).map_err(|error| zenoh_error(&*what, &error))?;
    if !place.zenoh.as_os_str().is_empty() {
        add(&mut config, &place.zenoh)?;
    }
    zenoh::open(config).wait().map_err(|error| zenoh_error(what, &error))
}

/// Looks whether a file has settings of Zenoh.
pub(crate) fn examine(path: &Path) -> Result<(), NetworkError> {
    add(&mut zenoh::Config::default(), path)
}

/// Puts the settings of a file over those that are there.
fn add(config: &mut zenoh::Config, path: &Path) -> Result<(), NetworkError> {
    let wrong = |reason: String| NetworkError::Settings {
        path: path.into(),
        reason,
    };
    let text = realo_documents::read(path).map_err(|error| wrong(error.to_string()))?;
    let settings: Value = realo_documents::yaml(&text).map_err(wrong)?;
    let Value::Object(settings) = settings else {
        return Err(wrong("expected settings of Zenoh by their names".into()));
    };
    if let Some(ours) = OURS.iter().find(|ours| settings.contains_key(**ours)) {
        return Err(wrong(format!(
            "`{ours}`: expected what the radio has no setting for; use `listen`, `connect` of `v2x`"
        )));
    }
    for (name, value) in &settings {
        insert(config, name, value).map_err(|(name, reason)| wrong(format!("`{name}`: {reason}")))?;
    }
    Ok(())
}

/// Sets what a name stands for, entry by entry, so that what is not named stays; an access control is one thing.
fn insert(config: &mut zenoh::Config, name: &str, value: &Value) -> Result<(), (String, String)> {
    match value {
        Value::Object(entries) if name != "access_control" => {
            let mut entries = entries.iter();
            entries.try_for_each(|(entry, value)| insert(config, &format!("{name}/{entry}"), value))
        }
        _ => config
            .insert_json5(name, &value.to_string())
            .map_err(|error| (name.to_string(), error.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_name_no_place_in_sources() {
        let said = "cannot listen: [tcp/127.0.0.1:7447: Address in use (os error 98) at /home/me/.cargo/zenoh-1/src/unicast.rs:362.] \
                    at /home/me/.cargo/zenoh-1/src/lib.rs:12. It is at 7447.";
        let expected = "cannot listen: [tcp/127.0.0.1:7447: Address in use (os error 98)] It is at 7447.";
        assert_eq!(without_places(said), expected);
    }
}

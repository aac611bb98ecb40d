//! Keys of agents, in files.
//!
//! A private key, `cav1.key`, which only its owner may read:
//!
//! ```toml
//! agent = "cav1"
//! private = "ed25519:9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60"
//! ```
//!
//! A list of the agents that are trusted, one of which is what `cav1.pub` holds:
//!
//! ```toml
//! [agents]
//! cav1 = "ed25519:d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a"
//! ```

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use ed25519_dalek::{SigningKey, VerifyingKey};
use realo_schemas::Name;
use serde::{Deserialize, Serialize};

/// Before the hexadecimal digits of a key.
const ALGORITHM: &str = "ed25519:";

/// A file of keys that cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The file system does not give or take it.
    #[error("{path}: {error}; {mend}")]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        error: std::io::Error,
        /// The next thing to try.
        mend: &'static str,
    },
    /// It holds something else.
    #[error("{path}: {field}: expected {expected}, found {found}; `realo keys new AGENT` makes keys")]
    Content {
        /// The file.
        path: PathBuf,
        /// Where in it.
        field: String,
        /// What should be there.
        expected: &'static str,
        /// What is there.
        found: String,
    },
    /// Others may read a private key.
    #[error(
        "{0}: others than its owner may read this private key (mode {1:o}); `chmod 600` it, or make a new one if they may have"
    )]
    Readable(PathBuf, u32),
    /// A public key in the place of a private one.
    #[error("{0}: expected a private key, found public ones; the private key of an agent is {1}, on its own machine")]
    Public(PathBuf, PathBuf),
    /// A list has another key of the agent.
    #[error("{list}: it has another key of {agent}; take that line out if {agent} has a new key indeed")]
    Other {
        /// The list.
        list: PathBuf,
        /// Whose.
        agent: Name,
    },
    /// No name of an agent.
    #[error("an agent: expected {NAME}, found `{0}`")]
    Agent(String),
    /// The system has no random numbers.
    #[error("random numbers of the system: {0}")]
    Random(getrandom::Error),
}

/// An agent's own key.
pub struct Own {
    /// Whose.
    pub agent: Name,
    /// It.
    pub key: SigningKey,
}

/// The agents that are trusted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trusted(pub BTreeMap<Name, VerifyingKey>);

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OwnFile {
    agent: String,
    private: String,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ListFile {
    agents: BTreeMap<String, String>,
}

/// What [`is_name`] asks for.
pub const NAME: &str = "a name without blanks / * $ ? #, and no dot at its beginning";

/// Whether a text may be the name of an agent: it is a part of keys on the network, and of the names of files.
pub fn is_name(text: &str) -> bool {
    let is_other = |c: char| c.is_whitespace() || c.is_control() || ['/', '*', '$', '?', '#'].contains(&c);
    !text.is_empty() && !text.starts_with('.') && !text.chars().any(is_other)
}

impl Own {
    /// A new key.
    ///
    /// # Errors
    /// No name, or no random numbers.
    pub fn new(agent: &str) -> Result<Own, KeyError> {
        if !is_name(agent) {
            return Err(KeyError::Agent(agent.into()));
        }
        let mut secret = [0; 32];
        getrandom::fill(&mut secret).map_err(KeyError::Random)?;
        Ok(Own {
            agent: agent.into(),
            key: SigningKey::from_bytes(&secret),
        })
    }

    /// What others need to trust it.
    pub fn public(&self) -> Trusted {
        Trusted([(self.agent.clone(), self.key.verifying_key())].into())
    }

    /// Writes it to a new file that only its owner may read.
    ///
    /// # Errors
    /// The file is there, or cannot be made.
    pub fn write(&self, path: &Path) -> Result<(), KeyError> {
        let text = toml::to_string(&OwnFile {
            agent: self.agent.to_string(),
            private: in_text(self.key.as_bytes()),
        });
        let mut options = OpenOptions::new();
        options.write(true).create_new(true);
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        let refused = |mend| {
            move |error| KeyError::File {
                path: path.into(),
                error,
                mend,
            }
        };
        let mut file = options.open(path).map_err(|error| match error.kind() {
            ErrorKind::AlreadyExists => {
                refused("a key that is there stays: name another folder, or move it away")(error)
            }
            _ => refused("name a folder that is there and may be written to")(error),
        })?;
        // A part of a key would keep the next one from being made.
        let written = file
            .write_all(text.expect("two texts").as_bytes())
            .and_then(|()| file.sync_all());
        written.map_err(|error| {
            let _ = fs::remove_file(path);
            refused("nothing was left there: make room, or name another folder")(error)
        })
    }

    /// Reads it.
    ///
    /// # Errors
    /// [`KeyError`], also for a file that others may read.
    pub fn read(path: &Path) -> Result<Own, KeyError> {
        let text = read(path)?;
        if Trusted::parse(&text, path).is_ok() {
            return Err(KeyError::Public(path.into(), path.with_extension("key")));
        }
        #[cfg(unix)]
        if let Ok(known) = fs::metadata(path) {
            let mode = std::os::unix::fs::PermissionsExt::mode(&known.permissions()) & 0o777;
            if mode & 0o077 != 0 {
                return Err(KeyError::Readable(path.into(), mode));
            }
        }
        // What such a file holds is never shown.
        let wrong = |field: &str, expected| KeyError::Content {
            path: path.into(),
            field: field.into(),
            expected,
            found: "something else".into(),
        };
        let file: OwnFile =
            toml::from_str(&text).map_err(|_| wrong("private key", "`agent` and `private`, two texts"))?;
        if !is_name(&file.agent) {
            return Err(wrong("agent", NAME));
        }
        let secret = of_text(&file.private).ok_or_else(|| wrong("private", KEY))?;
        Ok(Own {
            agent: file.agent.into(),
            key: SigningKey::from_bytes(&secret),
        })
    }
}

/// What a key looks like.
const KEY: &str = "`ed25519:` and 64 hexadecimal digits";

impl Trusted {
    /// Reads a list.
    ///
    /// # Errors
    /// [`KeyError`].
    pub fn read(path: &Path) -> Result<Trusted, KeyError> {
        Trusted::parse(&read(path)?, path)
    }

    /// The list that a file holds.
    ///
    /// # Errors
    /// [`KeyError::Content`].
    pub fn parse(text: &str, path: &Path) -> Result<Trusted, KeyError> {
        let wrong = |field: String, expected, found: String| KeyError::Content {
            path: path.into(),
            field,
            expected,
            found,
        };
        let file: ListFile = toml::from_str(text)
            .map_err(|error| wrong("list".into(), "[agents] with a key each", error.message().into()))?;
        let mut trusted = BTreeMap::new();
        for (agent, text) in file.agents {
            if !is_name(&agent) {
                return Err(wrong("agents".into(), NAME, format!("`{agent}`")));
            }
            let key = of_text(&text).and_then(|bytes| VerifyingKey::from_bytes(&bytes).ok());
            // A weak key fits signatures that nobody made.
            let key = key.filter(|key| !key.is_weak());
            let key = key.ok_or_else(|| wrong(format!("agents.{agent}"), KEY, format!("`{text}`")))?;
            trusted.insert(agent.into(), key);
        }
        Ok(Trusted(trusted))
    }

    /// Takes the agents of a list that was read from `from` too.
    ///
    /// # Errors
    /// [`KeyError::Other`], and nothing is taken.
    pub fn join(&mut self, more: &Trusted, list: &Path) -> Result<(), KeyError> {
        let differs = |(agent, key): &(&Name, &VerifyingKey)| self.0.get(*agent).is_some_and(|known| known != *key);
        if let Some((agent, _)) = more.0.iter().find(differs) {
            return Err(KeyError::Other {
                list: list.into(),
                agent: agent.clone(),
            });
        }
        self.0.extend(more.0.iter().map(|(agent, key)| (agent.clone(), *key)));
        Ok(())
    }

    /// Writes the list; what was there is there until the new one is whole.
    ///
    /// # Errors
    /// The file system's.
    pub fn write(&self, path: &Path) -> Result<(), KeyError> {
        let agents = self.0.iter();
        let text = toml::to_string(&ListFile {
            agents: agents
                .map(|(agent, key)| (agent.to_string(), in_text(key.as_bytes())))
                .collect(),
        });
        let whole = path.with_added_extension("new");
        let written = fs::write(&whole, text.expect("texts under texts")).and_then(|()| fs::rename(&whole, path));
        written.map_err(|error| {
            let _ = fs::remove_file(&whole);
            KeyError::File {
                path: path.into(),
                error,
                mend: "name a folder that is there and may be written to",
            }
        })
    }
}

fn read(path: &Path) -> Result<String, KeyError> {
    fs::read_to_string(path).map_err(|error| KeyError::File {
        path: path.into(),
        error,
        mend: "`realo keys new` makes keys, `realo keys trust` lists of them",
    })
}

fn in_text(bytes: &[u8; 32]) -> String {
    bytes.iter().fold(ALGORITHM.to_string(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn of_text(text: &str) -> Option<[u8; 32]> {
    let digits = text.strip_prefix(ALGORITHM)?.as_bytes();
    let mut bytes = [0; 32];
    if digits.len() != 64 {
        return None;
    }
    for (byte, pair) in bytes.iter_mut().zip(digits.chunks(2)) {
        let digit = |of: u8| char::from(of).to_digit(16);
        *byte = (digit(pair[0])? << 4 | digit(pair[1])?) as u8;
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// RFC 8032, section 7.1, test 1.
    const RFC: [&str; 2] = [
        "ed25519:9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
        "ed25519:d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
    ];

    fn folder() -> tempfile::TempDir {
        tempfile::tempdir().expect("a folder")
    }

    fn private(path: &Path, text: &str) {
        fs::write(path, text).unwrap();
        fs::set_permissions(path, std::os::unix::fs::PermissionsExt::from_mode(0o600)).unwrap();
    }

    #[test]
    fn keys_come_back_from_their_files() {
        let folder = folder();
        let (own, list) = (folder.path().join("cav1.key"), folder.path().join("list.toml"));
        let made = Own::new("cav1").unwrap();
        made.write(&own).unwrap();
        let read = Own::read(&own).unwrap();
        assert_eq!((&read.agent, read.key.as_bytes()), (&made.agent, made.key.as_bytes()));
        made.public().write(&list).unwrap();
        let error = Own::read(&list).map(|_| ()).unwrap_err().to_string();
        assert!(
            error.contains("list.toml: expected a private key, found public ones") && error.contains("list.key"),
            "{error}"
        );
        let mut known = Trusted::read(&list).unwrap();
        assert_eq!(known, made.public());
        known.join(&Own::new("rsu1").unwrap().public(), &list).unwrap();
        assert_eq!(known.0.len(), 2);
        let error = known.join(&Own::new("cav1").unwrap().public(), &list).unwrap_err();
        assert!(error.to_string().contains("another key of cav1"), "{error}");
        let error = made.write(&own).unwrap_err().to_string();
        assert!(error.contains("stays"), "{error}");
    }

    #[test]
    fn a_known_private_key_has_its_public_one() {
        let (folder, secret) = (folder(), RFC[0]);
        let path = folder.path().join("known.key");
        private(&path, &format!("agent = \"a\"\nprivate = \"{secret}\"\n"));
        let public = Own::read(&path).unwrap().public();
        assert_eq!(in_text(public.0["a"].as_bytes()), RFC[1]);
    }

    #[test]
    fn what_is_no_key_is_reported_without_showing_a_private_one() {
        let folder = folder();
        let path = folder.path().join("bad.key");
        for (text, names) in [
            ("", "private key"),
            ("agent = \"a\"\nprivate = \"secret\"", "private: expected `ed25519:`"),
            ("agent = \"a/b\"\nprivate = \"secret\"", "agent: expected a name"),
            ("agent = \"a\"\nprivate = \"secret\"\nmore = 1", "private key"),
        ] {
            private(&path, text);
            let error = Own::read(&path).map(|_| ()).unwrap_err().to_string();
            assert!(
                error.contains("bad.key") && error.contains(names) && !error.contains("secret"),
                "{error}"
            );
        }
        fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o644)).unwrap();
        let error = Own::read(&path).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("644") && error.contains("chmod"), "{error}");
        let weak = format!("ed25519:{}", "0".repeat(64));
        for (text, names) in [
            ("", "[agents]"),
            ("[agents]\na = 1", "[agents]"),
            ("[agents]\n\"a*\" = \"x\"", "`a*`"),
            (
                "[agents]\na = \"ed25519:12\"",
                "agents.a: expected `ed25519:` and 64 hexadecimal digits, found `ed25519:12`",
            ),
            (&format!("[agents]\na = \"{weak}\""), "agents.a"),
        ] {
            let list = folder.path().join("list.toml");
            fs::write(&list, text).unwrap();
            let error = Trusted::read(&list).unwrap_err().to_string();
            assert!(error.contains("list.toml") && error.contains(names), "{error}");
        }
        let error = Trusted::read(&folder.path().join("none.toml")).unwrap_err().to_string();
        assert!(error.contains("realo keys"), "{error}");
    }

    #[test]
    fn names_can_be_parts_of_keys_and_names_of_files() {
        for name in ["cav1", "rsu-1", "a.b", "Straße_7"] {
            assert!(is_name(name), "{name}");
        }
        for name in [
            "", ".", "..", ".cav1", "cav 1", " ", "cav1\t", "a/b", "a*", "$a", "a?", "a#",
        ] {
            let error = Own::new(name).map(|_| ()).unwrap_err().to_string();
            assert!(error.contains(&format!("found `{name}`")), "{error}");
        }
    }

    #[test]
    fn what_cannot_be_written_leaves_nothing() {
        let folder = folder();
        let list = folder.path().join("list.pub");
        fs::create_dir(&list).unwrap();
        let error = Own::new("cav1").unwrap().public().write(&list).unwrap_err().to_string();
        assert!(error.contains("list.pub"), "{error}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}

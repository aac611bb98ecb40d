//! What is to be run.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Names the file of a plan.
pub(crate) const SCHEMA: &str = "realo/campaign";
/// Version of the files.
pub(crate) const VERSION: u32 = 1;

/// One run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Item {
    /// Its name and its folder below the plan's: parts joined by `/`.
    pub key: String,
    /// What its result depends on, by name: digests, or short values.
    pub parts: BTreeMap<String, String>,
}

/// An ordered list of runs, and the values that it was made of.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Plan {
    pub(crate) schema: String,
    pub(crate) version: u32,
    /// The command that made it.
    pub command: String,
    /// What was asked for, by name, as `--vary link.delay_ms`; another plan differs in one of them.
    pub values: BTreeMap<String, String>,
    /// The runs.
    pub items: Vec<Item>,
}

/// Runs that make no plan.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// Nothing to run.
    #[error("the plan has no run")]
    Empty,
    /// Two runs would have one folder.
    #[error("two runs of the plan are named `{0}`")]
    Twice(String),
    /// A key that is no folder below another one.
    #[error("`{0}` cannot name a folder: expected parts joined by `/`, none of them empty, `.` or `..`")]
    Key(String),
}

/// The first digits of the SHA-256 of a text, for [`Item::parts`].
pub fn digest(text: &str) -> String {
    let all = Sha256::digest(text.as_bytes());
    all.iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

impl Plan {
    /// A plan of these runs.
    ///
    /// # Errors
    /// [`PlanError`] names the run.
    pub fn new(command: &str, values: BTreeMap<String, String>, items: Vec<Item>) -> Result<Self, PlanError> {
        if items.is_empty() {
            return Err(PlanError::Empty);
        }
        let mut known = BTreeSet::new();
        for item in &items {
            let is_part = |part: &str| !matches!(part, "" | "." | "..");
            if !item.key.split('/').all(is_part) {
                return Err(PlanError::Key(item.key.clone()));
            }
            if !known.insert(&item.key) {
                return Err(PlanError::Twice(item.key.clone()));
            }
        }
        Ok(Plan {
            schema: SCHEMA.into(),
            version: VERSION,
            command: command.into(),
            values,
            items,
        })
    }

    /// In what another plan differs, in words: the first value, else the first run; `None` where both ask for the same.
    pub fn difference(&self, other: &Plan) -> Option<String> {
        if self.command != other.command {
            return Some(format!("command: `{}` here, `{}` there", self.command, other.command));
        }
        let names: BTreeSet<&String> = self.values.keys().chain(other.values.keys()).collect();
        let shown = |value: Option<&String>| value.map_or("nothing".to_string(), |value| format!("`{value}`"));
        for name in names {
            let (here, there) = (self.values.get(name), other.values.get(name));
            if here != there {
                return Some(format!("{name}: {} here, {} there", shown(here), shown(there)));
            }
        }
        let keys = |plan: &Plan| plan.items.iter().map(|item| item.key.clone()).collect::<Vec<_>>();
        let (here, there) = (keys(self), keys(other));
        let at = (0..here.len().max(there.len())).find(|at| here.get(*at) != there.get(*at))?;
        Some(format!(
            "run {}: {} here, {} there",
            at + 1,
            shown(here.get(at)),
            shown(there.get(at))
        ))
    }
}

impl Item {
    /// The first part that differs from what a result was made of, in words.
    pub fn difference(&self, made_of: &BTreeMap<String, String>) -> Option<String> {
        let names: BTreeSet<&String> = self.parts.keys().chain(made_of.keys()).collect();
        let differs = |name: &&&String| self.parts.get(**name) != made_of.get(**name);
        let name = names.iter().find(differs)?;
        let shown = |parts: &BTreeMap<String, String>| parts.get(*name).cloned().unwrap_or_else(|| "nothing".into());
        Some(format!("{name}: {} here, {} there", shown(&self.parts), shown(made_of)))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn item(key: &str, log: &str) -> Item {
        Item {
            key: key.into(),
            parts: BTreeMap::from([("log".into(), digest(log)), ("version".into(), "1".into())]),
        }
    }

    pub(crate) fn plan(delays: &str, keys: &[&str]) -> Plan {
        let values = BTreeMap::from([("--vary link.delay_ms".into(), delays.into())]);
        Plan::new("test", values, keys.iter().map(|key| item(key, "a")).collect()).unwrap()
    }

    #[test]
    fn keys_are_folders_and_there_once() {
        let new = |keys: &[&str]| {
            let items = keys.iter().map(|key| item(key, "a")).collect();
            Plan::new("test", BTreeMap::new(), items).map(|plan| plan.items.len())
        };
        assert_eq!(new(&["a/b", "a/c"]), Ok(2));
        assert_eq!(new(&[]), Err(PlanError::Empty));
        assert_eq!(new(&["a", "b", "a"]), Err(PlanError::Twice("a".into())));
        for key in ["", "/a", "a/../b", "a//b", "."] {
            assert_eq!(new(&[key]), Err(PlanError::Key(key.into())));
        }
    }

    #[test]
    fn a_plan_says_in_what_another_differs() {
        let one = plan("0,50", &["a", "b"]);
        assert_eq!(one.difference(&one.clone()), None);
        let said = |other: &Plan| one.difference(other).unwrap();
        assert_eq!(
            said(&plan("0,100", &["a", "b"])),
            "--vary link.delay_ms: `0,50` here, `0,100` there"
        );
        assert_eq!(said(&plan("0,50", &["a"])), "run 2: `b` here, nothing there");
        let mut other = one.clone();
        other.values.insert("--offline".into(), "true".into());
        assert_eq!(said(&other), "--offline: nothing here, `true` there");
        let changed = item("a", "b").difference(&one.items[0].parts).unwrap();
        assert_eq!(changed, format!("log: {} here, {} there", digest("b"), digest("a")));
        assert_eq!(item("z", "a").difference(&one.items[0].parts), None);
    }
}

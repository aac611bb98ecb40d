//! Typed reading of YAML values, with errors that name the place.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde_yaml::{Mapping, Value};

use super::GraphError;
use super::read::{MAX_ENTRIES, MAX_NAME, MAX_PATH};
use realo_documents::shown;
use realo_operator::config::nearest_name;

/// A place in a file, for messages.
pub(super) struct Place<'a> {
    pub(super) file: &'a Path,
    at: String,
}

impl<'a> Place<'a> {
    pub(super) fn new(file: &'a Path, at: &str) -> Self {
        Place {
            file,
            at: at.to_string(),
        }
    }

    pub(super) fn under(&self, key: &str) -> Place<'a> {
        Place {
            file: self.file,
            at: format!("{}, {}", self.at, shown(key)),
        }
    }

    pub(super) fn wrong(&self, expected: &str, found: String) -> GraphError {
        GraphError::Value {
            file: self.file.into(),
            at: self.at.clone(),
            expected: expected.into(),
            found,
        }
    }

    pub(super) fn expected(&self, expected: &str, found: &Value) -> GraphError {
        self.wrong(expected, describe(found))
    }

    pub(super) fn mapping<'v>(&self, value: &'v Value) -> Result<&'v Mapping, GraphError> {
        value.as_mapping().ok_or_else(|| self.expected("a mapping", value))
    }

    pub(super) fn known_keys(&self, mapping: &Mapping, known: &[&str]) -> Result<(), GraphError> {
        let unknown = mapping
            .keys()
            .find(|key| !key.as_str().is_some_and(|key| known.contains(&key)));
        let Some(key) = unknown else { return Ok(()) };
        let key = key.as_str().map_or_else(|| describe(key), shown);
        Err(GraphError::Key {
            file: self.file.into(),
            at: self.at.clone(),
            nearest: nearest_name(&key, known.iter().copied()),
            key,
            known: known.join(", "),
        })
    }

    pub(super) fn entries<'v>(&self, value: Option<&'v Value>) -> Result<Vec<(&'v str, &'v Value)>, GraphError> {
        let Some(value) = value else { return Ok(Vec::new()) };
        let entries = self.mapping(value)?;
        self.few(entries.len())?;
        let entries = entries.iter();
        let named = entries.map(|(key, value)| match key.as_str() {
            Some(key) => self.short(key, MAX_NAME).map(|()| (key, value)),
            None => Err(self.expected("a name", key)),
        });
        named.collect()
    }

    fn few(&self, count: usize) -> Result<(), GraphError> {
        match count > MAX_ENTRIES {
            true => Err(self.wrong(
                &format!("at most {MAX_ENTRIES} entries (more fit into modules)"),
                format!("{count}"),
            )),
            false => Ok(()),
        }
    }

    fn short(&self, text: &str, most: usize) -> Result<(), GraphError> {
        match text.len() > most {
            true => Err(self.wrong(&format!("at most {most} bytes"), format!("`{}`", shown(text)))),
            false => Ok(()),
        }
    }

    pub(super) fn name(&self, value: &Value) -> Result<String, GraphError> {
        let name = self.text(value)?;
        self.short(&name, MAX_NAME).map(|()| name)
    }

    pub(super) fn optional_path(&self, value: Option<&Value>) -> Result<Option<String>, GraphError> {
        let path = self.optional_text(value)?;
        self.short(path.as_deref().unwrap_or_default(), MAX_PATH).map(|()| path)
    }

    pub(super) fn text(&self, value: &Value) -> Result<String, GraphError> {
        let text = value.as_str().map(str::to_string);
        text.ok_or_else(|| self.expected("a text (quote numbers)", value))
    }

    pub(super) fn optional_text(&self, value: Option<&Value>) -> Result<Option<String>, GraphError> {
        value
            .filter(|value| !value.is_null())
            .map(|value| self.text(value))
            .transpose()
    }

    pub(super) fn texts(&self, value: Option<&Value>) -> Result<BTreeMap<String, String>, GraphError> {
        let entries = self.entries(value)?.into_iter();
        entries
            .map(|(key, value)| Ok((key.to_string(), self.under(key).text(value)?)))
            .collect()
    }

    pub(super) fn names(&self, value: &Value) -> Result<BTreeSet<String>, GraphError> {
        let list = value
            .as_sequence()
            .ok_or_else(|| self.expected("a list of names", value))?;
        self.few(list.len())?;
        let mut names = BTreeSet::new();
        for item in list {
            let name = self.name(item)?;
            if !names.insert(name.clone()) {
                return Err(self.wrong("each name once", format!("`{}` twice", shown(&name))));
            }
        }
        Ok(names)
    }
}

fn describe(value: &Value) -> String {
    match value {
        Value::Null => "nothing".into(),
        Value::Bool(b) => format!("`{b}`"),
        Value::Number(n) => format!("the number {n}"),
        Value::String(s) => format!("`{}`", shown(s)),
        Value::Sequence(_) => "a list".into(),
        Value::Mapping(_) => "a mapping".into(),
        Value::Tagged(tagged) => format!("a value tagged {}", shown(&tagged.tag.to_string())),
    }
}

//! What a model's `arch` may be: a detector of one agent, or a method that fuses.

use std::fmt;
use std::sync::Arc;

use realo_nn::layers::MapSize;
use realo_nn::model::{Architecture, Problems, Sharing};
use realo_nn::tensors::TensorSpec;
use serde::de::{Deserialize, Deserializer, Error};
use serde::ser::{Serialize, SerializeMap, Serializer};

use super::any::AnyMethod;
use super::list::methods;
use crate::method::Method;

/// A model: a description of a network with one of the methods, or none.
pub type Model = realo_nn::model::Model<Arch>;

/// How a model's layers are put together: those of a single agent's detector, with a method of fusion or without.
#[derive(Clone, Debug, Default)]
pub struct Arch(Option<Arc<dyn AnyMethod>>);

/// Pillars, backbone, shrink layers and heads of one agent (PointPillars, Lang et al. 2019, as in V2X-Real).
const ALONE: &str = "pointpillars";

impl Arch {
    /// The method that fuses, if there is one.
    pub fn method(&self) -> Option<&dyn AnyMethod> {
        self.0.as_deref()
    }

    /// The settings of a method, if it is the one that fuses.
    pub fn settings<M: Method>(&self) -> Option<&M> {
        self.method()?.as_any().downcast_ref()
    }

    /// Its name in model files.
    pub fn name(&self) -> &'static str {
        self.method().map_or(ALONE, |method| method.name())
    }

    /// Its name in texts.
    pub fn title(&self) -> &'static str {
        self.method()
            .map_or("The detector of one agent, of early and late fusion", |method| {
                method.title()
            })
    }

    /// Whether maps of several agents become one.
    pub fn fuses(&self) -> bool {
        self.0.is_some()
    }

    /// Agents that a network takes, the ego among them.
    pub fn agents(&self) -> usize {
        self.sharing().map_or(1, |sharing| sharing.agents)
    }

    /// Sets how many times fewer channels cross than the map has, of an architecture that shares maps; 0: all of them cross.
    pub fn set_compression(&mut self, compression: usize) {
        if let Some(method) = &mut self.0 {
            *method = method.with_compression(compression);
        }
    }

    /// V2X-ReaLO, Table III: how long the paper's network of this kind took, ns.
    pub fn paper_inference(&self) -> Option<u64> {
        match self.name() {
            ALONE => Some(43_700_000),
            "fcooper" => Some(61_600_000),
            "attfuse" => Some(68_600_000),
            "v2xvit" => Some(118_200_000),
            _ => None,
        }
    }
}

impl Architecture for Arch {
    fn sharing(&self) -> Option<Sharing> {
        self.method().map(|method| method.sharing())
    }

    fn check(&self, map: MapSize, problems: &mut Problems) {
        if let Some(method) = self.method() {
            method.check(map, problems);
        }
    }

    fn tensors(&self, channels: usize) -> Vec<TensorSpec> {
        self.method().map_or_else(Vec::new, |method| method.tensors(channels))
    }
}

impl<M: Method> From<M> for Arch {
    fn from(method: M) -> Self {
        Arch(Some(Arc::new(method)))
    }
}

impl From<Arc<dyn AnyMethod>> for Arch {
    fn from(method: Arc<dyn AnyMethod>) -> Self {
        Arch(Some(method))
    }
}

impl fmt::Display for Arch {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl PartialEq for Arch {
    fn eq(&self, other: &Self) -> bool {
        match (self.method(), other.method()) {
            (None, None) => true,
            (Some(own), Some(other)) => own.equals(other),
            _ => false,
        }
    }
}

impl Serialize for Arch {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("kind", self.name())?;
        for (key, value) in self.method().map(|method| method.settings()).unwrap_or_default() {
            map.serialize_entry(&key, &value)?;
        }
        map.end()
    }
}

impl<'de> Deserialize<'de> for Arch {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut settings = toml::Table::deserialize(deserializer)?;
        let kind = match settings.remove("kind") {
            Some(toml::Value::String(kind)) => kind,
            Some(other) => return Err(D::Error::custom(format!("`kind`: expected a name, found {other}"))),
            None => return Err(D::Error::missing_field("kind")),
        };
        if kind == ALONE {
            return match settings.keys().next() {
                None => Ok(Arch::default()),
                Some(key) => Err(D::Error::custom(format!(
                    "unknown field `{key}`, expected none beside `kind`"
                ))),
            };
        }
        let methods = methods();
        let Some(entry) = methods.iter().find(|entry| entry.name == kind) else {
            let known = methods.iter().map(|entry| format!("`{}`", entry.name));
            let known: Vec<String> = std::iter::once(format!("`{ALONE}`")).chain(known).collect();
            let expected = known.join(", ");
            return Err(D::Error::custom(format!(
                "unknown variant `{kind}`, expected one of {expected}"
            )));
        };
        let method = entry
            .read(settings)
            .map_err(|error| D::Error::custom(error.message()))?;
        Ok(Arch(Some(method)))
    }
}

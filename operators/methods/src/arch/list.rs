//! The list of methods.

use std::sync::{Arc, PoisonError, RwLock};

use realo_nn::model::Sharing;
use serde_json::Value;

use super::any::AnyMethod;
use crate::method::Method;
use crate::{attfuse, fcooper, v2vnet, v2xvit};

/// The methods that ship: a line each.
pub const METHODS: &[Entry] = &[
    Entry::of::<fcooper::Settings>(),
    Entry::of::<attfuse::Settings>(),
    Entry::of::<v2xvit::Settings>(),
    Entry::of::<v2vnet::Settings>(),
];

/// A method that model files may name.
#[derive(Clone, Copy, Debug)]
pub struct Entry {
    /// Its name in model files: `arch.kind`.
    pub name: &'static str,
    /// Its name in texts.
    pub title: &'static str,
    /// The class of its network in V2X-Real's code, where there is one.
    pub reference: Option<&'static str>,
    read: fn(toml::Table) -> Result<Arc<dyn AnyMethod>, toml::de::Error>,
    of_reference: fn(&Value, Sharing) -> Option<Result<Arc<dyn AnyMethod>, String>>,
}

impl Entry {
    /// The entry of a method.
    pub const fn of<M: Method>() -> Entry {
        Entry {
            name: M::NAME,
            title: M::TITLE,
            reference: M::REFERENCE,
            read: read::<M>,
            of_reference: of_reference::<M>,
        }
    }

    /// The method of its settings in a model file, without `kind`.
    ///
    /// # Errors
    /// A setting that it has not, or of another type.
    pub fn read(&self, settings: toml::Table) -> Result<Arc<dyn AnyMethod>, toml::de::Error> {
        (self.read)(settings)
    }

    /// See [`Method::of_reference`].
    pub fn of_reference(&self, config: &Value, sharing: Sharing) -> Option<Result<Arc<dyn AnyMethod>, String>> {
        (self.of_reference)(config, sharing)
    }
}

fn read<M: Method>(settings: toml::Table) -> Result<Arc<dyn AnyMethod>, toml::de::Error> {
    let method: M = settings.try_into()?;
    Ok(Arc::new(method))
}

fn of_reference<M: Method>(config: &Value, sharing: Sharing) -> Option<Result<Arc<dyn AnyMethod>, String>> {
    let method = M::of_reference(config, sharing)?;
    Some(method.map(|method| Arc::new(method) as Arc<dyn AnyMethod>))
}

static ADDED: RwLock<Vec<Entry>> = RwLock::new(Vec::new());

/// Makes a method known that does not ship: what a program with a method of its own says first. One of the same name that was
/// added before is replaced.
pub fn add(entry: Entry) {
    let mut added = ADDED.write().unwrap_or_else(PoisonError::into_inner);
    added.retain(|known| known.name != entry.name);
    added.push(entry);
}

/// All methods: those that ship, then those that were added.
pub fn methods() -> Vec<Entry> {
    let added = ADDED.read().unwrap_or_else(PoisonError::into_inner);
    METHODS.iter().chain(&*added).copied().collect()
}

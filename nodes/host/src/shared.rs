//! What runs in virtual time have in common: calls of stages that one run makes and the others repeat.
//!
//! A stage's calls follow from its settings, its inputs and the compute profile. Where these and all that is upstream are the
//! same in several runs, so is every call. [`Shared::plan`] finds such stages. The first run that has one records its calls, the
//! others take them from there: such a stage is not even built. Payloads are kept only where a stage that computes will need
//! them. Stages that touch the world outside, sinks and plug-ins, compute in every run, and so does what is downstream of a
//! plug-in.

mod recording;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use realo_engine::{Feed, Wiring};
use realo_operator::{PortId, Role};

use crate::{ComputeProfile, Stages};
use recording::Recording;
pub(crate) use recording::{Recorder, Serving, mark_of};

/// What a stage and all upstream of it are; equal keys make equal calls.
type Key = usize;

/// A run, as far as sharing needs it.
#[derive(Clone, Debug, PartialEq)]
pub struct Outline {
    /// By stage; `None` for one that computes in every run.
    keys: Vec<Option<Key>>,
    /// By stage: the outputs that feed it.
    feeds: Vec<Vec<(usize, PortId)>>,
}

impl Outline {
    /// By what runs are ordered: those that have more in common are neighbours, so that what is recorded is soon let go.
    pub fn order(&self) -> &[Option<usize>] {
        &self.keys
    }
}

/// How much was shared.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Sharing {
    /// Stages that runs took from others, over all runs.
    pub repeated: usize,
    /// Stages that computed, over all runs, without sinks.
    pub computed: usize,
    /// The most memory that recorded calls held, bytes.
    pub held_most: u64,
    /// Stages whose calls, or the payloads in them, did not fit into the memory, by id.
    pub too_large: BTreeSet<String>,
}

/// What several runs have in common.
pub struct Shared {
    /// Bytes that recorded calls may hold.
    limit: u64,
    store: Mutex<Store>,
}

#[derive(Default)]
struct Store {
    /// The keys by what they stand for.
    names: BTreeMap<String, Key>,
    wants: BTreeMap<Key, Want>,
    known: BTreeMap<Key, Arc<Recording>>,
    held: u64,
    sharing: Sharing,
}

/// What the runs that are still to come want of a stage.
#[derive(Default)]
struct Want {
    runs: usize,
    /// Outputs whose payloads some of them need.
    whole: BTreeSet<PortId>,
}

impl Shared {
    /// Nothing yet; `limit` bounds what is kept, bytes.
    pub fn new(limit: u64) -> Self {
        Shared {
            limit,
            store: Mutex::default(),
        }
    }

    fn store(&self) -> MutexGuard<'_, Store> {
        // What a run that panicked left is whole: recordings are added at once.
        self.store.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The outline of a run.
    pub fn outline(&self, stages: &Stages, compute: &ComputeProfile) -> Outline {
        let mut store = self.store();
        let mut keys: Vec<Option<Key>> = Vec::new();
        for (index, stage) in stages.wiring.stages.iter().enumerate() {
            let text = match stage.registration.role {
                // A call that is repeated cannot be measured.
                Role::Operator | Role::Source if !compute.measured => stages.arguments(index),
                _ => None,
            };
            let upstream = stage.inputs.iter().map(|feed| match feed {
                None => Some("-".to_string()),
                Some(Feed::Outside) => None,
                // What is fed back comes of a later stage: around a circle every run computes.
                Some(Feed::Stage(from, PortId(port))) => {
                    keys.get(*from).copied().flatten().map(|key| format!("{key}.{port}"))
                }
            });
            let upstream: Option<Vec<String>> = upstream.collect();
            let name = text.zip(upstream).map(|(arguments, upstream)| {
                format!(
                    "{:?}",
                    (&stage.id, stage.registration.name, arguments, upstream, &compute.nanos)
                )
            });
            let next = store.names.len();
            keys.push(name.map(|name| *store.names.entry(name).or_insert(next)));
        }
        let feeds = stages.wiring.stages.iter().map(|stage| {
            let feed = |feed: &Option<Feed>| match feed {
                Some(Feed::Stage(from, port)) => Some((*from, *port)),
                _ => None,
            };
            stage.inputs.iter().filter_map(feed).collect()
        });
        Outline {
            keys,
            feeds: feeds.collect(),
        }
    }

    /// Plans runs in this order. Gives for each the earlier ones that have to end before it starts, because it takes calls from
    /// them.
    pub fn plan(&self, runs: &[Outline]) -> Vec<BTreeSet<usize>> {
        let mut store = self.store();
        store.wants.clear();
        let mut first: BTreeMap<Key, usize> = BTreeMap::new();
        let mut all = Vec::new();
        for (number, run) in runs.iter().enumerate() {
            let repeats = |stage: usize| run.keys[stage].filter(|key| first.contains_key(key));
            for stage in (0..run.keys.len()).filter(|stage| repeats(*stage).is_none()) {
                for (from, port) in &run.feeds[stage] {
                    if let Some(key) = repeats(*from) {
                        store.wants.entry(key).or_default().whole.insert(*port);
                    }
                }
            }
            let keys = || run.keys.iter().flatten();
            all.push(keys().filter_map(|key| first.get(key).copied()).collect());
            for key in keys() {
                store.wants.entry(*key).or_default().runs += 1;
                first.entry(*key).or_insert(number);
            }
        }
        all
    }

    /// How much was shared so far.
    pub fn sharing(&self) -> Sharing {
        self.store().sharing.clone()
    }

    /// How each stage of a run is served.
    pub(crate) fn begin(&self, wiring: &Wiring, run: &Outline) -> Vec<Serving> {
        let mut store = self.store();
        let mut serving: Vec<Option<Serving>> = run.keys.iter().map(|_| None).collect();
        // Consumers first: what computes needs the payloads of what feeds it.
        for stage in (0..run.keys.len()).rev() {
            let computes = |to: usize| !matches!(serving[to], Some(Serving::Repeat(..)));
            let consumers = (stage + 1..run.keys.len()).filter(|to| computes(*to));
            let needed: BTreeSet<PortId> = consumers
                .flat_map(|to| &run.feeds[to])
                .filter(|(from, _)| *from == stage)
                .map(|(_, port)| *port)
                .collect();
            let recording = run.keys[stage].and_then(|key| store.known.get(&key));
            serving[stage] = Some(match recording.filter(|known| known.has(&needed)) {
                Some(recording) => Serving::Repeat(recording.clone(), 0),
                None => store.record(run.keys[stage]),
            });
        }
        let serving: Vec<Serving> = serving.into_iter().flatten().collect();
        let repeated = serving.iter().filter(|one| matches!(one, Serving::Repeat(..))).count();
        let sinks = wiring
            .stages
            .iter()
            .filter(|stage| stage.registration.role == Role::Sink);
        store.sharing.repeated += repeated;
        store.sharing.computed += serving.len() - repeated - sinks.count();
        serving
    }

    /// Takes bytes for recorded calls; `false` where there is no room.
    pub(crate) fn reserve(&self, stage: &str, bytes: u64) -> bool {
        let mut store = self.store();
        if store.held + bytes > self.limit {
            store.sharing.too_large.insert(stage.into());
            return false;
        }
        store.held += bytes;
        store.sharing.held_most = store.sharing.held_most.max(store.held);
        true
    }

    pub(crate) fn release(&self, bytes: u64) {
        self.store().held -= bytes;
    }

    /// A run has ended: what it recorded is known where it came to its end, and nobody keeps what no other run wants.
    pub(crate) fn end(&self, run: &Outline, serving: Vec<Serving>, complete: bool) {
        let mut store = self.store();
        for (key, serving) in run.keys.iter().zip(serving) {
            if let (Some(key), Serving::Record(recorder)) = (key, serving) {
                let recording = recorder.finish();
                match complete && !store.known.contains_key(key) {
                    true => _ = store.known.insert(*key, Arc::new(recording)),
                    false => store.held -= recording.bytes,
                }
            }
        }
        for key in run.keys.iter().flatten() {
            let left = store.wants.get_mut(key).map_or(0, |want| {
                want.runs = want.runs.saturating_sub(1);
                want.runs
            });
            if left == 0
                && let Some(recording) = store.known.remove(key)
            {
                store.held -= recording.bytes;
            }
        }
    }
}

impl Store {
    /// Records where another run wants it and nobody has it yet.
    fn record(&self, key: Option<Key>) -> Serving {
        let wanted = key.and_then(|key| self.wants.get(&key)).filter(|want| want.runs > 1);
        match wanted.filter(|_| key.is_some_and(|key| !self.known.contains_key(&key))) {
            Some(want) => Serving::Record(Recorder::new(want.whole.clone())),
            None => Serving::Compute,
        }
    }
}

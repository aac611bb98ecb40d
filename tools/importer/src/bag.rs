//! Bags of ROS: whose topics are which is in a map file, or in the draft of one.
//!
//! All messages but the clouds are read first: transforms, poses, positions and objects. Clocks of bags are compared, and poses are
//! brought to one world. Then the clouds of all agents are read in the order of time and written with what belongs to them.

mod agents;
mod clocks;
mod heads;
mod motion;
mod objects;
mod small;
mod summary;
mod sweeps;
mod track;
mod warnings;
mod write;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use realo_bags::map_file::MapFile;
use realo_bags::{Bag, Draft, Survey};

use self::agents::{Agent, Joined};
pub use self::summary::{BagAgent, BagSummary};
use crate::{ImportError, Options};

/// Bags that become one log.
pub struct Bags {
    paths: Vec<PathBuf>,
    output: PathBuf,
    options: Options,
}

/// What is open while bags are imported.
struct Import {
    /// Bags as they were given.
    files: Vec<Rc<dyn Bag>>,
    /// The same as agents see them.
    joined: Joined,
    map: MapFile,
    /// Whether the log has all agents of the map file.
    is_whole: bool,
    agents: Vec<Agent>,
    /// The map file as it was drafted, where nobody gave one.
    draft: Option<String>,
}

impl Bags {
    /// Bags for a log at `output`; nothing is read yet.
    pub fn new(paths: Vec<PathBuf>, output: &Path, options: &Options) -> Self {
        Bags {
            paths,
            output: output.into(),
            options: options.clone(),
        }
    }

    /// Writes the log; calls `report` with what it is at, what is done, and all there is to do.
    ///
    /// # Errors
    /// Bags that cannot be read; a map file that does not fit them; poses, frames or clocks that are missing.
    pub fn run(&self, report: &mut dyn FnMut(&'static str, u64, u64)) -> Result<BagSummary, ImportError> {
        let opened = self
            .paths
            .iter()
            .map(|path| realo_bags::open(path).and_then(realo_bags::decoded).map(Rc::from));
        let bags: Vec<Rc<dyn Bag>> = opened.collect::<Result<_, _>>()?;
        // A bag that is cut may lack just what the map file asks for.
        let notes: Vec<String> = bags.iter().flat_map(|bag| bag.notes().to_vec()).collect();
        self.made(bags, report).map_err(|error| error.with_notes(&notes))
    }

    fn made(
        &self,
        bags: Vec<Rc<dyn Bag>>,
        report: &mut dyn FnMut(&'static str, u64, u64),
    ) -> Result<BagSummary, ImportError> {
        let import = self.plan(bags)?;
        let small = small::read(&import, report)?;
        let clocks = clocks::joined(&import, &small)?;
        write::write(&import, small, &clocks, &self.output, report)
    }

    fn plan(&self, bags: Vec<Rc<dyn Bag>>) -> Result<Import, ImportError> {
        let (mut map, draft) = match &self.options.map {
            Some(file) => (MapFile::read(file)?, None),
            None => {
                let surveys = bags.iter().map(|bag| realo_bags::survey(bag.as_ref()));
                let surveys = surveys.collect::<Result<Vec<Survey>, _>>()?;
                let draft = Draft::of(&surveys).map_err(|reason| ImportError::content(&self.paths[0], reason))?;
                let text = draft.to_string();
                (draft.map, Some(text))
            }
        };
        self.choose(&mut map)?;
        let file = self.options.map.as_deref().unwrap_or(&self.paths[0]);
        let found = agents::found(&bags, &map);
        let (joined, agents) = found.map_err(|reason| ImportError::content(file, reason))?;
        Ok(Import {
            files: bags,
            joined,
            is_whole: self.options.agents.is_empty(),
            map,
            agents,
            draft,
        })
    }

    /// Leaves only the agents that are wanted.
    fn choose(&self, map: &mut MapFile) -> Result<(), ImportError> {
        let wanted = &self.options.agents;
        if let Some(name) = wanted.iter().find(|name| !map.agents.contains_key(*name)) {
            let has: Vec<&str> = map.agents.keys().map(String::as_str).collect();
            let reason = format!(
                "--agents: there is no agent `{}`; there are {}",
                crate::shown(name),
                has.join(", ")
            );
            return Err(ImportError::Option(reason));
        }
        if !wanted.is_empty() {
            map.agents.retain(|name, _| wanted.contains(name));
        }
        Ok(())
    }
}

/// How often something was wrong, by what it was.
#[derive(Clone, Debug, Default)]
pub struct Counted(pub BTreeMap<String, usize>);

impl Counted {
    /// Counts a fault. What was found differs from message to message, so faults of a topic are one after a few.
    fn add(&mut self, topic: &str, reason: String) {
        self.add_many(topic, reason, 1);
    }

    /// Counts a fault of so many messages or objects.
    fn add_many(&mut self, topic: &str, reason: String, count: usize) {
        const KEPT: usize = 3;
        let of_topic = self
            .0
            .keys()
            .filter(|known| known.starts_with(&format!("{topic}: ")))
            .count();
        let line = format!("{topic}: {reason}");
        let line = match self.0.contains_key(&line) || of_topic < KEPT {
            true => line,
            false => format!("{topic}: other reasons"),
        };
        if count > 0 {
            *self.0.entry(line).or_default() += count;
        }
    }
}

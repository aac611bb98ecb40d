//! Recorded detections on their way to their companion and their sweep, each of which may come later.

use std::collections::BTreeMap;

use realo_logs::{Entry, LogError, WrongHeadings};
use realo_schemas::{Boxes, Name, Nanos};

/// Detections wait so long, in log time, ns.
pub const PATIENCE: Nanos = 200_000_000;

type Key = (Name, Nanos);

/// Detections that are complete but for their sweep.
pub struct Recorded {
    pub entry: Entry,
    pub boxes: Boxes,
    /// Log time at which all of it was there.
    pub known: Nanos,
    pub wrong_headings: WrongHeadings,
}

/// Messages that wait for what belongs to them, by agent and stamp.
#[derive(Default)]
pub struct Joins {
    arrays: BTreeMap<Key, (Entry, Boxes)>,
    companions: BTreeMap<Key, Entry>,
    recorded: BTreeMap<Key, Recorded>,
}

fn key(entry: &Entry) -> Key {
    (entry.agent.clone(), entry.stamp())
}

impl Joins {
    /// Takes an array of boxes; gives it back once its companion is there.
    pub fn array(&mut self, entry: &Entry, mut boxes: Boxes) -> Result<Option<Recorded>, LogError> {
        let Some(companion) = self.companions.remove(&key(entry)) else {
            self.arrays.insert(key(entry), (entry.clone(), boxes));
            return Ok(None);
        };
        let wrong_headings = companion.info(&mut boxes)?.wrong_headings;
        Ok(Some(Recorded {
            known: companion.ready().max(entry.ready()),
            entry: entry.clone(),
            boxes,
            wrong_headings,
        }))
    }

    /// Takes a companion; gives the array back if it is there.
    pub fn companion(&mut self, entry: &Entry) -> Result<Option<Recorded>, LogError> {
        let Some((array, mut boxes)) = self.arrays.remove(&key(entry)) else {
            self.companions.insert(key(entry), entry.clone());
            return Ok(None);
        };
        let wrong_headings = entry.info(&mut boxes)?.wrong_headings;
        Ok(Some(Recorded {
            known: array.ready().max(entry.ready()),
            entry: array,
            boxes,
            wrong_headings,
        }))
    }

    /// Lets detections wait for their sweep.
    pub fn wait(&mut self, recorded: Recorded) {
        self.recorded.insert(key(&recorded.entry), recorded);
    }

    /// The detections that waited for a sweep.
    pub fn of_sweep(&mut self, sweep: &Entry) -> Option<Recorded> {
        self.recorded.remove(&key(sweep))
    }

    /// Arrays whose companion did not come until `now`.
    pub fn alone(&mut self, now: Nanos) -> Vec<Recorded> {
        let is_old = |entry: &Entry| now.saturating_sub(entry.ready()) > PATIENCE;
        self.companions.retain(|_, entry| !is_old(entry));
        let old = self.arrays.extract_if(.., |_, (entry, _)| is_old(entry));
        let alone = |(_, (entry, boxes))| Recorded {
            entry,
            boxes,
            known: now,
            wrong_headings: WrongHeadings::default(),
        };
        old.map(alone).collect()
    }

    /// Detections whose sweep did not come until `now`.
    pub fn lost(&mut self, now: Nanos) -> Vec<Recorded> {
        let is_old = |recorded: &Recorded| now.saturating_sub(recorded.known) > PATIENCE;
        let old = self.recorded.extract_if(.., |_, recorded| is_old(recorded));
        old.map(|(_, recorded)| recorded).collect()
    }
}

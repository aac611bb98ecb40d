//! The table of all messages.

use std::fmt::Write;

use realo_transmission::cpm::{station_of, timestamp_of};

use super::List;

/// A line for each message.
pub struct Index(String);

impl Default for Index {
    fn default() -> Self {
        Index("file,agent,station_id,stamp_ns,reference_time_ms,objects,bytes\n".into())
    }
}

impl Index {
    /// Adds a message.
    pub fn put(&mut self, file: &str, list: &List, objects: usize, bytes: usize) {
        let List { agent, stamp, .. } = list;
        // The message was made, so its stamp has a reference time. Names of agents have no commas.
        let time = timestamp_of(*stamp).unwrap_or_default();
        // Writing to a text does not fail.
        let _ = writeln!(
            self.0,
            "{file},{agent},{},{stamp},{time},{objects},{bytes}",
            station_of(agent)
        );
    }

    /// All of it.
    pub fn text(&self) -> &str {
        &self.0
    }
}

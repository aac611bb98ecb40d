//! What waits to be played, in the order of release.

use realo_operator::PortId;
use realo_schemas::{Message, Nanos};

pub(super) struct Queued {
    pub key: (Nanos, usize, usize, u64),
    pub port: PortId,
    pub message: Message,
}

impl PartialEq for Queued {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}

impl Eq for Queued {}

impl PartialOrd for Queued {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Queued {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key.cmp(&other.key)
    }
}

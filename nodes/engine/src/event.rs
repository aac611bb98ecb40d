//! The order of events.

use realo_operator::{Class, PortId};
use realo_schemas::{Kind, Message, Name, Nanos};

/// Order among the events of one instant and stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Order {
    ServerFree,
    State,
    Data,
    Wake,
    Query,
    End,
}

impl From<Class> for Order {
    fn from(class: Class) -> Self {
        match class {
            Class::State => Order::State,
            Class::Data => Order::Data,
            Class::Query => Order::Query,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Key {
    pub time: Nanos,
    /// Index of the stage; stages stand in topological order.
    pub stage: usize,
    pub order: Order,
    pub port: usize,
    pub agent: Name,
    pub kind: Option<Kind>,
    pub seq: u64,
    pub emission: u64,
}

pub(crate) enum What {
    Release(PortId, Message),
    Arrive(Message),
    ServerFree,
    Wake,
    End,
}

pub(crate) struct Event {
    pub key: Key,
    pub what: What,
}

impl PartialEq for Event {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}
impl Eq for Event {}
impl PartialOrd for Event {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Event {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key.cmp(&other.key)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_equal_where_their_order_says_so() {
        let event = |emission| Event {
            key: Key {
                time: 5,
                stage: 0,
                order: Order::Wake,
                port: 0,
                agent: "a".into(),
                kind: None,
                seq: 0,
                emission,
            },
            what: What::Wake,
        };
        assert!(event(1) == event(1) && event(1) != event(2));
        assert!(event(1) < event(2));
    }
}

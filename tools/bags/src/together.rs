//! Several bags of one recorder, read as one.

use std::collections::BTreeSet;
use std::path::Path;
use std::rc::Rc;

use realo_schemas::Nanos;

use crate::source::span_over;
use crate::{Bag, BagError, Connection, Message, Messages};

/// Bags whose stamps are of one clock, as one bag: a topic that several of them have is one topic.
pub struct Together {
    parts: Vec<Part>,
    connections: Vec<Connection>,
    notes: Vec<String>,
    decoded: Vec<String>,
}

struct Part {
    bag: Rc<dyn Bag>,
    /// Connections of the part, as places in the whole.
    places: Vec<usize>,
}

impl Together {
    /// Of at least one bag; [`Bag::path`] is the first one's.
    pub fn new(bags: Vec<Rc<dyn Bag>>) -> Self {
        let mut whole = Together {
            parts: Vec::new(),
            connections: Vec::new(),
            notes: bags.iter().flat_map(|bag| bag.notes().to_vec()).collect(),
            decoded: bags.iter().flat_map(|bag| bag.decoded().to_vec()).collect(),
        };
        for bag in bags {
            let places = bag.connections().iter().map(|own| whole.place(own)).collect();
            whole.parts.push(Part { bag, places });
        }
        whole
    }

    /// Where a connection of a part is among those of the whole, which counts its messages.
    fn place(&mut self, own: &Connection) -> usize {
        let is_same =
            |known: &Connection| (&known.topic, &known.kind, &known.encoding) == (&own.topic, &own.kind, &own.encoding);
        match self.connections.iter().position(is_same) {
            Some(place) => {
                self.connections[place].messages += own.messages;
                place
            }
            None => {
                self.connections.push(own.clone());
                self.connections.len() - 1
            }
        }
    }
}

impl Bag for Together {
    fn path(&self) -> &Path {
        self.parts[0].bag.path()
    }

    fn format(&self) -> &'static str {
        "several bags"
    }

    fn connections(&self) -> &[Connection] {
        &self.connections
    }

    fn span(&self) -> Option<[Nanos; 2]> {
        span_over(self.parts.iter().filter_map(|part| part.bag.span()))
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn decoded(&self) -> &[String] {
        &self.decoded
    }

    fn messages(&self, wanted: &BTreeSet<usize>) -> Result<Box<dyn Messages + '_>, BagError> {
        let mut open = Vec::new();
        for part in &self.parts {
            let own: BTreeSet<usize> = (0..part.places.len())
                .filter(|own| wanted.contains(&part.places[*own]))
                .collect();
            if own.is_empty() {
                continue;
            }
            let mut messages = part.bag.messages(&own)?;
            if let Some(next) = messages.next()? {
                open.push(Open { next, part, messages });
            }
        }
        Ok(Box::new(Merged { open }))
    }
}

/// A part with its next message.
struct Open<'a> {
    next: Message,
    part: &'a Part,
    messages: Box<dyn Messages + 'a>,
}

/// The messages of all parts by log time; of one time in the order of the parts.
struct Merged<'a> {
    open: Vec<Open<'a>>,
}

impl Messages for Merged<'_> {
    fn next(&mut self) -> Result<Option<Message>, BagError> {
        let soonest = (0..self.open.len()).min_by_key(|place| self.open[*place].next.log_time);
        let Some(place) = soonest else { return Ok(None) };
        let Open { next, part, messages } = &mut self.open[place];
        let places = &part.places;
        let mut taken = match messages.next()? {
            Some(later) => std::mem::replace(next, later),
            None => self.open.remove(place).next,
        };
        taken.connection = places[taken.connection];
        Ok(Some(taken))
    }
}

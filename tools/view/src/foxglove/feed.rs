//! The channels of a run and its newest messages, for clients that take them at their own pace.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use crate::awaited::Awaited;

/// Messages that are kept.
const MOST: usize = 2048;
/// Bytes of these.
const MOST_BYTES: usize = 32 << 20;
/// Bytes of the newest messages, which who comes late gets.
const MOST_NEWEST_BYTES: usize = 64 << 20;
/// Channels of a run.
const MOST_CHANNELS: usize = 1024;

/// A topic and what its messages are.
#[derive(Debug, PartialEq)]
pub struct Channel {
    /// No other one has it, of whatever run.
    pub id: u32,
    pub topic: String,
    pub schema_name: String,
    pub schema: String,
}

/// A message of a channel.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    pub channel: u32,
    /// When it existed, ns.
    pub time: u64,
    pub payload: Arc<[u8]>,
}

/// A run as its clients know it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Run {
    /// No other run has it.
    pub number: u64,
    pub name: String,
}

/// What is shown.
#[derive(Default)]
pub struct Feed {
    state: Awaited<State>,
}

#[derive(Default)]
struct State {
    run: Run,
    channels: Vec<Arc<Channel>>,
    next_channel: u32,
    kept: VecDeque<Message>,
    /// Number of the first that is kept.
    first: u64,
    bytes: usize,
    /// The newest message of each channel and agent, and its number.
    newest: BTreeMap<(u32, Arc<str>), (u64, Message)>,
    /// Bytes of these.
    newest_bytes: usize,
    closed: bool,
}

/// Where a client is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Place {
    /// The run that it knows.
    run: Option<u64>,
    /// Channels that it knows.
    channels: usize,
    next: u64,
}

/// What a client gets next.
#[derive(Debug, PartialEq)]
pub enum Next {
    /// Another run.
    Run(Run),
    /// More channels.
    Channels(Vec<Arc<Channel>>),
    Message(Message),
    /// So many messages went before it took them.
    Missed(u64),
    /// Nothing yet.
    Wait,
    /// Nothing any more.
    Closed,
}

impl Feed {
    /// Begins a new run: what was shown before goes.
    pub fn open(&self, name: &str) {
        let mut state = self.state.lock();
        state.run = Run {
            number: state.run.number + 1,
            name: name.into(),
        };
        state.channels.clear();
        state.newest.clear();
        state.newest_bytes = 0;
        state.first += state.kept.len() as u64;
        state.kept.clear();
        state.bytes = 0;
        self.state.wake();
    }

    /// Adds a channel and gives its number, unless there are too many.
    pub fn channel(&self, topic: &str, schema_name: &str, schema: &str) -> Option<u32> {
        let mut state = self.state.lock();
        if state.channels.len() >= MOST_CHANNELS {
            return None;
        }
        state.next_channel += 1;
        let id = state.next_channel;
        state.channels.push(Arc::new(Channel {
            id,
            topic: topic.into(),
            schema_name: schema_name.into(),
            schema: schema.into(),
        }));
        self.state.wake();
        Some(id)
    }

    /// Shows a message of a channel of this run. Who comes late gets the newest of each `agent`.
    pub fn send(&self, channel: u32, agent: &str, time: u64, payload: Arc<[u8]>) {
        let mut state = self.state.lock();
        if !state.has(channel) {
            return;
        }
        let message = Message { channel, time, payload };
        let number = state.first + state.kept.len() as u64;
        state.keep_newest((channel, Arc::from(agent)), number, &message);
        state.bytes += message.payload.len();
        state.kept.push_back(message);
        while state.kept.len() > MOST || state.bytes > MOST_BYTES {
            let Some(oldest) = state.kept.pop_front() else { break };
            state.bytes -= oldest.payload.len();
            state.first += 1;
        }
        self.state.wake();
    }

    /// Whether a channel is of this run.
    pub fn has(&self, channel: u32) -> bool {
        self.state.lock().has(channel)
    }

    /// The newest messages of a channel, for who comes late, the oldest first; without those that a client at this place will still come
    /// to.
    pub fn newest(&self, channel: u32, place: &Place) -> Vec<Message> {
        let state = self.state.lock();
        let of_channel = state.newest.iter().filter(|((of, _), _)| *of == channel);
        let mut newest: Vec<_> = of_channel
            .map(|(_, (number, message))| (*number, message))
            .filter(|(number, _)| *number < place.next)
            .collect();
        newest.sort_by_key(|(number, _)| *number);
        newest.into_iter().map(|(_, message)| message.clone()).collect()
    }

    /// Nothing more is shown.
    pub fn close(&self) {
        self.state.lock().closed = true;
        self.state.wake();
    }

    /// What a client at this place gets next; waits for it so long at most, or until [`Feed::wake`].
    pub fn next(&self, place: &mut Place, patience: Duration) -> Next {
        let is_nothing = |next: &Next| *next == Next::Wait;
        self.state.next(patience, is_nothing, |state| state.next(place))
    }

    /// Lets clients look around.
    pub fn wake(&self) {
        self.state.wake();
    }
}

impl State {
    /// Keeps a message for who comes late, in the place of the one before; none where there is no room.
    fn keep_newest(&mut self, key: (u32, Arc<str>), number: u64, message: &Message) {
        if let Some((_, before)) = self.newest.remove(&key) {
            self.newest_bytes -= before.payload.len();
        }
        let bytes = self.newest_bytes + message.payload.len();
        if self.newest.len() < MOST_CHANNELS && bytes <= MOST_NEWEST_BYTES {
            self.newest_bytes = bytes;
            self.newest.insert(key, (number, message.clone()));
        }
    }

    fn has(&self, channel: u32) -> bool {
        // They are numbered one after the other.
        let first = self.channels.first().map(|channel| channel.id);
        first.is_some_and(|first| (first..=self.next_channel).contains(&channel))
    }

    fn next(&self, place: &mut Place) -> Next {
        if self.closed {
            return Next::Closed;
        }
        let end = self.first + self.kept.len() as u64;
        if place.run != Some(self.run.number) {
            *place = Place {
                run: Some(self.run.number),
                channels: 0,
                next: end,
            };
            return Next::Run(self.run.clone());
        }
        if place.channels < self.channels.len() {
            let new = self.channels[place.channels..].to_vec();
            place.channels = self.channels.len();
            return Next::Channels(new);
        }
        if place.next < self.first {
            let missed = end - place.next;
            place.next = end;
            return Next::Missed(missed);
        }
        let Some(message) = self.kept.get((place.next - self.first) as usize) else {
            return Next::Wait;
        };
        place.next += 1;
        Next::Message(message.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::ZERO;

    #[test]
    fn what_is_kept_for_who_comes_late_is_bounded() {
        let feed = Feed::default();
        feed.open("a run");
        let channel = feed.channel("/points", "a", "b").unwrap();
        let cloud: Arc<[u8]> = vec![0; MOST_NEWEST_BYTES / 4 + 1].into();
        for agent in ["a", "b", "c", "d", "e", "a"] {
            feed.send(channel, agent, 1, cloud.clone());
        }
        let state = feed.state.lock();
        assert_eq!((state.newest.len(), state.newest_bytes), (3, 3 * cloud.len()));
    }

    #[test]
    fn a_client_hears_of_the_run_its_channels_and_then_what_comes() {
        let (feed, mut place) = (Feed::default(), Place::default());
        assert!(matches!(feed.next(&mut place, NOW), Next::Run(Run { number: 0, .. })));
        assert_eq!(feed.next(&mut place, NOW), Next::Wait);
        feed.open("late_fusion, log, cav1");
        let channel = feed.channel("/cav1/boxes", "a", "b").unwrap();
        feed.send(channel, "cav1", 4, [0].into());
        feed.send(channel, "rsu1", 5, [9].into());
        feed.send(channel, "cav1", 5, [1].into());
        let Next::Run(run) = feed.next(&mut place, NOW) else {
            panic!("a run began")
        };
        assert_eq!((run.number, &*run.name), (1, "late_fusion, log, cav1"));
        let Next::Channels(channels) = feed.next(&mut place, NOW) else {
            panic!("it has a channel")
        };
        assert_eq!((channels[0].id, &*channels[0].topic), (channel, "/cav1/boxes"));
        assert_eq!(
            feed.next(&mut place, NOW),
            Next::Wait,
            "what came before is not repeated"
        );
        let newest: Vec<u8> = feed
            .newest(channel, &place)
            .iter()
            .map(|message| message.payload[0])
            .collect();
        assert_eq!(newest, [9, 1], "but the newest of each agent can be had");
        feed.send(channel, "cav1", 6, [2].into());
        let newest: Vec<u8> = feed
            .newest(channel, &place)
            .iter()
            .map(|message| message.payload[0])
            .collect();
        assert_eq!(newest, [9], "the other one comes anyway");
        assert!(matches!(
            feed.next(&mut place, NOW),
            Next::Message(Message { time: 6, .. })
        ));
        let new = feed.channel("/cav1/points", "a", "b").unwrap();
        assert!(matches!(feed.next(&mut place, NOW), Next::Channels(new) if new.len() == 1));
        feed.open("another");
        assert!(!feed.has(channel) && !feed.has(new));
        feed.send(new, "cav1", 7, [3].into());
        assert!(matches!(feed.next(&mut place, NOW), Next::Run(Run { number: 2, .. })));
        assert_eq!(feed.next(&mut place, NOW), Next::Wait, "nothing of an earlier run");
        feed.close();
        assert_eq!(feed.next(&mut place, NOW), Next::Closed);
    }

    #[test]
    fn what_is_kept_is_bounded_and_who_is_slow_goes_on_with_the_newest() {
        let (feed, mut place) = (Feed::default(), Place::default());
        feed.open("run");
        let channel = feed.channel("/a", "b", "c").unwrap();
        while feed.next(&mut place, NOW) != Next::Wait {}
        (0..3 * MOST as u64).for_each(|time| feed.send(channel, "cav1", time, [0; 10].into()));
        assert_eq!(feed.next(&mut place, NOW), Next::Missed(3 * MOST as u64));
        assert_eq!(feed.state.lock().kept.len(), MOST);
        (0..10).for_each(|time| feed.send(channel, "cav1", time, vec![0; MOST_BYTES / 4].into()));
        let state = feed.state.lock();
        assert!(state.bytes <= MOST_BYTES && state.kept.len() <= 4);
        drop(state);
        let mut more = (0..2 * MOST_CHANNELS).map(|at| feed.channel(&format!("/{at}"), "b", "c"));
        assert_eq!(more.by_ref().flatten().count(), MOST_CHANNELS - 1);
    }
}

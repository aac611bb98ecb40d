//! What has come from outside and is not taken yet: bounded for each topic, and what is lost is counted.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::Duration;

use realo_schemas::Nanos;

/// A message as it came.
pub struct Heard {
    /// Number of its topic.
    pub topic: usize,
    /// CDR with its head.
    pub payload: Vec<u8>,
    /// When it came, by the wall clock.
    pub at: Nanos,
}

/// What is known of a topic.
#[derive(Clone, Debug, Default)]
pub struct Traffic {
    /// Messages that came.
    pub received: u64,
    /// Messages that are missing in between, by the numbers of their writers.
    pub lost: u64,
    /// Messages that came and that nobody took in time.
    pub overrun: u64,
    /// Messages that could not be read, and what was said of the last.
    pub refused: (u64, String),
    /// Wall time of the newest.
    pub newest: Option<Nanos>,
}

#[derive(Default)]
struct Topic {
    traffic: Traffic,
    room: usize,
    waiting: usize,
    /// The newest number of each writer.
    numbers: BTreeMap<[u8; 16], i64>,
}

#[derive(Default)]
struct State {
    waiting: VecDeque<Heard>,
    topics: Vec<Topic>,
}

/// The queue of all topics.
#[derive(Clone, Default)]
pub struct Queue(Arc<(Mutex<State>, Condvar)>);

impl Queue {
    /// Adds a topic of which at most `room` messages wait; gives its number.
    pub fn open(&self, room: usize) -> usize {
        let mut state = self.lock();
        state.topics.push(Topic {
            room,
            ..Topic::default()
        });
        state.topics.len() - 1
    }

    /// Adds a message, with its writer and the number that the writer gave it; of too many the oldest of the topic goes.
    pub fn put(&self, heard: Heard, writer: [u8; 16], number: i64) {
        let mut state = self.lock();
        let State { waiting, topics } = &mut *state;
        let topic = &mut topics[heard.topic];
        let before = topic.numbers.get(&writer).copied();
        // Numbers come from outside: any two of them.
        let gap = before.and_then(|before| number.checked_sub(before)?.checked_sub(1));
        let lost = gap.and_then(|gap| u64::try_from(gap).ok()).unwrap_or(0);
        topic.traffic.lost = topic.traffic.lost.saturating_add(lost);
        topic.numbers.insert(writer, number.max(before.unwrap_or(number)));
        topic.traffic.received += 1;
        topic.traffic.newest = Some(heard.at);
        topic.waiting += 1;
        if topic.waiting > topic.room {
            topic.waiting -= 1;
            topic.traffic.overrun += 1;
            let oldest = waiting.iter().position(|known| known.topic == heard.topic);
            if let Some(oldest) = oldest {
                waiting.remove(oldest);
            }
        }
        waiting.push_back(heard);
        self.0.1.notify_all();
    }

    /// Counts a message that could not be read.
    pub fn refuse(&self, topic: usize, reason: String) {
        let refused = &mut self.lock().topics[topic].traffic.refused;
        *refused = (refused.0 + 1, reason);
    }

    /// All that is there; waits for something for so long.
    pub fn take(&self, patience: Duration) -> VecDeque<Heard> {
        let state = self.lock();
        let waited = self
            .0
            .1
            .wait_timeout_while(state, patience, |state| state.waiting.is_empty());
        let (mut state, _) = waited.unwrap_or_else(|poisoned| poisoned.into_inner());
        state.topics.iter_mut().for_each(|topic| topic.waiting = 0);
        std::mem::take(&mut state.waiting)
    }

    /// What is known of a topic.
    pub fn traffic(&self, topic: usize) -> Traffic {
        self.lock().topics[topic].traffic.clone()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn heard(topic: usize, at: Nanos) -> Heard {
        Heard {
            topic,
            payload: Vec::new(),
            at,
        }
    }

    #[test]
    fn numbers_that_no_writer_counts_to_lose_nothing() {
        let queue = Queue::default();
        let topic = queue.open(100);
        for number in [i64::MIN, 5, i64::MAX, i64::MIN, -1] {
            queue.put(heard(topic, 0), [1; 16], number);
        }
        let traffic = queue.traffic(topic);
        assert_eq!((traffic.received, traffic.lost), (5, i64::MAX as u64 - 6));
    }

    #[test]
    fn of_too_many_the_oldest_of_their_topic_go_and_are_counted() {
        let queue = Queue::default();
        let [clouds, poses] = [2, 100].map(|room| queue.open(room));
        for at in 0..5 {
            queue.put(heard(clouds, at), [1; 16], at);
            queue.put(heard(poses, 10 + at), [2; 16], at);
        }
        let left: Vec<Nanos> = queue.take(Duration::ZERO).iter().map(|heard| heard.at).collect();
        assert_eq!(left, [10, 11, 12, 3, 13, 4, 14]);
        let traffic = queue.traffic(clouds);
        assert_eq!((traffic.received, traffic.overrun, traffic.lost), (5, 3, 0));
        assert_eq!((queue.traffic(poses).overrun, traffic.newest), (0, Some(4)));
        assert!(queue.take(Duration::from_millis(1)).is_empty());
        queue.put(heard(clouds, 9), [1; 16], 5);
        assert_eq!(
            (queue.take(Duration::ZERO).len(), queue.traffic(clouds).overrun),
            (1, 3)
        );
    }

    #[test]
    fn what_is_missing_between_the_numbers_of_a_writer_is_lost() {
        let queue = Queue::default();
        let topic = queue.open(9);
        // Numbers of two writers; one repeats and one comes late.
        for (writer, number) in [(1, 7), (1, 8), (2, 100), (1, 11), (2, 101), (1, 10), (1, 12)] {
            queue.put(heard(topic, 0), [writer; 16], number);
        }
        assert_eq!(queue.traffic(topic).lost, 2);
    }
}

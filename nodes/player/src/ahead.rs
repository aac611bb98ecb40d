//! What is read ahead: bounded by its messages and by their points, which is what takes memory.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard};

/// Messages that wait, at most.
const MESSAGES: usize = 256;
/// Points of all that wait, at most, unless a single message has more.
const POINTS: usize = 2 << 20;

/// The end at which messages are read.
pub struct Filler<T>(Arc<Shared<T>>);

/// The end at which they are taken.
pub struct Taker<T>(Arc<Shared<T>>);

struct Shared<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
}

struct State<T> {
    /// With the points of each.
    waiting: VecDeque<(T, usize)>,
    points: usize,
    /// One end is gone.
    over: bool,
}

/// A queue with both its ends.
pub fn ahead<T>() -> (Filler<T>, Taker<T>) {
    let state = State {
        waiting: VecDeque::new(),
        points: 0,
        over: false,
    };
    let shared = Arc::new(Shared {
        state: Mutex::new(state),
        changed: Condvar::new(),
    });
    (Filler(shared.clone()), Taker(shared))
}

impl<T> Shared<T> {
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State<T>>) -> MutexGuard<'a, State<T>> {
        self.changed
            .wait(state)
            .unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    fn end(&self) {
        self.lock().over = true;
        self.changed.notify_all();
    }
}

impl<T> Filler<T> {
    /// Waits for room and adds a message; `false` if nobody takes any more.
    pub fn put(&self, message: T, points: usize) -> bool {
        let mut state = self.0.lock();
        while !state.over && state.is_full(points) {
            state = self.0.wait(state);
        }
        if state.over {
            return false;
        }
        state.points += points;
        state.waiting.push_back((message, points));
        self.0.changed.notify_all();
        true
    }
}

impl<T> Taker<T> {
    /// Waits for the next message; `None` once the other end is gone and all of its messages are taken.
    pub fn take(&self) -> Option<T> {
        let mut state = self.0.lock();
        loop {
            if let Some((message, points)) = state.waiting.pop_front() {
                state.points -= points;
                self.0.changed.notify_all();
                return Some(message);
            }
            if state.over {
                return None;
            }
            state = self.0.wait(state);
        }
    }
}

impl<T> State<T> {
    fn is_full(&self, points: usize) -> bool {
        let full = self.waiting.len() >= MESSAGES || self.points + points > POINTS;
        full && !self.waiting.is_empty()
    }
}

impl<T> Drop for Filler<T> {
    fn drop(&mut self) {
        self.0.end();
    }
}

impl<T> Drop for Taker<T> {
    fn drop(&mut self) {
        self.0.end();
    }
}

#[cfg(test)]
mod tests {
    use std::thread;
    use std::time::Duration;

    use super::*;

    /// How many messages of so many points are put before one has to wait.
    fn put_at_once(points: usize) -> usize {
        let (filler, taker) = ahead();
        thread::scope(|scope| {
            let put = scope.spawn(move || (0..).take_while(|i| filler.put(*i, points)).count());
            let waiting = || taker.0.lock().waiting.len();
            let mut before = 0;
            // Until it has put nothing for a while.
            while before == 0 || before < waiting() {
                before = waiting();
                thread::sleep(Duration::from_millis(50));
            }
            let found = waiting();
            drop(taker);
            assert_eq!(put.join().unwrap(), found);
            found
        })
    }

    #[test]
    fn is_bounded_by_messages_and_by_points() {
        assert_eq!(put_at_once(0), MESSAGES);
        assert_eq!(put_at_once(POINTS / 4), 4);
        assert_eq!(put_at_once(POINTS / 4 + 1), 3);
        assert_eq!(put_at_once(POINTS + 1), 1);
    }

    #[test]
    fn all_that_was_put_is_taken_in_order() {
        let (filler, taker) = ahead();
        let put = thread::spawn(move || (0..1000).all(|i| filler.put(i, POINTS / 3)));
        assert!((0..1000).all(|i| taker.take() == Some(i)));
        assert_eq!(taker.take(), None);
        assert!(put.join().unwrap());
    }
}

//! The newest things that were shown, for clients that take them at their own pace.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use crate::awaited::Awaited;

/// Things that are kept.
const MOST: usize = 300;
/// Bytes of all that is kept.
const MOST_BYTES: usize = 32 << 20;
/// A client that is further behind than this goes on with the newest.
const BEHIND: u64 = 4;

/// What is shown.
#[derive(Clone, Debug, PartialEq)]
pub enum Shown {
    Text(Arc<str>),
    Picture(Arc<[u8]>),
}

impl Shown {
    fn bytes(&self) -> usize {
        match self {
            Shown::Text(text) => text.len(),
            Shown::Picture(bytes) => bytes.len(),
        }
    }
}

/// The newest things of one scene.
#[derive(Default)]
pub struct Ring {
    state: Awaited<State>,
}

#[derive(Default)]
struct State {
    /// First message of the scene.
    opening: Option<Shown>,
    /// Number of the scene.
    scene: u64,
    kept: VecDeque<Shown>,
    /// Number of the first that is kept.
    first: u64,
    bytes: usize,
    closed: bool,
}

/// Where a client is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Place {
    scene: u64,
    next: u64,
    /// It has seen all that was there when it came.
    is_live: bool,
}

/// What a client gets next.
#[derive(Debug, PartialEq)]
pub enum Next {
    Shown(Shown),
    /// Nothing yet.
    Wait,
    /// Nothing any more.
    Closed,
}

impl Ring {
    /// Begins a new scene: what was shown before goes.
    pub fn open(&self, opening: Shown) {
        let mut state = self.state.lock();
        state.first += state.kept.len() as u64;
        state.kept.clear();
        state.bytes = 0;
        state.scene += 1;
        state.opening = Some(opening);
        self.state.wake();
    }

    /// Shows one thing more.
    pub fn push(&self, shown: Shown) {
        let mut state = self.state.lock();
        state.bytes += shown.bytes();
        state.kept.push_back(shown);
        while state.kept.len() > MOST || state.bytes > MOST_BYTES {
            let Some(oldest) = state.kept.pop_front() else { break };
            state.bytes -= oldest.bytes();
            state.first += 1;
        }
        self.state.wake();
    }

    /// Nothing more is shown.
    pub fn close(&self) {
        self.state.lock().closed = true;
        self.state.wake();
    }

    /// What a client at this place gets next; waits for it so long at most, or until [`Ring::wake`].
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
    fn next(&self, place: &mut Place) -> Next {
        if self.closed {
            return Next::Closed;
        }
        if place.scene != self.scene {
            *place = Place {
                scene: self.scene,
                next: self.first,
                is_live: false,
            };
            return self.opening.clone().map_or(Next::Wait, Next::Shown);
        }
        let end = self.first + self.kept.len() as u64;
        place.next = place.next.max(self.first);
        if place.is_live && end - place.next > BEHIND {
            place.next = end - 1;
        }
        let Some(shown) = self.kept.get((place.next - self.first) as usize) else {
            place.is_live = true;
            return Next::Wait;
        };
        place.next += 1;
        Next::Shown(shown.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::ZERO;

    fn text(words: &str) -> Shown {
        Shown::Text(words.into())
    }

    fn said(ring: &Ring, place: &mut Place) -> Option<String> {
        match ring.next(place, NOW) {
            Next::Shown(Shown::Text(text)) => Some(text.to_string()),
            _ => None,
        }
    }

    #[test]
    fn who_comes_late_gets_what_is_there_and_who_is_slow_misses_some() {
        let (ring, mut place) = (Ring::default(), Place::default());
        assert_eq!(ring.next(&mut place, NOW), Next::Wait, "no scene yet");
        ring.open(text("scene"));
        (0..20).for_each(|at| ring.push(text(&at.to_string())));
        let mut late = Place::default();
        assert_eq!(said(&ring, &mut late).as_deref(), Some("scene"));
        let all: Vec<String> = std::iter::from_fn(|| said(&ring, &mut late)).collect();
        assert_eq!(all.len(), 20);
        (20..40).for_each(|at| ring.push(text(&at.to_string())));
        assert_eq!(said(&ring, &mut late).as_deref(), Some("39"), "the newest");
        ring.open(text("next scene"));
        assert_eq!(said(&ring, &mut late).as_deref(), Some("next scene"));
        ring.close();
        assert_eq!(ring.next(&mut late, NOW), Next::Closed);
    }

    #[test]
    fn what_is_kept_is_bounded_in_number_and_bytes() {
        let ring = Ring::default();
        ring.open(text("scene"));
        (0..10 * MOST).for_each(|_| ring.push(text("x")));
        assert_eq!(ring.state.lock().kept.len(), MOST);
        (0..10).for_each(|_| ring.push(Shown::Picture(vec![0; MOST_BYTES / 4].into())));
        let state = ring.state.lock();
        assert!(state.bytes <= MOST_BYTES && state.kept.len() <= 4);
        let summed: usize = state.kept.iter().map(Shown::bytes).sum();
        assert_eq!(state.bytes, summed);
    }
}

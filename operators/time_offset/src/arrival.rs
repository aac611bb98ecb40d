use std::collections::VecDeque;

use realo_schemas::{Nanos, to_seconds};

use crate::Offset;
use crate::line::lower_edge;

/// Most messages of a window.
const MOST: usize = 8_192;
/// Fewest messages from which an offset is estimated.
const FEWEST: usize = 40;
/// The quickest messages but so many are above the true envelope almost surely, whatever the distribution of delays near its minimum.
const QUICK: usize = 20;
/// Clocks drift no faster, ns a second.
const DRIFT: f64 = 500_000.0;
/// At the end of a window a wrong slope shifts the line so many times as much as at its middle.
const END: f64 = 3.0;

/// Offset and drift of a clock, from the arrivals of messages.
///
/// What a message takes at least, from the moment of its stamp to its arrival, cannot be told from an offset: it is given as a
/// range, whose half is part of the bound. For a sweep that is stamped in its middle that is half the sweep and the transport.
#[derive(Clone, Debug)]
pub struct ArrivalOffset {
    least_delay: [Nanos; 2],
    window: Nanos,
    /// Arrival, and arrival minus stamp.
    messages: VecDeque<(Nanos, Nanos)>,
}

impl ArrivalOffset {
    /// An estimate over the last `window` ns of messages whose least delay is in a range, ns.
    pub fn new(least_delay: [Nanos; 2], window: Nanos) -> Self {
        ArrivalOffset {
            least_delay,
            window,
            messages: VecDeque::new(),
        }
    }

    /// Takes a message.
    pub fn take(&mut self, stamp: Nanos, arrival: Nanos) {
        // Arrivals that run backwards are of another run.
        if self.messages.back().is_some_and(|(last, _)| arrival < *last) {
            self.messages.clear();
        }
        self.messages.push_back((arrival, arrival.saturating_sub(stamp)));
        let oldest = arrival.saturating_sub(self.window);
        while self.messages.len() > MOST || self.messages.front().is_some_and(|(at, _)| *at < oldest) {
            self.messages.pop_front();
        }
    }

    /// Forgets all messages, as when the clock stepped.
    pub fn restart(&mut self) {
        self.messages.clear();
    }

    /// The offset at the last message; `None` while there are fewer than 40.
    pub fn offset(&self) -> Option<Offset> {
        let (last, delay) = *self.messages.back()?;
        if self.messages.len() < FEWEST {
            return None;
        }
        // From the last message on, so that float has digits to spare.
        let points: Vec<(f64, f64)> = self
            .messages
            .iter()
            .map(|(at, each)| (to_seconds(at.saturating_sub(last)), each.saturating_sub(delay) as f64))
            .collect();
        let mean = points.iter().map(|(at, _)| at).sum::<f64>() / points.len() as f64;
        let (slope, height) = lower_edge(&points)?;
        let drift = slope.clamp(-DRIFT, DRIFT);
        let mut above: Vec<f64> = points
            .iter()
            .map(|(at, each)| each - height - drift * (at - mean))
            .collect();
        above.sort_unstable_by(f64::total_cmp);
        let excess = (above[QUICK - 1] - above[0]).max(0.0);
        let envelope = height + above[0] + drift * -mean;
        let [low, high] = self.least_delay;
        let middle = low.saturating_add(high) / 2;
        let half = high.saturating_sub(low) / 2;
        Some(Offset {
            offset: delay.saturating_add(envelope.round() as Nanos).saturating_sub(middle),
            bound: half.saturating_add((END * excess).ceil() as Nanos),
            drift,
            at: last.saturating_sub(delay),
        })
    }
}

//! How far the time line of a peer lies from one's own: by questions that go there and answers that come back, and by what both
//! machines say of their clocks.

use std::collections::VecDeque;

use realo_schemas::Nanos;

const MS: Nanos = 1_000_000;
/// Exchanges count for so long.
const WINDOW: Nanos = 60_000 * MS;
/// Of so long only the best exchange is kept.
const STRETCH: Nanos = 1_000 * MS;
/// Round trips that are longer than the smallest by more than this tell of a queue.
const QUEUED: Nanos = 2 * MS;
/// Offsets are taken to drift once they are known for so long.
const DRIFTS: Nanos = 10_000 * MS;
/// What a peer said of its clock holds for so long.
const SAID_HOLDS: Nanos = 10_000 * MS;
/// What a stamp is off by at least, between the call that takes it and the wire.
const LEAST_UNCERTAINTY: Nanos = 50_000;

/// A question and its answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Exchange {
    /// When the question went out, on one's own time line.
    pub asked: Nanos,
    /// When the peer had it, on its own.
    pub heard: Nanos,
    /// When the answer went out, on the peer's.
    pub answered: Nanos,
    /// When it was here.
    pub known: Nanos,
}

impl Exchange {
    /// Time on both ways together.
    fn round_trip(&self) -> Nanos {
        (self.known - self.asked).saturating_sub(self.answered.saturating_sub(self.heard))
    }

    /// Peer's time minus one's own, if both ways take the same time.
    fn offset(&self) -> Nanos {
        let (out, back) = (
            i128::from(self.heard) - i128::from(self.asked),
            i128::from(self.answered) - i128::from(self.known),
        );
        ((out + back) / 2).clamp(i128::from(Nanos::MIN / 2), i128::from(Nanos::MAX / 2)) as Nanos
    }
}

/// Where a time line lies, as its machine says that is synchronised by GNSS, PTP or NTP.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Said {
    /// The time line minus the time to which the machine is synchronised, ns.
    pub line: Nanos,
    /// What the machine's clock is off by at most, ns.
    pub error: Nanos,
}

/// What an [`Estimate`] is taken from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Basis {
    /// Questions and answers.
    Exchanges,
    /// What both machines say of their clocks.
    Machines,
    /// Questions and answers, which show that one of the machines is wrong about its clock: by so much the offset that they
    /// say differs, ns.
    Contradiction(Nanos),
}

/// Peer's time minus one's own, now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// ns.
    pub offset: Nanos,
    /// How much exchanges without a queue differ, ns: ways of which one is always longer than the other do not show in it. Of what
    /// machines say, what both clocks are off by at most.
    pub uncertainty: Nanos,
    /// The offset of exchanges is off by no more, ns: half of the smallest round trip.
    pub bound: Nanos,
    /// What the offset grows by, ns a second.
    pub drift: f64,
    /// Where it is from.
    pub basis: Basis,
}

/// The exchanges of late, and what was said.
#[derive(Clone, Debug, Default)]
pub struct Offset {
    /// When machines said so, the offset by their clocks, and what it is off by at most.
    said: Option<(Nanos, Nanos, Nanos)>,
    /// When each stretch of time began, and its exchange with the smallest round trip; oldest first.
    best: VecDeque<(Nanos, Exchange)>,
}

impl Offset {
    /// Takes an exchange; one that ends before it begins is none.
    pub fn take(&mut self, exchange: Exchange) {
        if exchange.known < exchange.asked || exchange.round_trip() < 0 {
            return;
        }
        let steps = |known: &Estimate| {
            let differs = exchange.offset().saturating_sub(known.offset).saturating_abs();
            differs
                > (exchange.round_trip() / 2)
                    .saturating_add(known.bound)
                    .saturating_add(QUEUED)
        };
        if self.measured(exchange.known).is_some_and(|known| steps(&known)) {
            // Of two lines that lie otherwise since one of them stepped.
            self.best.clear();
        }
        match self.best.back_mut() {
            Some((begun, best)) if exchange.known - *begun < STRETCH => {
                if exchange.round_trip() < best.round_trip() {
                    *best = exchange;
                }
            }
            _ => self.best.push_back((exchange.known, exchange)),
        }
        while self
            .best
            .front()
            .is_some_and(|(begun, _)| exchange.known - begun > WINDOW)
        {
            self.best.pop_front();
        }
    }

    /// Takes what both machines say of their clocks, at a time of one's own; `None` of a machine that says nothing.
    pub fn said(&mut self, now: Nanos, own: Option<Said>, peers: Option<Said>) {
        self.said = own.zip(peers).map(|(own, peers)| {
            let error = own.error.max(0).saturating_add(peers.error.max(0));
            (now, peers.line.saturating_sub(own.line), error)
        });
    }

    /// What is known at a time of one's own; `None` before the first exchange.
    ///
    /// What machines say is taken where it is surer than what exchanges bound, unless these contradict it.
    pub fn estimate(&self, now: Nanos) -> Option<Estimate> {
        let measured = self.measured(now)?;
        let fresh = self.said.filter(|(then, ..)| now.saturating_sub(*then) <= SAID_HOLDS);
        let Some((_, offset, error)) = fresh else {
            return Some(measured);
        };
        let bound = measured.bound.saturating_add(measured.uncertainty);
        let differs = measured.offset.saturating_sub(offset).saturating_abs();
        if differs > bound.saturating_add(error) {
            return Some(Estimate {
                basis: Basis::Contradiction(differs),
                ..measured
            });
        }
        if error >= bound {
            return Some(measured);
        }
        Some(Estimate {
            offset,
            uncertainty: error.max(LEAST_UNCERTAINTY),
            drift: 0.0,
            basis: Basis::Machines,
            ..measured
        })
    }

    /// What exchanges alone tell.
    fn measured(&self, now: Nanos) -> Option<Estimate> {
        let exchanges = || self.best.iter().map(|(_, exchange)| exchange);
        let best = exchanges().min_by_key(|exchange| exchange.round_trip())?;
        let clear: Vec<&Exchange> = exchanges()
            .filter(|exchange| exchange.round_trip() <= best.round_trip().saturating_add(QUEUED))
            .collect();
        // Seconds and ns from the best exchange, so that numbers stay small.
        let places = clear.iter().map(|exchange| {
            let seconds = (exchange.known - best.known) as f64 * 1e-9;
            (seconds, (exchange.offset() - best.offset()) as f64)
        });
        let places: Vec<(f64, f64)> = places.collect();
        let span = clear.last().map_or(0, |last| last.known) - clear.first().map_or(0, |first| first.known);
        let (drift, from) = match span >= DRIFTS {
            true => line(&places),
            false => (0.0, 0.0),
        };
        let differs = places.iter().map(|(x, y)| (y - from - drift * x).abs());
        let later = (now - best.known) as f64 * 1e-9;
        Some(Estimate {
            offset: best.offset().saturating_add((from + drift * later) as Nanos),
            uncertainty: (differs.fold(0.0, f64::max) as Nanos).max(LEAST_UNCERTAINTY),
            bound: best.round_trip() / 2,
            drift,
            basis: Basis::Exchanges,
        })
    }
}

/// Slope and height at 0 of the line with the least squares.
fn line(places: &[(f64, f64)]) -> (f64, f64) {
    let count = places.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| places.iter().map(of).sum::<f64>() / count;
    let (x, y) = (mean(|place| place.0), mean(|place| place.1));
    let (products, squares) = places.iter().fold((0.0, 0.0), |(products, squares), place| {
        let (dx, dy) = (place.0 - x, place.1 - y);
        (products + dx * dy, squares + dx * dx)
    });
    let slope = if squares > 0.0 { products / squares } else { 0.0 };
    (slope, y - slope * x)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: Nanos = 1_000 * MS;

    /// An exchange at `now` with a peer whose time is later by `offset`, over ways that take `out` and `back`.
    fn exchange(now: Nanos, offset: Nanos, [out, back]: [Nanos; 2]) -> Exchange {
        let heard = now + out + offset;
        Exchange {
            asked: now,
            heard,
            answered: heard + 3 * MS,
            known: now + out + 3 * MS + back,
        }
    }

    #[test]
    fn a_queue_on_one_way_does_not_count_while_there_are_exchanges_without() {
        let mut offset = Offset::default();
        let true_offset = 1_234 * MS;
        for n in 0..300 {
            let queue = if n % 7 == 0 { 0 } else { (n % 50) * MS };
            offset.take(exchange(n * SECOND / 5, true_offset, [20 * MS + queue, 20 * MS]));
        }
        let found = offset.estimate(60 * SECOND).unwrap();
        assert!((found.offset - true_offset).abs() < MS / 10, "{found:?}");
        assert!(found.uncertainty < 2 * MS && found.bound == 20 * MS, "{found:?}");
    }

    #[test]
    fn a_drift_is_followed() {
        // 40 millionths, a bad quartz.
        let mut offset = Offset::default();
        let at = |now: Nanos| -5 * SECOND + now / 25_000;
        for n in 0..600 {
            let now = n * SECOND / 5;
            offset.take(exchange(now, at(now), [MS, MS + n % 3 * MS / 10]));
        }
        let found = offset.estimate(125 * SECOND).unwrap();
        assert!((found.offset - at(125 * SECOND)).abs() < MS / 4, "{found:?}");
        assert!((found.drift - 40_000.0).abs() < 8_000.0, "{found:?}");
    }

    #[test]
    fn a_clock_that_steps_is_believed_at_once() {
        let mut offset = Offset::default();
        (0..100).for_each(|n| offset.take(exchange(n * SECOND / 5, 0, [MS, MS])));
        offset.take(exchange(21 * SECOND, 200 * MS, [MS, 2 * MS]));
        let found = offset.estimate(21 * SECOND).unwrap();
        assert!((found.offset - 200 * MS).abs() <= MS, "{found:?}");
    }

    /// A machine that says that its clock is off by so much at most; its time line is that much ahead of its clock.
    fn says(line: Nanos, error: Nanos) -> Option<Said> {
        Some(Said { line, error })
    }

    #[test]
    fn synchronised_machines_are_believed_where_they_are_surer_than_exchanges() {
        // One way always takes 10 ms longer, which no exchange shows.
        let mut offset = Offset::default();
        let true_offset = 300 * MS;
        (0..50).for_each(|n| offset.take(exchange(n * SECOND / 5, true_offset, [30 * MS, 20 * MS])));
        let now = 10 * SECOND;
        let measured = offset.estimate(now).unwrap();
        assert_eq!((measured.offset, measured.basis), (305 * MS, Basis::Exchanges));

        offset.said(now, says(-100 * MS, MS / 10), says(200 * MS, MS / 5));
        let said = offset.estimate(now).unwrap();
        assert_eq!((said.offset, said.uncertainty), (true_offset, 3 * MS / 10));
        assert_eq!((said.basis, said.drift), (Basis::Machines, 0.0));

        offset.said(now, says(0, 20 * MS), says(true_offset, 10 * MS));
        assert_eq!(offset.estimate(now), Some(measured), "exchanges are surer");
        offset.said(now, says(0, 0), None);
        assert_eq!(offset.estimate(now), Some(measured), "one says nothing");
        offset.said(now, says(0, 0), says(true_offset, 0));
        assert_eq!(offset.estimate(now).unwrap().basis, Basis::Machines);
        let later = offset.estimate(now + SAID_HOLDS + 1).unwrap();
        assert_eq!(later.basis, Basis::Exchanges, "nothing was said for long");
    }

    #[test]
    fn what_exchanges_contradict_is_not_believed() {
        let mut offset = Offset::default();
        (0..50).for_each(|n| offset.take(exchange(n * SECOND / 5, 200 * MS, [20 * MS, 20 * MS])));
        let now = 10 * SECOND;
        offset.said(now, says(0, MS / 10), says(0, MS / 10));
        let found = offset.estimate(now).unwrap();
        assert_eq!((found.offset, found.basis), (200 * MS, Basis::Contradiction(200 * MS)));
    }

    proptest! {
        #[test]
        fn the_truth_lies_within_the_bound(
            ways in prop::collection::vec((0..80 * MS, 0..80 * MS), 1..60),
            true_offset in -1_000_000 * SECOND..1_000_000 * SECOND,
        ) {
            let mut offset = Offset::default();
            let mut now = 0;
            for (out, back) in ways {
                offset.take(exchange(now, true_offset, [out, back]));
                now += SECOND / 5;
            }
            let found = offset.estimate(now).unwrap();
            // Drawn ways drift as chance has it.
            let bound = found.bound + found.uncertainty + QUEUED;
            prop_assert!((found.offset - true_offset).abs() <= bound, "{:?}", found);
        }

        #[test]
        fn numbers_of_a_hostile_peer_do_no_harm(numbers in prop::collection::vec(any::<[i64; 2]>(), 0..20)) {
            let mut offset = Offset::default();
            for (n, [heard, answered]) in (0..).zip(numbers) {
                offset.take(Exchange { asked: n * SECOND, heard, answered, known: n * SECOND + MS });
                offset.said(n * SECOND, says(answered, heard), says(heard, answered));
                let _ = offset.estimate(n * SECOND + MS);
            }
        }
    }
}

//! How many bytes of bulk may be on the way: as many as the link carries in the least round trip and a little more, so that
//! it is never idle and its queues stay short.

use std::collections::VecDeque;

use realo_schemas::Nanos;

const MS: Nanos = 1_000_000;
/// Receipts that a rate is taken from lie within so long.
const TRAIN: Nanos = 200 * MS;
/// A train counts as at least so long, for receipts that lie closer together say more of the receiver than of the link.
const SHORTEST: Nanos = 20 * MS;
/// Acknowledgements do not overtake each other by so long: the peer's clock stepped.
const STEP: Nanos = 1_000 * MS;
/// The greatest rate of so long holds.
const MEMORY: Nanos = 500 * MS;
/// A longer round trip is none: the peer made the time of sending up.
const LONGEST: Nanos = 60_000 * MS;
/// A least round trip is looked for anew after so long,
const LEAST_HOLDS: Nanos = 10_000 * MS;
/// with so much of what fills it on the way.
const EMPTIED: f64 = 0.75;
/// Parts go out so much faster than the way carries them, lest it be idle and to see whether it carries more.
const HASTE: f64 = 1.25;
/// The same while it was just found to carry more.
const GREATER_HASTE: f64 = 2.0;
/// A rate so much greater than those before says that the way carries more.
const GROWTH: f64 = 1.1;
/// Parts go out together that take the way so long.
const TOGETHER: Nanos = 10 * MS;
/// Parts that may always be on the way.
const PARTS: usize = 4;
/// A part takes the link about so long, but is never larger than asked for.
const PART_TIME: f64 = 0.01;
/// The smallest part, bytes.
pub(super) const SMALLEST: usize = 1024;

/// Rate and round trip of a way, by what came back of it.
#[derive(Clone, Debug)]
pub struct Window {
    part: usize,
    /// Bytes of a part while nothing is known of the rate.
    first: usize,
    queue: Nanos,
    /// Bytes that came in since the start.
    delivered: u64,
    /// When they came in, on the receiver's clock, and `delivered` then; since the way was last empty.
    train: VecDeque<(Nanos, u64)>,
    /// When rates were measured, and the rates, bytes/s: those that a later one does not exceed.
    rates: VecDeque<(Nanos, f64)>,
    /// The least round trip, and when it was found.
    least: Option<(Nanos, Nanos)>,
    /// Since when so little is on the way that nothing of it waits in a queue, to see the round trip without.
    emptied: Option<Nanos>,
    /// When all that went out has crossed, at the pace of sending.
    crossed: Nanos,
    /// When the way was last found to carry more.
    grew: Option<Nanos>,
}

impl Window {
    /// Of a way of which nothing is known: `part` bytes go at once at most, and `queue` ns of data may stand in queues.
    pub fn new(part: usize, queue: Nanos) -> Self {
        Window {
            part: part.max(SMALLEST),
            first: part.max(SMALLEST),
            queue,
            delivered: 0,
            train: VecDeque::new(),
            rates: VecDeque::new(),
            least: None,
            emptied: None,
            crossed: Nanos::MIN,
            grew: None,
        }
    }

    /// Bytes that may be on the way.
    pub fn bytes(&self) -> usize {
        let of = |time: f64| self.rate().map_or(0, |rate| (rate * time * 1e-9) as usize);
        match (self.least, self.emptied) {
            (Some((least, _)), None) => of((least + self.queue) as f64).max(PARTS * self.part()),
            (Some((least, _)), Some(_)) => of(EMPTIED * least as f64).max(self.part()),
            (None, _) => PARTS * self.part(),
        }
    }

    /// Bytes of a part.
    pub fn part(&self) -> usize {
        match self.rate() {
            Some(rate) => ((rate * PART_TIME) as usize).clamp(SMALLEST, self.part),
            None => self.first,
        }
    }

    /// Bytes a second that the way is known to carry; `None` before the first measurement.
    pub fn rate(&self) -> Option<f64> {
        self.rates.front().map(|(_, rate)| *rate)
    }

    /// The least round trip of late, ns.
    pub fn round_trip(&self) -> Option<Nanos> {
        self.least.map(|(least, _)| least)
    }

    /// Whether the way was found to carry more than was known, after this time.
    pub fn grew_since(&self, then: Nanos) -> bool {
        self.grew.is_some_and(|grew| grew > then)
    }

    /// When the next part may go out, if the window has room: all at once would stand in a queue on the way.
    pub fn opens_at(&self) -> Nanos {
        self.crossed.saturating_sub(TOGETHER)
    }

    /// Bytes go out; `first`: while nothing else is on the way, and what stood still meanwhile says nothing of the rate.
    pub fn sent(&mut self, now: Nanos, bytes: usize, first: bool) {
        if first && now > self.crossed {
            self.train.clear();
        }
        let grows = self.grew.is_some_and(|then| now - then < MEMORY);
        let haste = if grows { GREATER_HASTE } else { HASTE };
        let time = self.rate().map_or(0.0, |rate| bytes as f64 / (rate * haste) * 1e9);
        self.crossed = self.crossed.max(now) + time as Nanos;
    }

    /// Bytes came in, at `received` on the peer's clock, that had gone out at `sent`.
    pub fn acknowledged(&mut self, now: Nanos, sent: Nanos, received: Nanos, bytes: usize) {
        self.delivered += bytes as u64;
        self.see_round_trip(now, sent);
        match self.train.back_mut() {
            Some((last, _)) if last.saturating_sub(received) > STEP => self.train.clear(),
            // Acknowledgements overtook each other.
            Some((last, delivered)) if received <= *last => *delivered = self.delivered,
            _ => self.train.push_back((received, self.delivered)),
        }
        while self
            .train
            .front()
            .is_some_and(|(first, _)| received.saturating_sub(*first) > TRAIN)
        {
            self.train.pop_front();
        }
        if let (Some((first, before)), true) = (self.train.front(), self.train.len() > 1) {
            let span = received.saturating_sub(*first);
            let rate = (self.delivered - before) as f64 / (span.max(SHORTEST) as f64 * 1e-9);
            // A shorter train says how much the way carries at least.
            if span >= SHORTEST || self.rate().is_none_or(|known| rate > known) {
                self.see_rate(now, rate);
            }
        }
    }

    /// Forgets what the way carries, for nothing came back of it in a long time; it begins anew more carefully.
    pub fn lost(&mut self) {
        self.first = (self.first / 4).max(SMALLEST);
        self.train.clear();
        self.rates.clear();
        self.emptied = None;
    }

    fn see_rate(&mut self, now: Nanos, rate: f64) {
        if self.rate().is_none_or(|known| rate > GROWTH * known) {
            self.grew = Some(now);
        }
        while self.rates.back().is_some_and(|(_, known)| *known <= rate) {
            self.rates.pop_back();
        }
        self.rates.push_back((now, rate));
        // The last one stays however long nothing is sent.
        while self.rates.len() > 1 && self.rates.front().is_some_and(|(then, _)| now - then > MEMORY) {
            self.rates.pop_front();
        }
    }

    fn see_round_trip(&mut self, now: Nanos, sent: Nanos) {
        let found = now.saturating_sub(sent);
        if !(0..=LONGEST).contains(&found) {
            return;
        }
        let anew = self.emptied.is_some_and(|since| sent >= since);
        match self.least {
            Some((least, when)) if found > least && !anew => {
                if now - when > LEAST_HOLDS {
                    self.emptied.get_or_insert(now);
                }
            }
            _ => {
                self.least = Some((found, now));
                if anew {
                    self.emptied = None;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PART_BYTES: usize = 16_384;

    /// Sends parts for so long over a way of so many bytes a second and ns, whose queue holds everything, as fast as the window
    /// lets them; gives the longest time that a part stood in the queue after the first `settles` ns.
    fn drive(window: &mut Window, start: Nanos, lasts: Nanos, rate: f64, delay: Nanos, settles: Nanos) -> Nanos {
        let (mut now, mut free, mut on_the_way) = (start, start, VecDeque::new());
        let (mut flying, mut longest) = (0, 0);
        while now < start + lasts {
            while flying == 0 || flying + window.part() <= window.bytes() {
                if window.opens_at() > now {
                    if on_the_way
                        .front()
                        .is_some_and(|(_, arrives, _)| arrives + delay <= window.opens_at())
                    {
                        break;
                    }
                    now = window.opens_at();
                }
                let bytes = window.part();
                window.sent(now, bytes, flying == 0);
                free = free.max(now) + (bytes as f64 / rate * 1e9) as Nanos;
                if now > start + settles {
                    longest = longest.max(free - now);
                }
                on_the_way.push_back((now, free + delay, bytes));
                flying += bytes;
            }
            let (sent, arrives, bytes) = on_the_way.pop_front().expect("a part at least is on the way");
            now = arrives + delay;
            flying -= bytes;
            // The peer's clock is another one.
            window.acknowledged(now, sent, arrives + 1_234_567_890, bytes);
        }
        longest
    }

    #[test]
    fn fills_the_link_and_keeps_its_queue_short() {
        for (megabits, delay) in [(2.0, 20), (6.0, 20), (27.0, 20), (100.0, 5), (300.0, 1), (27.0, 150)] {
            let rate = megabits * 1e6 / 8.0;
            let mut window = Window::new(PART_BYTES, 20 * MS);
            let longest = drive(&mut window, 0, 20_000 * MS, rate, delay * MS, 1_500 * MS);
            let found = window.rate().unwrap();
            assert!((0.8..1.2).contains(&(found / rate)), "{megabits} Mbit/s: {found}");
            assert!(
                longest < 80 * MS,
                "{megabits} Mbit/s, {delay} ms: {longest} ns in the queue"
            );
            let least = window.round_trip().unwrap();
            assert!((2 * delay * MS..2 * delay * MS + 30 * MS).contains(&least), "{least}");
        }
    }

    #[test]
    fn follows_a_link_that_changes() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        let mut start = 0;
        for megabits in [27.0, 6.0, 27.0, 2.0, 100.0] {
            let rate = megabits * 1e6 / 8.0;
            let longest = drive(&mut window, start, 15_000 * MS, rate, 20 * MS, 1_500 * MS);
            start += 20_000 * MS;
            let found = window.rate().unwrap();
            assert!((0.8..1.2).contains(&(found / rate)), "{megabits} Mbit/s: {found}");
            assert!(longest < 80 * MS, "{megabits} Mbit/s: {longest}");
        }
    }

    #[test]
    fn a_longer_way_is_found_within_ten_seconds() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        drive(&mut window, 0, 5_000 * MS, 3e6, 5 * MS, 0);
        drive(&mut window, 5_100 * MS, 12_000 * MS, 3e6, 50 * MS, 0);
        let least = window.round_trip().unwrap();
        assert!((100 * MS..130 * MS).contains(&least), "{least}");
    }

    #[test]
    fn nothing_known_and_nothing_heard_mean_four_parts() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        assert_eq!(
            (window.bytes(), window.rate(), window.round_trip()),
            (4 * PART_BYTES, None, None)
        );
        drive(&mut window, 0, 1_000 * MS, 3e6, 5 * MS, 0);
        assert!(window.bytes() > 4 * PART_BYTES);
        for parts in [4, 16, 16] {
            window.lost();
            assert_eq!((window.bytes(), window.rate()), (4 * PART_BYTES / parts, None));
        }
    }

    #[test]
    fn a_clock_of_the_peer_that_steps_back_is_no_rate() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        drive(&mut window, 0, 1_000 * MS, 3e6, 5 * MS, 0);
        let before = window.rate().unwrap();
        for k in 0..3 {
            window.acknowledged(1_100 * MS + k, 1_090 * MS, k - 999_999 * MS * k, PART_BYTES);
        }
        assert_eq!(window.rate().unwrap(), before);
    }

    #[test]
    fn parts_that_came_together_never_lower_the_rate() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        drive(&mut window, 0, 2_000 * MS, 14e6, 40 * MS, 0);
        let before = window.rate().unwrap();
        let later = 4_000 * MS;
        for k in 0..8 {
            window.sent(later, PART_BYTES, k == 0);
        }
        for k in 0..8 {
            let crosses = 40 * MS + (PART_BYTES as f64 / 14e6 * 1e9) as Nanos * k;
            window.acknowledged(later + 40 * MS + crosses, later, later + crosses, PART_BYTES);
        }
        assert_eq!(window.rate().unwrap(), before);
    }
}

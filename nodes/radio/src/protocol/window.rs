//! How many bytes of bulk may be on the way: as many as the link carries in the smallest round trip and a little more, so that
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
/// The largest rate of so long holds.
const MEMORY: Nanos = 500 * MS;
/// A longer round trip is none: the peer made the time of sending up.
const LONGEST: Nanos = 60_000 * MS;
/// A smallest round trip is looked for anew after so long,
const LEAST_HOLDS: Nanos = 10_000 * MS;
/// with so much of what fills it on the way.
const EMPTIED: f64 = 0.75;
/// Parts go out so much faster than the way carries them, lest it be idle and to see whether it carries more.
const SEND_RATE_FACTOR: f64 = 1.25;
/// The same at most while it was just found to carry more.
const MAX_SEND_RATE_FACTOR: f64 = 2.0;
/// What goes out in greater haste may stand in queues for so many times the usual, until something is heard of it.
const EXCESS: f64 = 2.5;
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
    /// When they came in, on the receiver's clock, and `delivered` then; since the way last stood still.
    train: VecDeque<(Nanos, u64)>,
    /// When the train's first part went out, and what `delivered` is once it came in.
    set_out: (Nanos, u64),
    /// Whether the way stands still: nothing is on it, and there was nothing to send.
    rests: bool,
    /// Whether there was nothing to send at times since the way last stood still.
    ran_out: bool,
    /// When rates were measured, and the rates, bytes/s: those that a later one does not exceed.
    rates: VecDeque<(Nanos, f64)>,
    /// The smallest round trip, and when it was found.
    min: Option<(Nanos, Nanos)>,
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
            set_out: (Nanos::MIN, 0),
            rests: true,
            ran_out: false,
            rates: VecDeque::new(),
            min: None,
            emptied: None,
            crossed: Nanos::MIN,
            grew: None,
        }
    }

    /// Bytes that may be on the way.
    pub fn bytes(&self) -> usize {
        let of = |time: f64| self.rate().map_or(0, |rate| (rate * time * 1e-9) as usize);
        match (self.min, self.emptied) {
            (Some((min, _)), None) => of((min + self.queue) as f64).max(PARTS * self.part()),
            (Some((min, _)), Some(_)) => of(EMPTIED * min as f64).max(self.part()),
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

    /// The smallest round trip of late, ns.
    pub fn round_trip(&self) -> Option<Nanos> {
        self.min.map(|(min, _)| min)
    }

    /// Whether the way was found to carry more than was known, after this time.
    pub fn grew_since(&self, then: Nanos) -> bool {
        self.grew.is_some_and(|grew| grew > then)
    }

    /// When the next part may go out, if the window has room: all at once would stand in a queue on the way.
    pub fn opens_at(&self) -> Nanos {
        self.crossed.saturating_sub(TOGETHER)
    }

    /// Nothing is on the way any more: whatever is believed of its rate, it is free. If there was nothing to send before that, such
    /// as while a trial is awaited, it stood still.
    pub fn empties(&mut self, now: Nanos) {
        self.crossed = self.crossed.min(now);
        self.rests |= self.ran_out;
    }

    /// There is nothing to send, and perhaps nothing on the way either: what comes in then says nothing of the rate.
    pub fn runs_out(&mut self, is_empty: bool) {
        (self.ran_out, self.rests) = (true, is_empty);
    }

    /// Bytes go out.
    pub fn sent(&mut self, now: Nanos, bytes: usize) {
        if std::mem::take(&mut self.rests) {
            self.train.clear();
            self.ran_out = false;
            self.set_out = (now, self.delivered + bytes as u64);
        }
        let grows = self.grew.is_some_and(|then| now - then < MEMORY);
        let factor = if grows { self.raised_factor() } else { SEND_RATE_FACTOR };
        let time = self.rate().map_or(0.0, |rate| bytes as f64 / (rate * factor) * 1e9);
        self.crossed = self.crossed.max(now) + time as Nanos;
    }

    /// How much faster than is known parts go out while the way may carry more. Of a window that goes out before anything is heard of it,
    /// the way carries meanwhile what it is known to, at least.
    fn raised_factor(&self) -> f64 {
        let Some((min, _)) = self.min else {
            return MAX_SEND_RATE_FACTOR;
        };
        let window = (min + self.queue) as f64;
        let goes_in = (window - EXCESS * self.queue as f64).max(window / MAX_SEND_RATE_FACTOR);
        (window / goes_in).max(SEND_RATE_FACTOR)
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
        let over = |bytes: u64, span: Nanos| bytes as f64 / (span.max(SHORTEST) as f64 * 1e-9);
        if let [Some((first, before)), Some((last, _))] = [self.train.front(), self.train.back()]
            && self.train.len() > 1
        {
            let (bytes, span) = (self.delivered - before, last.saturating_sub(*first));
            let rate = over(bytes, span);
            let accepts = match self.rate() {
                // Any train says how much the way carries at least.
                Some(known) if rate > known => true,
                // Unless less than may always be on the way came in of it: what its first part is followed by.
                None if bytes >= ((PARTS - 1) * self.part()) as u64 => true,
                // It carries no more if parts had to wait or more of them were there all the time: else it was not asked to.
                _ => {
                    let asked = !self.ran_out || self.waited(now, sent);
                    asked && span >= SHORTEST && bytes >= SMALLEST as u64
                }
            };
            if accepts {
                self.see_rate(now, rate);
            }
        } else if let (Some(known), Some((min, _))) = (self.rate(), self.min) {
            // One acknowledgement was for the whole train, for it overtook the others or they were lost: the train took what its
            // round trip lasted beyond the smallest, which one part takes.
            let (then, first) = self.set_out;
            let span = now.saturating_sub(then).saturating_sub(min);
            let rate = over(self.delivered.saturating_sub(first), span);
            if rate > known {
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
        (self.rests, self.crossed) = (true, Nanos::MIN);
    }

    fn see_rate(&mut self, now: Nanos, rate: f64) {
        let before = self.rate();
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
        // What has still to cross takes no longer than by what is known now.
        if let (Some(before), Some(rate), true) = (before, self.rate(), self.crossed > now) {
            self.crossed = now + ((self.crossed - now) as f64 * (before / rate).min(1.0)) as Nanos;
        }
    }

    /// Whether a part stood in a queue on the way.
    fn waited(&self, now: Nanos, sent: Nanos) -> bool {
        let min = self.round_trip().unwrap_or(0);
        now.saturating_sub(sent).saturating_sub(min) >= self.queue / 4
    }

    fn see_round_trip(&mut self, now: Nanos, sent: Nanos) {
        let found = now.saturating_sub(sent);
        if !(0..=LONGEST).contains(&found) {
            return;
        }
        let anew = self.emptied.is_some_and(|since| sent >= since);
        match self.min {
            Some((min, when)) if found > min && !anew => {
                if now - when > LEAST_HOLDS {
                    self.emptied.get_or_insert(now);
                }
            }
            _ => {
                self.min = Some((found, now));
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
        window.runs_out(true);
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
                window.sent(now, bytes);
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
            let min = window.round_trip().unwrap();
            assert!((2 * delay * MS..2 * delay * MS + 30 * MS).contains(&min), "{min}");
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
        let min = window.round_trip().unwrap();
        assert!((100 * MS..130 * MS).contains(&min), "{min}");
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
    fn a_way_that_is_not_asked_for_more_keeps_its_rate() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        drive(&mut window, 0, 2_000 * MS, 14e6, 40 * MS, 0);
        let (before, offset) = (window.rate().unwrap(), 1_234_567_890);
        // A part every 100 ms while one is missing: the way is never empty.
        for sent in (30..80).map(|k| k * 100 * MS) {
            window.sent(sent, PART_BYTES);
            window.runs_out(false);
            window.acknowledged(sent + 82 * MS, sent, sent + offset + 41 * MS, PART_BYTES);
        }
        assert_eq!(window.rate().unwrap(), before);
        // They queue: the way became slower.
        for sent in (80..90).map(|k| k * 100 * MS) {
            window.sent(sent, PART_BYTES);
            window.runs_out(false);
            window.acknowledged(sent + 180 * MS, sent, sent + offset + 139 * MS, PART_BYTES);
        }
        let slower = window.rate().unwrap();
        assert!((0.9..1.1).contains(&(slower / 163_840.0)), "{slower}");
        // The rest of a message comes late.
        window.runs_out(true);
        [PART_BYTES, 3].iter().for_each(|bytes| window.sent(9_500 * MS, *bytes));
        window.acknowledged(9_580 * MS, 9_500 * MS, offset + 9_540 * MS, PART_BYTES);
        window.acknowledged(9_680 * MS, 9_500 * MS, offset + 9_640 * MS, 3);
        assert_eq!(window.rate().unwrap(), slower);
    }

    #[test]
    fn a_train_that_is_reported_of_in_one_word_raises_the_rate() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        drive(&mut window, 0, 2_000 * MS, 1e5, 40 * MS, 0);
        let (before, part, later) = (window.rate().unwrap(), window.part(), 4_000 * MS);
        let acknowledge = |window: &mut Window, took: Nanos| {
            window.runs_out(true);
            (0..4).for_each(|_| window.sent(later, part));
            window.acknowledged(later + took, later, later + took / 2, 4 * part);
            window.rate().unwrap() / before
        };
        let min = window.round_trip().unwrap();
        // Three parts in 60 ms are no more than was known, in 20 ms about twice as much.
        assert_eq!(acknowledge(&mut window.clone(), min + 60 * MS), 1.0);
        let grown = acknowledge(&mut window, min + 5 * MS);
        assert!((1.4..1.7).contains(&grown), "{grown}");
        assert!(window.grew_since(later));
    }

    #[test]
    fn what_goes_out_after_a_pause_is_measured_by_itself() {
        // TCP begins slowly: what follows comes in faster, and the pause until it went out was the sender's.
        let mut window = Window::new(PART_BYTES, 20 * MS);
        drive(&mut window, 0, 2_000 * MS, 1e6, 20 * MS, 0);
        let (before, offset) = (window.rate().unwrap(), 1_234_567_890);
        let acknowledge = |window: &mut Window, sent: Nanos, takes: Nanos| {
            (0..4).for_each(|_| window.sent(sent, PART_BYTES));
            window.runs_out(false);
            for part in 1..=4 {
                let received = sent + 20 * MS + part * takes;
                window.acknowledged(received + 20 * MS, sent, received + offset, PART_BYTES);
            }
        };
        window.runs_out(true);
        acknowledge(&mut window, 4_000 * MS, 30 * MS);
        window.empties(4_160 * MS);
        acknowledge(&mut window, 4_160 * MS, 8 * MS);
        let faster = window.rate().unwrap() / before;
        assert!((1.8..2.3).contains(&faster), "{faster}");
    }

    #[test]
    fn a_way_with_nothing_on_it_is_free_whatever_was_believed() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        drive(&mut window, 0, 2_000 * MS, 1e5, 5 * MS, 0);
        let now = 4_000 * MS;
        (0..4).for_each(|_| window.sent(now, SMALLEST));
        assert!(window.opens_at() > now + 20 * MS);
        window.empties(now + 12 * MS);
        assert!(window.opens_at() <= now + 12 * MS);
    }

    #[test]
    fn parts_that_came_together_never_lower_the_rate() {
        let mut window = Window::new(PART_BYTES, 20 * MS);
        drive(&mut window, 0, 2_000 * MS, 14e6, 40 * MS, 0);
        let before = window.rate().unwrap();
        let later = 4_000 * MS;
        window.runs_out(true);
        (0..8).for_each(|_| window.sent(later, PART_BYTES));
        for k in 0..8 {
            let crosses = 40 * MS + (PART_BYTES as f64 / 14e6 * 1e9) as Nanos * k;
            window.acknowledged(later + 40 * MS + crosses, later, later + crosses, PART_BYTES);
        }
        assert_eq!(window.rate().unwrap(), before);
    }
}

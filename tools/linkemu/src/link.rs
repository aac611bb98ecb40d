//! What the link does to packets.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use crate::tun::Tun;

/// A link between two machines, both directions alike. All may change while it carries packets.
#[derive(Debug)]
pub struct Link {
    /// Bits/s, 0: not limited.
    rate: AtomicU64,
    /// µs.
    delay: AtomicU64,
    /// Uniform, from 0, of each packet its own, µs: packets overtake each other.
    jitter: AtomicU64,
    /// What waits for the link at most, as time, µs.
    queue: AtomicU64,
    /// Of a million packets.
    loss: AtomicU64,
    /// Of a million packets, those of which a copy follows.
    duplicate: AtomicU64,
    /// 0 or 1.
    half_duplex: AtomicU64,
    /// 0 or 1.
    cut: AtomicU64,
    counts: [[AtomicU64; 5]; 2],
}

/// What became of the packets of one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Packets that were carried, copies too.
    pub packets: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Packets that were lost by chance or by a cut.
    pub lost: u64,
    /// Packets that found the queue full.
    pub overflown: u64,
    /// Packets of which a copy followed.
    pub duplicated: u64,
}

const PACKETS: usize = 0;
const BYTES: usize = 1;
const LOST: usize = 2;
const OVERFLOWN: usize = 3;
const DUPLICATED: usize = 4;

/// Smallest rate above 0, Mbit/s.
const LEAST: f64 = 1e-3;
/// Largest rate, Mbit/s, and time, ms.
const MOST: f64 = 1e6;
/// Shares are of so many.
const ALL: u64 = 1_000_000;

/// What a setting of a link is counted in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Mbit/s; 0: no limit.
    Rate,
    /// ms.
    Time,
    /// A share of all packets, 0 to 1.
    Share,
    /// 0 or 1.
    Switch,
}

impl Unit {
    /// Of a setting; `None`: there is no such one.
    pub fn of(setting: &str) -> Option<Unit> {
        match setting {
            "rate" => Some(Unit::Rate),
            "delay" | "jitter" | "queue" => Some(Unit::Time),
            "loss" | "duplicate" => Some(Unit::Share),
            "half_duplex" | "cut" => Some(Unit::Switch),
            _ => None,
        }
    }

    /// A number as a link keeps it; `None`: it takes no such number.
    fn kept(self, value: f64) -> Option<u64> {
        let (is_taken, scale) = match self {
            Unit::Rate => (value == 0.0 || (LEAST..=MOST).contains(&value), 1e6),
            Unit::Time => ((0.0..=MOST).contains(&value), 1e3),
            Unit::Share => ((0.0..=1.0).contains(&value), ALL as f64),
            Unit::Switch => (value == 0.0 || value == 1.0, 1.0),
        };
        is_taken.then_some((value * scale) as u64)
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Unit::Rate => write!(f, "0, for no limit, or a number of Mbit/s from {LEAST} to {MOST}"),
            Unit::Time => write!(f, "a number of ms from 0 to {MOST}"),
            Unit::Share => f.write_str("a number from 0 to 1"),
            Unit::Switch => f.write_str("0 or 1"),
        }
    }
}

impl Default for Link {
    fn default() -> Self {
        Link {
            rate: AtomicU64::new(0),
            delay: AtomicU64::new(0),
            jitter: AtomicU64::new(0),
            queue: AtomicU64::new(100_000),
            loss: AtomicU64::new(0),
            duplicate: AtomicU64::new(0),
            half_duplex: AtomicU64::new(0),
            cut: AtomicU64::new(0),
            counts: Default::default(),
        }
    }
}

impl Link {
    /// Sets `rate`, `delay`, `jitter`, `queue`, `loss`, `duplicate`, `half_duplex` or `cut`, in its [`Unit`]; `false` if there is no
    /// such thing or it does not take the number.
    pub fn set(&self, what: &str, value: f64) -> bool {
        let setting = match what {
            "rate" => &self.rate,
            "delay" => &self.delay,
            "jitter" => &self.jitter,
            "queue" => &self.queue,
            "loss" => &self.loss,
            "duplicate" => &self.duplicate,
            "half_duplex" => &self.half_duplex,
            "cut" => &self.cut,
            _ => return false,
        };
        let kept = Unit::of(what).and_then(|unit| unit.kept(value));
        if let Some(kept) = kept {
            setting.store(kept, Relaxed);
        }
        kept.is_some()
    }

    /// What became of the packets from the first machine to the second, and back.
    pub fn counts(&self) -> [Counts; 2] {
        [0, 1].map(|direction: usize| {
            let of = |what: usize| self.counts[direction][what].load(Relaxed);
            Counts {
                packets: of(PACKETS),
                bytes: of(BYTES),
                lost: of(LOST),
                overflown: of(OVERFLOWN),
                duplicated: of(DUPLICATED),
            }
        })
    }

    /// When a packet arrives, and behind it its copy where one follows; `None` for what is lost.
    fn arrivals(
        &self,
        direction: usize,
        bytes: usize,
        now: Instant,
        free: &Free,
        draws: &mut Draws,
    ) -> [Option<Instant>; 2] {
        if self.is_cut() || draws.happens(&self.loss) {
            self.count(direction, LOST, 1);
            return [None; 2];
        }
        let copied = draws.happens(&self.duplicate);
        self.count(direction, DUPLICATED, u64::from(copied));
        [true, copied].map(|is_there| {
            if !is_there {
                return None;
            }
            let Some(leaves) = pass(self, direction, bytes, now, free) else {
                self.count(direction, OVERFLOWN, 1);
                return None;
            };
            self.carried(direction, bytes);
            Some(leaves + self.delay(draws))
        })
    }

    pub(crate) fn is_cut(&self) -> bool {
        self.cut.load(Relaxed) > 0
    }

    /// How long a packet or a part of a stream is on its way once it has left.
    pub(crate) fn delay(&self, draws: &mut Draws) -> Duration {
        Duration::from_micros(self.delay.load(Relaxed) + draws.below(self.jitter.load(Relaxed) + 1))
    }

    pub(crate) fn carried(&self, direction: usize, bytes: usize) {
        self.count(direction, PACKETS, 1);
        self.count(direction, BYTES, bytes as u64);
    }

    fn count(&self, direction: usize, what: usize, n: u64) {
        self.counts[direction][what].fetch_add(n, Relaxed);
    }
}

/// When each direction's link is free again; half duplex, both have the first one's.
pub(crate) type Free = Mutex<[Instant; 2]>;

/// Carries packets both ways until the process ends.
pub(crate) fn carry(link: &Arc<Link>, ends: [Tun; 2]) -> std::io::Result<()> {
    let free = Arc::new(Mutex::new([Instant::now(); 2]));
    for direction in [0, 1] {
        let (from, to) = (ends[direction].share()?, ends[1 - direction].share()?);
        let (link, free) = (link.clone(), free.clone());
        std::thread::spawn(move || carry_one_way(&link, direction, from, to, &free));
    }
    Ok(())
}

fn carry_one_way(link: &Link, direction: usize, from: Tun, to: Tun, free: &Free) {
    let (sender, leaving) = mpsc::channel();
    std::thread::spawn(move || let_out(&leaving, &to));
    let (mut draws, mut buffer) = (Draws::of(direction), vec![0; 1 << 16]);
    loop {
        let Some(length) = from.read(&mut buffer) else {
            // The device has no address yet, or is gone.
            std::thread::sleep(Duration::from_millis(20));
            continue;
        };
        let arrivals = link.arrivals(direction, length, Instant::now(), free, &mut draws);
        for at in arrivals.into_iter().flatten() {
            if sender.send((at, buffer[..length].to_vec())).is_err() {
                return;
            }
        }
    }
}

/// Lets packets out when they arrive.
fn let_out(leaving: &mpsc::Receiver<(Instant, Vec<u8>)>, to: &Tun) {
    let mut on_the_way = OnTheWay::default();
    loop {
        while let Some(packet) = on_the_way.arrived(Instant::now()) {
            to.write(&packet);
        }
        let next = match on_the_way.next() {
            Some(at) => leaving.recv_timeout(at.saturating_duration_since(Instant::now())),
            None => leaving.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        match next {
            Ok((at, packet)) => on_the_way.put(at, packet),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
    }
}

/// Packets in order of arrival; those that arrive at one time in the order in which they left.
#[derive(Default)]
struct OnTheWay {
    packets: BinaryHeap<Reverse<(Instant, u64, Vec<u8>)>>,
    number: u64,
}

impl OnTheWay {
    fn put(&mut self, at: Instant, packet: Vec<u8>) {
        self.packets.push(Reverse((at, self.number, packet)));
        self.number += 1;
    }

    /// When the first one arrives.
    fn next(&self) -> Option<Instant> {
        self.packets.peek().map(|first| first.0.0)
    }

    /// The first one, if it has arrived.
    fn arrived(&mut self, now: Instant) -> Option<Vec<u8>> {
        self.next().filter(|at| *at <= now)?;
        self.packets.pop().map(|first| first.0.2)
    }
}

/// When a packet has left; `None` if it finds the queue full.
pub(crate) fn pass(link: &Link, direction: usize, bytes: usize, now: Instant, free: &Free) -> Option<Instant> {
    let rate = link.rate.load(Relaxed);
    if rate == 0 {
        return Some(now);
    }
    let place = if link.half_duplex.load(Relaxed) > 0 {
        0
    } else {
        direction
    };
    let mut free: MutexGuard<[Instant; 2]> = free.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let begins = free[place].max(now);
    if begins - now > Duration::from_micros(link.queue.load(Relaxed)) {
        return None;
    }
    free[place] = begins + Duration::from_nanos(bytes as u64 * 8_000_000_000 / rate);
    Some(free[place])
}

/// Xorshift64*, Vigna 2016: what is lost is the same on every run for the same packets.
pub(crate) struct Draws(u64);

impl Draws {
    pub(crate) fn of(direction: usize) -> Draws {
        Draws(0x9e37_79b9_7f4a_7c15 ^ (direction as u64 + 1))
    }

    /// Whether something happens that happens to a share of all.
    fn happens(&mut self, share: &AtomicU64) -> bool {
        self.below(ALL) < share.load(Relaxed)
    }

    fn below(&mut self, bound: u64) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        ((self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 32) * bound) >> 32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_have_names_and_bounds() {
        let link = Link::default();
        for what in [
            "rate",
            "delay",
            "jitter",
            "queue",
            "loss",
            "duplicate",
            "half_duplex",
            "cut",
        ] {
            let unit = Unit::of(what).expect(what);
            assert!(link.set(what, 1.0), "{what}");
            assert_eq!(link.set(what, 0.5), unit != Unit::Switch, "{what}");
            assert!(!link.set(what, f64::NAN) && !link.set(what, f64::INFINITY), "{what}");
            assert!(!link.set(what, -1.0), "{what}");
            let is_up_to_1 = matches!(unit, Unit::Share | Unit::Switch);
            assert_eq!(link.set(what, 1.1), !is_up_to_1, "{what}");
            assert!(link.set(what, 0.0) && !link.set(what, 1e300), "{what}");
        }
        assert!(!link.set("speed", 1.0) && Unit::of("speed").is_none());
        // A link of hardly any rate is not one without a limit.
        assert!(!link.set("rate", 1e-7) && link.set("rate", 1e-3));
        let link = Link::default();
        assert!(link.set("rate", 1e-3));
        let (now, free) = (Instant::now(), Mutex::new([Instant::now(); 2]));
        let leaves = pass(&link, 0, 125, now, &free).expect("the queue is empty");
        assert!(leaves - now >= Duration::from_secs(1), "{:?}", leaves - now);
    }

    /// What a link makes of 10,000 packets of 1,500 bytes that come one after the other.
    fn arrivals(link: &Link, now: Instant) -> Vec<[Option<Instant>; 2]> {
        let (free, mut draws) = (Mutex::new([now; 2]), Draws::of(0));
        (0..10_000)
            .map(|_| link.arrivals(0, 1500, now, &free, &mut draws))
            .collect()
    }

    #[test]
    fn copies_follow_and_take_their_time_on_the_link() {
        let (link, now) = (Link::default(), Instant::now());
        for (what, value) in [("rate", 12.0), ("queue", 1e6), ("duplicate", 0.1), ("loss", 0.2)] {
            assert!(link.set(what, value));
        }
        let all = arrivals(&link, now);
        let copies = all.iter().filter(|[_, copy]| copy.is_some()).count() as u64;
        let counts = link.counts()[0];
        // Of the 8,000 that are not lost.
        assert!((700..900).contains(&copies), "{copies}");
        assert_eq!(
            (counts.duplicated, counts.packets),
            (copies, 10_000 - counts.lost + copies)
        );
        assert_eq!(counts.bytes, counts.packets * 1500);
        // A millisecond each.
        let last = all.iter().flatten().flatten().max();
        assert_eq!(last, Some(&(now + Duration::from_millis(counts.packets))));
        link.set("duplicate", 0.0);
        assert!(arrivals(&link, now).iter().all(|[_, copy]| copy.is_none()));
        assert_eq!(link.counts()[0].duplicated, copies);
    }

    #[test]
    fn a_copy_that_finds_the_queue_full_does_not_arrive() {
        let (link, now) = (Link::default(), Instant::now());
        for (what, value) in [("rate", 12.0), ("queue", 10.0), ("duplicate", 1.0)] {
            assert!(link.set(what, value));
        }
        arrivals(&link, now);
        let counts = link.counts()[0];
        assert_eq!((counts.packets, counts.overflown), (11, 20_000 - 11));
    }

    #[test]
    fn jitter_lets_packets_overtake_each_other_and_nothing_else_does() {
        let (link, now) = (Link::default(), Instant::now());
        let in_order = |link: &Link| {
            let mut on_the_way = OnTheWay::default();
            for (n, [at, _]) in arrivals(link, now).into_iter().enumerate() {
                on_the_way.put(at.unwrap(), n.to_le_bytes().to_vec());
            }
            assert!(on_the_way.arrived(now).is_none());
            let end = now + Duration::from_secs(100);
            let order: Vec<Vec<u8>> = std::iter::from_fn(|| on_the_way.arrived(end)).collect();
            let order = order
                .iter()
                .map(|packet| usize::from_le_bytes(*packet.first_chunk().unwrap()));
            let order: Vec<usize> = order.collect();
            assert_eq!(order.len(), 10_000);
            order.is_sorted_by(|one, next| one < next)
        };
        for (what, value) in [("rate", 12.0), ("queue", 1e6), ("delay", 20.0)] {
            assert!(link.set(what, value));
        }
        assert!(in_order(&link));
        link.set("jitter", 60.0);
        assert!(!in_order(&link));
        // All at one time.
        for what in ["rate", "jitter"] {
            link.set(what, 0.0);
        }
        assert!(in_order(&link));
    }

    #[test]
    fn packets_queue_one_behind_the_other_up_to_the_bound() {
        let link = Link::default();
        link.set("rate", 12.0);
        link.set("queue", 10.0);
        let now = Instant::now();
        let free = Mutex::new([now; 2]);
        // 1,500 bytes take a millisecond.
        let left: Vec<_> = (0..20).map(|_| pass(&link, 0, 1500, now, &free)).collect();
        let passed = left.iter().flatten().count();
        assert_eq!(passed, 11);
        assert_eq!(left[10], Some(now + Duration::from_millis(11)));
        assert!(pass(&link, 1, 1500, now, &free) == Some(now + Duration::from_millis(1)));
        link.set("half_duplex", 1.0);
        assert_eq!(pass(&link, 1, 1500, now, &free), None);
    }

    #[test]
    fn draws_are_spread() {
        let mut draws = Draws(7);
        let lost = (0..100_000).filter(|_| draws.below(1_000_000) < 10_000).count();
        assert!((900..1100).contains(&lost), "{lost}");
    }
}

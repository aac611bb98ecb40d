//! What the link does to packets.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, mpsc};
use std::time::{Duration, Instant};

use crate::tun::Tun;

/// A link between two machines, both directions alike. All may change while it carries packets.
#[derive(Debug)]
pub struct Link {
    /// Bits/s, 0: not limited.
    rate: AtomicU64,
    /// µs.
    delay: AtomicU64,
    /// Uniform, from 0, µs.
    jitter: AtomicU64,
    /// What waits for the link at most, as time, µs.
    queue: AtomicU64,
    /// Of a million packets.
    loss: AtomicU64,
    half_duplex: AtomicBool,
    cut: AtomicBool,
    counts: [[AtomicU64; 4]; 2],
}

/// What became of the packets of one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Packets that were carried.
    pub packets: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Packets that were lost by chance or by a cut.
    pub lost: u64,
    /// Packets that found the queue full.
    pub overflown: u64,
}

const PACKETS: usize = 0;
const BYTES: usize = 1;
const LOST: usize = 2;
const OVERFLOWN: usize = 3;

impl Default for Link {
    fn default() -> Self {
        Link {
            rate: AtomicU64::new(0),
            delay: AtomicU64::new(0),
            jitter: AtomicU64::new(0),
            queue: AtomicU64::new(100_000),
            loss: AtomicU64::new(0),
            half_duplex: AtomicBool::new(false),
            cut: AtomicBool::new(false),
            counts: Default::default(),
        }
    }
}

impl Link {
    /// Sets `rate` (Mbit/s, 0: no limit), `delay`, `jitter`, `queue` (ms), `loss` (0 to 1), `half_duplex` or `cut` (0 or 1); `false`
    /// if there is no such thing or the number is none.
    pub fn set(&self, what: &str, value: f64) -> bool {
        if !(value.is_finite() && value >= 0.0) {
            return false;
        }
        match what {
            "rate" => self.rate.store((value * 1e6) as u64, Relaxed),
            "delay" => self.delay.store((value * 1e3) as u64, Relaxed),
            "jitter" => self.jitter.store((value * 1e3) as u64, Relaxed),
            "queue" => self.queue.store((value * 1e3) as u64, Relaxed),
            "loss" => self.loss.store((value * 1e6) as u64, Relaxed),
            "half_duplex" => self.half_duplex.store(value > 0.0, Relaxed),
            "cut" => self.cut.store(value > 0.0, Relaxed),
            _ => return false,
        }
        true
    }

    /// What became of the packets from the first machine to the second, and back.
    pub fn counts(&self) -> [Counts; 2] {
        [0, 1].map(|direction: usize| {
            let [packets, bytes, lost, overflown] =
                [PACKETS, BYTES, LOST, OVERFLOWN].map(|what| self.counts[direction][what].load(Relaxed));
            Counts {
                packets,
                bytes,
                lost,
                overflown,
            }
        })
    }

    pub(crate) fn is_cut(&self) -> bool {
        self.cut.load(Relaxed)
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
    let (sender, leaving) = mpsc::channel::<(Instant, Vec<u8>)>();
    std::thread::spawn(move || {
        for (at, packet) in leaving {
            std::thread::sleep(at.saturating_duration_since(Instant::now()));
            to.write(&packet);
        }
    });
    let mut draws = Draws::of(direction);
    let (mut last, mut buffer) = (Instant::now(), vec![0; 1 << 16]);
    loop {
        let Some(length) = from.read(&mut buffer) else {
            // The device has no address yet, or is gone.
            std::thread::sleep(Duration::from_millis(20));
            continue;
        };
        let now = Instant::now();
        if link.is_cut() || draws.below(1_000_000) < link.loss.load(Relaxed) {
            link.count(direction, LOST, 1);
            continue;
        }
        let Some(leaves) = pass(link, direction, length, now, free) else {
            link.count(direction, OVERFLOWN, 1);
            continue;
        };
        // Nothing overtakes.
        last = last.max(leaves + link.delay(&mut draws));
        link.carried(direction, length);
        if sender.send((last, buffer[..length].to_vec())).is_err() {
            return;
        }
    }
}

/// When a packet has left; `None` if it finds the queue full.
pub(crate) fn pass(link: &Link, direction: usize, bytes: usize, now: Instant, free: &Free) -> Option<Instant> {
    let rate = link.rate.load(Relaxed);
    if rate == 0 {
        return Some(now);
    }
    let place = if link.half_duplex.load(Relaxed) { 0 } else { direction };
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
        for what in ["rate", "delay", "jitter", "queue", "loss", "half_duplex", "cut"] {
            assert!(link.set(what, 0.5), "{what}");
            assert!(!link.set(what, f64::NAN) && !link.set(what, -1.0), "{what}");
        }
        assert!(!link.set("speed", 1.0));
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

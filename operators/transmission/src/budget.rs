//! How many bytes a sender may put on the air: by what its own radio knows of the channel, as the adaptive control of ETSI TS 102 687
//! (LIMERIC) does it.
//!
//! The sender's share of the channel's time goes towards K (T − b), where b is the part of the time in which the channel was busy.
//! All senders see the same b, so all get the same share: n of them take n K T / (1 + n K) of the channel together.

use realo_schemas::Nanos;
use realo_schemas::report::OnAir;

/// Part of the channel's time that senders would take if there were very many of them (T).
const TARGET: f64 = 0.92;
/// How much of the free part of that a sender takes (K).
const TAKES: f64 = 6.0;
/// Of the way to where a share should be, what it goes in a frame: in proportion to the share itself, so that many senders with a
/// small share each do not swing together. And its bounds.
const STEP: f64 = 0.1;
const STEPS: [f64; 2] = [0.01, 0.06];
/// The share of a sender that knows nothing of the channel.
const FIRST_SHARE: f64 = 0.02;
/// Bytes of a frame while nothing is known.
const FIRST_BYTES: usize = 2_000;
/// A sender that heard nothing for so long begins anew, ns.
const SILENCE: Nanos = 1_000_000_000;
/// Time between two frames, ns: what lies outside is a gap or a repetition.
const PERIODS: [Nanos; 2] = [10_000_000, 200_000_000];
/// What is left of a share after a packet was dropped.
const AFTER_DROP: f64 = 0.5;

/// The bytes of a sender's frames.
#[derive(Clone, Debug)]
pub struct Budget {
    max: usize,
    share: f64,
    /// Bytes that cross in a ns, infinite where bytes take no time; `None` until a packet has crossed.
    rate: Option<f64>,
    /// When the last word came.
    heard: Option<Nanos>,
    /// When the last frame was.
    frame: Option<Nanos>,
    /// All words since the last frame.
    since: OnAir,
}

impl Budget {
    /// Of a sender that knows nothing yet; no frame gets more than `max` bytes.
    pub fn new(max: usize) -> Self {
        Budget {
            max,
            share: FIRST_SHARE,
            rate: None,
            heard: None,
            frame: None,
            since: OnAir::default(),
        }
    }

    /// Takes the word of the sender's radio about one packet.
    pub fn heard(&mut self, word: &OnAir, now: Nanos) {
        self.heard = Some(now);
        self.since.dropped |= word.dropped;
        if word.dropped {
            return;
        }
        self.since.bytes = self.since.bytes.saturating_add(word.bytes);
        self.since.air_ns = self.since.air_ns.saturating_add(word.air_ns.max(0));
        self.since.span_ns = self.since.span_ns.saturating_add(word.span_ns.max(0));
        self.since.busy_ns = self.since.busy_ns.saturating_add(word.busy_ns.max(0));
    }

    /// Bytes of the frame that begins now.
    pub fn next(&mut self, now: Nanos) -> usize {
        let period = self.frame.map_or(PERIODS[1], |before| now.saturating_sub(before));
        let period = period.clamp(PERIODS[0], PERIODS[1]);
        self.frame = Some(now);
        let is_silent = self.heard.is_none_or(|heard| now.saturating_sub(heard) > SILENCE);
        if is_silent {
            *self = Budget {
                frame: self.frame,
                ..Budget::new(self.max)
            };
            return FIRST_BYTES.min(self.max);
        }
        self.learn();
        match self.rate {
            None => FIRST_BYTES.min(self.max),
            // What is infinite becomes the largest number.
            Some(rate) => self.max.min((self.share * rate * period as f64) as usize),
        }
    }

    /// Moves the share by all words since the last frame.
    fn learn(&mut self) {
        let OnAir {
            bytes,
            dropped,
            air_ns,
            span_ns,
            busy_ns,
        } = std::mem::take(&mut self.since);
        if bytes > 0 {
            self.rate = Some(bytes as f64 / air_ns as f64);
        }
        if dropped {
            self.share *= AFTER_DROP;
        } else if span_ns > 0 {
            let busy = (busy_ns as f64 / span_ns as f64).min(1.0);
            let step = (STEP * self.share / TARGET).clamp(STEPS[0], STEPS[1]);
            self.share += step * (TAKES * (TARGET - busy) - self.share);
        }
        self.share = self.share.clamp(FIRST_SHARE / 10.0, TARGET);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = 1_000_000;

    /// A word about a packet that took so long itself, and found the channel busy for so many of 100 ms.
    fn word(bytes: u64, air_ms: Nanos, busy_ms: Nanos) -> OnAir {
        OnAir {
            bytes,
            dropped: false,
            air_ns: air_ms * MS,
            span_ns: 100 * MS,
            busy_ns: busy_ms * MS,
        }
    }

    #[test]
    fn begins_low_and_goes_to_its_part_of_an_empty_channel() {
        let mut budget = Budget::new(1_000_000);
        // 20 bytes a ms: 2,000 of them in 100.
        let first = budget.next(0);
        assert_eq!(first, FIRST_BYTES);
        let mut bytes = first;
        for frame in 1..60 {
            let air = bytes as i64 / 200;
            budget.heard(&word(bytes as u64, air, air.min(100)), (100 * frame - 10) * MS);
            bytes = budget.next(100 * frame * MS);
        }
        assert!((15_000..17_000).contains(&bytes), "{bytes} of 20,000");
    }

    #[test]
    fn is_the_max_where_bytes_take_no_time() {
        let mut budget = Budget::new(60_000);
        budget.next(0);
        budget.heard(&word(2000, 0, 0), MS);
        assert_eq!(budget.next(100 * MS), 60_000);
    }

    #[test]
    fn a_dropped_packet_halves_the_share_once_a_frame_and_teaches_no_rate() {
        let mut budget = Budget::new(60_000);
        let dropped = OnAir {
            dropped: true,
            ..OnAir::default()
        };
        budget.next(0);
        budget.heard(&dropped, MS);
        assert_eq!(budget.next(100 * MS), FIRST_BYTES, "nothing is known of the rate");
        for frame in 2..40 {
            budget.heard(&word(2000, 10, 10), (100 * frame - 50) * MS);
            budget.next(100 * frame * MS);
        }
        let before = budget.next(4_000 * MS);
        budget.heard(&dropped, 4_001 * MS);
        budget.heard(&dropped, 4_002 * MS);
        let after = budget.next(4_100 * MS);
        assert!((before / 2).abs_diff(after) <= 1, "{before} {after}");
    }

    #[test]
    fn begins_anew_after_a_silence() {
        let mut budget = Budget::new(60_000);
        budget.next(0);
        budget.heard(&word(2000, 0, 0), MS);
        assert_eq!(budget.next(1_001 * MS), 60_000);
        assert_eq!(budget.next(1_100 * MS), FIRST_BYTES);
    }

    #[test]
    fn no_word_makes_a_budget_above_the_max() {
        let mut budget = Budget::new(5_000);
        for (frame, word) in [word(0, -5, 7), word(u64::MAX, 1, -9), word(1, i64::MAX / MS, 3)]
            .into_iter()
            .enumerate()
        {
            budget.heard(&word, frame as Nanos * 100 * MS);
            assert!(budget.next((frame as Nanos * 100 + 50) * MS) <= 5_000);
        }
    }
}

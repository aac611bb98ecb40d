//! What packets of a link share: a rate, a queue before it, and its course over time.

use std::collections::BTreeMap;

use realo_schemas::{Name, Nanos};

use crate::profile::Channel;

const SECOND: i128 = 1_000_000_000;
/// No packet takes longer to cross, ns.
const DAY: i128 = 86_400 * SECOND;

/// What the channel is like from a time on, until the next one says otherwise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Phase {
    /// From when, ns from the first packet.
    pub from: Nanos,
    /// Rate, bit/s; 0: nothing crosses.
    pub bits_per_second: u64,
    /// Added to the delay of packets that cross, ms.
    pub delay_ms: f64,
    /// Probability that a packet is lost, beside that of its kind.
    pub loss: f64,
}

/// A way between two agents, or the one way of all.
type Way = Option<(Name, Name)>;

/// What the packets of a link share, and until when it is taken.
#[derive(Clone, Debug)]
pub struct Medium {
    phases: Vec<Phase>,
    /// What a packet may wait, ns.
    queue: Nanos,
    half_duplex: bool,
    /// When the first packet came.
    begin: Option<Nanos>,
    taken: BTreeMap<Way, Taken>,
    /// By way and sender: the way when the sender's last packet had crossed.
    heard: BTreeMap<(Way, Name), Taken>,
}

/// How far a way is taken.
#[derive(Clone, Copy, Debug)]
struct Taken {
    /// Until when, ns.
    until: Nanos,
    /// Time that packets took on it until then, ns.
    busy: Nanos,
}

/// How a packet got through.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Passed {
    /// From when it was sent until its last bit had crossed, ns.
    pub delay: Nanos,
    /// From when it was sent until it had left its sender, ns: `delay` without what the phase adds.
    pub left: Nanos,
    /// Time that its own bits took, ns.
    pub air: Nanos,
    /// Since its sender's packet before it had crossed, and the part of that in which the way was taken, ns.
    pub since: Option<[Nanos; 2]>,
    /// Probability that it is lost, beside that of its kind.
    pub loss: f64,
}

impl Medium {
    /// As a profile says; nothing has crossed.
    pub fn new(channel: &Channel) -> Self {
        Medium {
            phases: channel.phases.clone(),
            queue: channel.queue_ms.map_or(Nanos::MAX, |queue| (queue * 1e6) as Nanos),
            half_duplex: channel.half_duplex,
            begin: None,
            taken: BTreeMap::new(),
            heard: BTreeMap::new(),
        }
    }

    /// Takes a packet; `None`: its queue is full.
    pub fn pass(&mut self, from: &Name, to: &Name, sent: Nanos, bytes: usize) -> Option<Passed> {
        let begin = *self.begin.get_or_insert(sent);
        let way = (!self.half_duplex).then(|| (from.clone(), to.clone()));
        let taken = self.taken.get(&way).copied().unwrap_or(Taken { until: sent, busy: 0 });
        let free = taken.until.max(sent);
        if free - sent > self.queue {
            return None;
        }
        let crossed = self.crossed(free.saturating_sub(begin), bytes).saturating_add(begin);
        let air = crossed.saturating_sub(free);
        let taken = Taken {
            until: crossed,
            busy: taken.busy.saturating_add(air),
        };
        self.taken.insert(way.clone(), taken);
        let before = self.heard.insert((way, from.clone()), taken);
        let since = before.map(|before| [crossed.saturating_sub(before.until), taken.busy - before.busy]);
        let phase = self.phases[self.phase_at(crossed.saturating_sub(begin))];
        let more = (phase.delay_ms * 1e6).round() as Nanos;
        Some(Passed {
            delay: crossed.saturating_add(more) - sent,
            left: crossed - sent,
            air,
            since,
            loss: phase.loss,
        })
    }

    /// When bytes that begin to cross at a time have done so.
    fn crossed(&self, begins: Nanos, bytes: usize) -> Nanos {
        let (mut at, latest) = (i128::from(begins), i128::from(begins) + DAY);
        // In 10⁻⁹ bit, so that nothing is rounded but the end.
        let mut left = 8 * bytes as i128 * SECOND;
        let mut index = self.phase_at(begins);
        loop {
            let rate = i128::from(self.phases[index].bits_per_second);
            let until = self.phases.get(index + 1).map_or(latest, |next| i128::from(next.from));
            let room = rate * (until - at);
            if left <= room && rate > 0 {
                return (at + (left + rate / 2) / rate).min(latest) as Nanos;
            }
            if until >= latest || index + 1 == self.phases.len() {
                return latest as Nanos;
            }
            left -= room;
            (at, index) = (until, index + 1);
        }
    }

    /// The phase of a time; before the first one it is the first.
    fn phase_at(&self, time: Nanos) -> usize {
        let after = self.phases.partition_point(|phase| phase.from <= time);
        after.saturating_sub(1)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: Nanos = 1_000_000;

    fn phase(from_ms: Nanos, bits_per_second: u64) -> Phase {
        Phase {
            from: from_ms * MS,
            bits_per_second,
            delay_ms: 0.0,
            loss: 0.0,
        }
    }

    fn medium(phases: Vec<Phase>, queue_ms: Option<f64>, half_duplex: bool) -> Medium {
        Medium::new(&Channel {
            phases,
            queue_ms,
            half_duplex,
        })
    }

    /// Delay of a packet of 1000 bytes, ms.
    fn delay(medium: &mut Medium, [from, to]: [&str; 2], sent_ms: Nanos) -> Option<f64> {
        let passed = medium.pass(&from.into(), &to.into(), sent_ms * MS, 1000)?;
        Some(passed.delay as f64 / MS as f64)
    }

    #[test]
    fn packets_wait_for_those_before_them_and_what_would_wait_too_long_is_lost() {
        // 8 ms a packet.
        let mut medium = medium(vec![phase(0, 1_000_000)], Some(10.0), false);
        let way = ["a", "b"];
        assert_eq!(delay(&mut medium, way, 100), Some(8.0));
        assert_eq!(delay(&mut medium, way, 100), Some(16.0), "behind the first");
        assert_eq!(delay(&mut medium, way, 105), None, "it would wait for 11 ms");
        assert_eq!(delay(&mut medium, way, 106), Some(18.0), "it waits for 10");
        assert_eq!(delay(&mut medium, ["b", "a"], 106), Some(8.0), "the other way is free");
        assert_eq!(delay(&mut medium, way, 200), Some(8.0));
    }

    #[test]
    fn on_a_medium_of_half_duplex_all_take_turns() {
        let mut medium = medium(vec![phase(0, 1_000_000)], None, true);
        assert_eq!(delay(&mut medium, ["a", "b"], 0), Some(8.0));
        assert_eq!(delay(&mut medium, ["b", "a"], 0), Some(16.0));
        assert_eq!(delay(&mut medium, ["c", "a"], 20), Some(8.0));
    }

    #[test]
    fn a_rate_changes_while_a_packet_crosses_and_an_outage_holds_it_up() {
        let phases = vec![phase(0, 1_000_000), phase(10, 0), phase(50, 500_000)];
        let mut medium = medium(phases.clone(), None, false);
        let way = ["a", "b"];
        assert_eq!(
            delay(&mut medium, way, 1000),
            Some(8.0),
            "its time begins with its first packet"
        );
        // 2 ms of it cross before the outage, the other 6 at half the rate behind it.
        assert_eq!(delay(&mut medium, way, 1000), Some(50.0 + 12.0));
        let mut ends = self::medium(phases[..2].to_vec(), None, false);
        assert_eq!(delay(&mut ends, way, 0), Some(8.0));
        assert_eq!(
            delay(&mut ends, way, 20),
            Some(86_400_000.0),
            "an outage that never ends"
        );
    }

    #[test]
    fn what_a_phase_adds_goes_with_the_packets_that_cross_in_it() {
        let far = Phase {
            delay_ms: 2.5,
            loss: 0.25,
            ..phase(8, 1_000_000)
        };
        let mut medium = medium(vec![phase(0, 2_000_000), far], None, false);
        let mut pass = |sent: Nanos| medium.pass(&"a".into(), &"b".into(), sent * MS, 1000).unwrap();
        assert_eq!((pass(0).delay, pass(0).loss), (4 * MS, 0.25));
        assert_eq!((pass(9).delay, pass(30).loss), (8 * MS + MS * 5 / 2, 0.25));
    }

    #[test]
    fn three_senders_of_the_measured_channel_have_6_7_kilobytes_each_per_100_ms() {
        let profile = crate::Profile::load("cv2x-measured").unwrap();
        let mut medium = Medium::new(profile.channel.as_ref().unwrap());
        let senders = ["cav2", "rsu1", "rsu2"];
        let mut frame = |at_ms: Nanos, bytes: usize| {
            let pass = |from: &str| medium.pass(&from.into(), &"cav1".into(), at_ms * MS, bytes);
            senders.map(pass).map(|passed| passed.map(|passed| passed.delay))
        };
        let third = 1_600_000 / 8 / 10 / 3;
        assert_eq!(third, 6666);
        for n in 0..20 {
            let last = frame(100 * n, third)[2].unwrap();
            assert!((99 * MS..=100 * MS).contains(&last), "frame {n}: {last}");
        }
        // A tenth more piles up until the queue is full.
        let lost = (20..60)
            .flat_map(|n| frame(100 * n, third * 11 / 10))
            .filter(Option::is_none);
        assert!((5..20).contains(&lost.count()));
    }

    #[test]
    fn a_sender_knows_its_own_time_on_the_channel_and_how_busy_it_was() {
        let mut medium = medium(vec![phase(0, 1_000_000)], None, true);
        let mut known = |from: &str, sent: Nanos| {
            let passed = medium.pass(&from.into(), &"c".into(), sent * MS, 1000).unwrap();
            (passed.air / MS, passed.since.map(|since| since.map(|time| time / MS)))
        };
        assert_eq!(known("a", 0), (8, None));
        assert_eq!(known("b", 0), (8, None));
        assert_eq!(
            known("a", 100),
            (8, Some([100, 16])),
            "its own packet and that of the other"
        );
        assert_eq!(known("b", 50), (8, Some([100, 16])), "behind the first");
    }

    proptest! {
        #[test]
        fn no_more_crosses_than_the_rate_allows_and_packets_stay_in_order(
            sizes in prop::collection::vec((0usize..5000, 0i64..20), 1..40),
            rate in 10_000u64..10_000_000,
        ) {
            let mut medium = medium(vec![phase(0, rate)], None, false);
            let (mut sent, mut before, mut bits) = (0, 0, 0.0);
            for (bytes, pause) in sizes {
                sent += pause * MS;
                let passed = medium.pass(&"a".into(), &"b".into(), sent, bytes).unwrap();
                let crossed = sent + passed.delay;
                prop_assert!(crossed >= before);
                bits += 8.0 * bytes as f64;
                prop_assert!(crossed as f64 >= bits / rate as f64 * 1e9 - 40.0);
                before = crossed;
            }
        }
    }
}

//! Senders that share a channel, each with a budget that follows what its own radio says of its packets.

use proptest::prelude::*;
use realo_link::{Channel, Medium, Phase, Profile};
use realo_schemas::Nanos;
use realo_schemas::report::OnAir;
use realo_transmission::Budget;

const MS: Nanos = 1_000_000;
const SECOND: Nanos = 1_000 * MS;
const PERIOD: Nanos = 100 * MS;
const MAX: usize = 1_000_000;

/// One that sends a packet each period, from a time on.
#[derive(Clone, Debug)]
struct Sender {
    begins: Nanos,
    /// Part of its budget that its packets take.
    takes: f64,
}

/// A packet that was sent.
#[derive(Clone, Copy, Debug)]
struct Sent {
    sender: usize,
    at: Nanos,
    bytes: usize,
    /// `None`: its queue was full.
    delay: Option<Nanos>,
}

/// All packets of so many ns.
fn simulate(channel: &Channel, senders: &[Sender], until: Nanos) -> Vec<Sent> {
    let mut medium = Medium::new(channel);
    let mut budgets = vec![Budget::new(MAX); senders.len()];
    let mut words: Vec<Vec<(Nanos, OnAir)>> = vec![Vec::new(); senders.len()];
    let mut times: Vec<(Nanos, usize)> = Vec::new();
    for (index, sender) in senders.iter().enumerate() {
        let frames = (0..).map(|frame| sender.begins + frame * PERIOD);
        times.extend(frames.take_while(|at| *at < until).map(|at| (at, index)));
    }
    times.sort_unstable();
    let mut sent = Vec::new();
    for (at, index) in times {
        let budget = &mut budgets[index];
        for (time, word) in words[index].extract_if(.., |(time, _)| *time <= at) {
            budget.heard(&word, time);
        }
        let bytes = (budget.next(at) as f64 * senders[index].takes) as usize;
        let from = format!("agent{index}");
        let passed = medium.pass(&from.as_str().into(), &"ego".into(), at, bytes);
        let [span_ns, busy_ns] = passed.and_then(|passed| passed.since).unwrap_or_default();
        let word = OnAir {
            bytes: bytes as u64,
            dropped: passed.is_none(),
            air_ns: passed.map_or(0, |passed| passed.air),
            span_ns,
            busy_ns,
        };
        words[index].push((at + passed.map_or(0, |passed| passed.left), word));
        let delay = passed.map(|passed| passed.delay);
        sent.push(Sent {
            sender: index,
            at,
            bytes,
            delay,
        });
    }
    sent
}

/// What all sent in a time by what the channel carries, and the longest delay.
fn load(sent: &[Sent], bits_per_second: u64, [from, to]: [Nanos; 2]) -> (f64, Nanos) {
    let within: Vec<&Sent> = sent.iter().filter(|sent| (from..to).contains(&sent.at)).collect();
    let bits: f64 = within.iter().map(|sent| 8.0 * sent.bytes as f64).sum();
    let capacity = bits_per_second as f64 * (to - from) as f64 / SECOND as f64;
    let delays = within.iter().map(|sent| sent.delay.unwrap_or(Nanos::MAX));
    (bits / capacity, delays.max().unwrap_or(0))
}

fn shared(bits_per_second: u64) -> Channel {
    Channel {
        phases: vec![phase(0, bits_per_second)],
        queue_ms: Some(100.0),
        half_duplex: true,
    }
}

fn phase(from: Nanos, bits_per_second: u64) -> Phase {
    Phase {
        from,
        bits_per_second,
        delay_ms: 0.0,
        loss: 0.0,
    }
}

fn sender() -> impl Strategy<Value = Sender> {
    (0..PERIOD, 0.96..=1.0f64).prop_map(|(begins, takes)| Sender { begins, takes })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn senders_take_most_of_a_channel_and_never_more_than_it_carries(
        senders in prop::collection::vec(sender(), 1..9),
        bits_per_second in 300_000u64..30_000_000,
        together: bool,
    ) {
        let mut senders = senders;
        if together {
            senders.iter_mut().for_each(|sender| sender.begins = 0);
        }
        let sent = simulate(&shared(bits_per_second), &senders, 15 * SECOND);
        for second in 4..15 {
            let (load, delay) = load(&sent, bits_per_second, [second * SECOND, (second + 1) * SECOND]);
            prop_assert!((0.7..=1.0).contains(&load), "second {}: {} of the channel", second, load);
            // A sweep is half a period old when it is sent: its age stays below two periods.
            prop_assert!(delay < PERIOD * 3 / 2, "second {}: {} ms", second, delay / MS);
        }
        let last = sent.iter().filter(|sent| sent.at >= 14 * SECOND);
        let mut bytes = vec![0; senders.len()];
        last.for_each(|sent| bytes[sent.sender] += sent.bytes);
        let (min, max) = (bytes.iter().min().unwrap(), bytes.iter().max().unwrap());
        prop_assert!(*max as f64 <= 1.5 * *min as f64, "shares of {:?}", bytes);
    }

    #[test]
    fn a_sender_that_comes_later_gets_its_share_and_a_rate_that_falls_is_followed(
        senders in prop::collection::vec(sender(), 2..6),
        rate in 500_000u64..10_000_000,
    ) {
        let mut senders = senders;
        senders[0].begins += 8 * SECOND;
        let channel = Channel { phases: vec![phase(0, rate), phase(20 * SECOND, rate / 4)], ..shared(rate) };
        let sent = simulate(&channel, &senders, 30 * SECOND);
        let seconds = |from: Nanos, to: Nanos| [from * SECOND, to * SECOND];
        let of = |sender: usize| sent.iter().filter(move |sent| sent.sender == sender && (18 * SECOND..19 * SECOND).contains(&sent.at));
        let [late, other] = [0, 1].map(|sender| of(sender).map(|sent| sent.bytes).sum::<usize>());
        prop_assert!(late as f64 > 0.6 * other as f64, "{} and {}", late, other);
        for (span, rate) in [(seconds(4, 8), rate), (seconds(12, 19), rate), (seconds(23, 30), rate / 4)] {
            let (load, delay) = load(&sent, rate, span);
            prop_assert!((0.7..=1.0).contains(&load), "{:?}: {} of the channel", span, load);
            prop_assert!(delay < PERIOD * 3 / 2, "{:?}: {} ms", span, delay / MS);
        }
    }
}

#[test]
fn three_senders_of_the_measured_channel_get_about_6_7_kilobytes_each() {
    let channel = Profile::load("cv2x-measured").unwrap().channel.unwrap();
    let sender = Sender { begins: 0, takes: 1.0 };
    let sent = simulate(&channel, &[sender.clone(), sender.clone(), sender], 10 * SECOND);
    for index in 0..3 {
        let last = sent.iter().rev().find(|sent| sent.sender == index).unwrap();
        assert!((5_200..6_667).contains(&last.bytes), "{last:?}");
    }
    assert!(
        sent.iter().all(|sent| sent.delay.is_some()),
        "no packet was dropped on the way there"
    );
}

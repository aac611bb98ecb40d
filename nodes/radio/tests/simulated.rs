//! The protocol over networks that are drawn at random, with peers that are: each seed is a network, what is sent, and what
//! goes wrong. `REALO_SEEDS=100000 cargo test --release -p realo-radio --test simulated` tries more of them, `REALO_SEEDS=93032..93033`
//! one; all that fail are reported at the end, a line each.

use std::any::Any;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, VecDeque};
use std::ops::Range;
use std::panic::catch_unwind;
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use rand_chacha::ChaCha8Rng;
use rand_core::{Rng, SeedableRng};
use realo_radio::protocol::{Frame, Offer, Outcome, Receiver, Sender, Settings, is_bulk};
use realo_schemas::{Kind, Nanos};

const MS: Nanos = 1_000_000;
const SECOND: Nanos = 1_000 * MS;
/// How long a network lives.
const LASTS: Nanos = 20 * SECOND;
/// Largest message that is offered.
const LARGEST: usize = 5_000_000;

struct Draws(ChaCha8Rng);

impl Draws {
    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * self.unit()
    }

    /// Between the two, each order of magnitude as often as the other.
    fn scaled(&mut self, from: f64, to: f64) -> f64 {
        self.between(from.ln(), to.ln()).exp()
    }

    fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }
}

/// One direction of a network.
#[derive(Clone, Debug)]
struct Way {
    /// Bytes a second, from each time on.
    rates: Vec<(Nanos, f64)>,
    delay: Nanos,
    jitter: Nanos,
    /// What the queue before the link holds, as time.
    queue: Nanos,
    loss: f64,
    duplicate: f64,
    /// When nothing passes.
    cuts: Vec<(Nanos, Nanos)>,
    /// When the link is free again.
    free: Nanos,
    /// Where frames go in a stream of TCP.
    stream: Option<SlowStart>,
}

/// TCP's window while nothing is lost: after every pause it begins with ten segments, and grows by what is acknowledged.
#[derive(Clone, Debug)]
struct SlowStart {
    /// What acknowledgements take.
    back: Nanos,
    /// Bytes that may be on the way.
    window: usize,
    /// When what is on the way is acknowledged, and its bytes.
    flying: VecDeque<(Nanos, usize)>,
    flying_bytes: usize,
}

impl SlowStart {
    const SEGMENT: usize = 1448;
    /// A pause after which a stream begins anew.
    const PAUSE: Nanos = 200 * MS;

    fn new(back: Nanos) -> SlowStart {
        SlowStart {
            back,
            window: 10 * Self::SEGMENT,
            flying: VecDeque::new(),
            flying_bytes: 0,
        }
    }

    /// When a segment that is there now goes out.
    fn opens(&mut self, now: Nanos, bytes: usize) -> Nanos {
        if self.flying.back().is_none_or(|(last, _)| now - last > Self::PAUSE) {
            *self = SlowStart::new(self.back);
        }
        let mut time = now;
        while let Some((acknowledged, of)) = self.flying.front().copied()
            && (acknowledged <= time || self.flying_bytes + bytes > self.window)
        {
            time = time.max(acknowledged);
            self.window += of;
            self.flying_bytes -= of;
            self.flying.pop_front();
        }
        time
    }

    fn goes(&mut self, acknowledged: Nanos, bytes: usize) {
        self.flying.push_back((acknowledged, bytes));
        self.flying_bytes += bytes;
    }
}

impl Way {
    fn draw(draws: &mut Draws) -> Way {
        let mut rates = vec![(0, draws.scaled(1e5, 2e7))];
        if draws.chance(0.3) {
            let from = draws.between(5e9, 12e9) as Nanos;
            rates.push((from, rates[0].1 * draws.scaled(0.2, 5.0)));
        }
        let mut cuts = Vec::new();
        if draws.chance(0.3) {
            let from = draws.between(2e9, 8e9) as Nanos;
            cuts.push((from, from + draws.between(0.05e9, 5e9) as Nanos));
        }
        Way {
            rates,
            delay: draws.scaled(0.1e6, 100e6) as Nanos,
            jitter: if draws.chance(0.4) {
                draws.between(0.0, 20e6) as Nanos
            } else {
                0
            },
            queue: draws.between(60e6, 400e6) as Nanos,
            loss: if draws.chance(0.4) {
                draws.scaled(0.001, 0.1)
            } else {
                0.0
            },
            duplicate: if draws.chance(0.3) {
                draws.between(0.0, 0.1)
            } else {
                0.0
            },
            cuts,
            free: 0,
            stream: None,
        }
    }

    fn rate(&self, now: Nanos) -> f64 {
        let known = self.rates.iter().rev().find(|(from, _)| *from <= now);
        known.map_or(self.rates[0].1, |(_, rate)| *rate)
    }

    /// When the copies of a frame that goes in now come out.
    fn pass(&mut self, now: Nanos, bytes: usize, draws: &mut Draws) -> Vec<Nanos> {
        let cut = self.cuts.iter().any(|(from, to)| (*from..*to).contains(&now));
        if let Some(mut stream) = self.stream.take() {
            let arrives = self.through(&mut stream, now, bytes);
            self.stream = Some(stream);
            return vec![arrives];
        }
        if cut || self.free - now > self.queue || draws.chance(self.loss) {
            return Vec::new();
        }
        self.free = self.free.max(now) + (bytes as f64 / self.rate(now) * 1e9) as Nanos;
        let copies = 1 + usize::from(draws.chance(self.duplicate));
        let mut arrival = || self.free + self.delay + (draws.unit() * self.jitter as f64) as Nanos;
        (0..copies).map(|_| arrival()).collect()
    }

    /// When a frame comes out of a stream.
    fn through(&mut self, stream: &mut SlowStart, now: Nanos, bytes: usize) -> Nanos {
        let mut left = bytes;
        while left > 0 {
            let segment = left.min(SlowStart::SEGMENT);
            let goes = stream.opens(now, segment);
            self.free = self.free.max(goes) + (segment as f64 / self.rate(now) * 1e9) as Nanos;
            stream.goes(self.free + self.delay + stream.back, segment);
            left -= segment;
        }
        self.free + self.delay
    }

    fn is_steady(&self) -> bool {
        self.rates.len() == 1 && self.cuts.is_empty() && self.loss == 0.0
    }
}

/// Messages of a kind, offered again and again.
#[derive(Clone, Debug)]
struct Stream {
    kind: Kind,
    bytes: usize,
    period: Nanos,
    /// Where in the period it is measured; streams that share it tell of the same moments.
    phase: Nanos,
}

impl Stream {
    fn bits(&self) -> f64 {
        self.bytes as f64 * 1e9 / self.period as f64
    }
}

fn streams(draws: &mut Draws) -> Vec<Stream> {
    let period = draws.between(50e6, 200e6) as Nanos;
    let mut streams = Vec::new();
    for (kind, min, most, often) in [
        (Kind::Points, 2e4, LARGEST as f64, 0.6),
        (Kind::Features, 5e3, 1.5e6, 0.6),
        (Kind::Boxes, 200.0, 5e3, 0.9),
        (Kind::AgentState, 300.0, 301.0, 0.7),
    ] {
        if draws.chance(often) {
            let together = draws.chance(0.5);
            streams.push(Stream {
                kind,
                bytes: draws.scaled(min, most) as usize,
                period: if kind == Kind::AgentState { 20 * MS } else { period },
                phase: if together {
                    0
                } else {
                    draws.between(0.0, 0.9 * period as f64) as Nanos
                },
            });
        }
    }
    streams
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Event {
    Offer(usize, u64),
    /// A frame without its part, and the part.
    Arrives(Bytes, Bytes),
    Acknowledged(Bytes),
    Wake,
}

/// What happened in a network.
#[derive(Debug, Default)]
struct Story {
    offered: BTreeMap<(Kind, u64), Nanos>,
    reported: BTreeMap<(Kind, u64), Outcome>,
    given: BTreeMap<(Kind, u64), Nanos>,
    largest_held: (usize, usize),
}

/// Where contents begin in what they are cut from: at as many places.
const PLACES: usize = 1 << 20;

/// Contents that tell the message, and in which each part differs from all others: cut, without a copy, from bytes that follow no rule.
fn contents(kind: Kind, seq: u64, bytes: usize) -> Bytes {
    static NOISE: LazyLock<Bytes> = LazyLock::new(|| {
        let mut noise = vec![0; PLACES + LARGEST];
        ChaCha8Rng::seed_from_u64(0).fill_bytes(&mut noise);
        noise.into()
    });
    // An odd factor: another place for each of the first 2^18 messages of four kinds, and far from that of the next.
    let place = (seq as usize * 4 + kind as usize).wrapping_mul(0x9_e377) % PLACES;
    NOISE.slice(place..place + bytes)
}

fn live(streams: &[Stream], [mut there, mut back]: [Way; 2], settings: &Settings, draws: &mut Draws) -> Story {
    let mut story = Story::default();
    let (mut sender, mut receiver) = (Sender::new(settings.clone(), 1), Receiver::new(LARGEST));
    let mut events = BinaryHeap::new();
    for (index, stream) in streams.iter().enumerate() {
        events.push(Reverse((stream.phase, 0u64, Event::Offer(index, 0))));
    }
    // The peer's clock is off, and runs 50 ppm faster.
    let peers = |now: Nanos| now + now / 20_000 - 123_456_789;
    let (mut number, mut wake) = (0u64, None);
    while let Some(Reverse((now, _, event))) = events.pop() {
        let mut push = |time: Nanos, event: Event| {
            number += 1;
            events.push(Reverse((time, number, event)));
        };
        match event {
            Event::Offer(index, seq) => {
                let stream = &streams[index];
                story.offered.insert((stream.kind, seq), now);
                sender.offer(Offer {
                    kind: stream.kind,
                    seq,
                    stamp: now,
                    born: now,
                    bytes: contents(stream.kind, seq, stream.bytes),
                });
                if now + stream.period < LASTS {
                    push(now + stream.period, Event::Offer(index, seq + 1));
                }
            }
            Event::Arrives(frame, part) => {
                let Ok(Frame::Part(head, _)) = Frame::parse(&frame) else {
                    panic!("a part came as something else");
                };
                let received = receiver.take(&head, part, peers(now)).expect("a part of its sender");
                if let Some(message) = received.message {
                    let stream = streams.iter().find(|stream| stream.kind == message.kind);
                    let stream = stream.expect("only what is offered comes in");
                    let same = message.bytes == contents(message.kind, message.seq, stream.bytes);
                    assert!(same, "{} {} came in as something else", message.kind, message.seq);
                    assert_eq!(message.stamp, story.offered[&(message.kind, message.seq)]);
                    let twice = story.given.insert((message.kind, message.seq), now);
                    assert_eq!(twice, None, "a message is given once");
                }
                if let Some(ack) = received.acknowledgement {
                    let frame = Frame::Acknowledgement(ack).to_bytes();
                    for time in back.pass(now, frame.len(), draws) {
                        push(time, Event::Acknowledged(frame.clone()));
                    }
                }
            }
            Event::Acknowledged(bytes) => {
                let Ok(Frame::Acknowledgement(ack)) = Frame::parse(&bytes) else {
                    panic!("an acknowledgement came as something else");
                };
                sender.acknowledged(&ack, now);
            }
            // Whoever heard of an earlier time does not ask at the later one.
            Event::Wake if wake != Some(now) => continue,
            Event::Wake => wake = None,
        }
        while let Some(frame) = sender.next(now) {
            let length = frame.len();
            let Frame::Part(head, part) = frame else {
                panic!("a sender sends parts");
            };
            // The part follows its head as it is: to copy it into a frame would take longer than all else.
            let frame = Frame::Part(head, Bytes::new()).to_bytes();
            for time in there.pass(now, length, draws) {
                push(time, Event::Arrives(frame.clone(), part.clone()));
            }
        }
        if let Some(time) = sender.wakes_at().map(|time| time.max(now + 1))
            && wake.is_none_or(|known| time < known)
        {
            wake = Some(time);
            push(time, Event::Wake);
        }
        for reported in sender.take_reported() {
            let twice = story.reported.insert((reported.kind, reported.seq), reported.outcome);
            assert_eq!(twice, None, "{reported:?}: a message has one outcome");
        }
        let (sending, receiving) = story.largest_held;
        story.largest_held = (sending.max(sender.held()), receiving.max(receiver.held()));
        assert!(now < 2 * LASTS, "everything comes to an end");
    }
    let open: BTreeSet<(Kind, u64)> = (story.offered.keys().copied())
        .filter(|message| !story.reported.contains_key(message))
        .collect();
    assert!(
        open.is_empty(),
        "after the last word every message has its outcome: {open:?}"
    );
    story
}

/// Ages in which messages of a kind came in, of those offered after `from`, ns.
fn ages(story: &Story, kind: Kind, from: Nanos) -> Vec<Nanos> {
    let given = story.given.iter().filter(|((of, _), _)| *of == kind);
    let ages = given.map(|(message, time)| (story.offered[message], time));
    ages.filter(|(offered, _)| *offered >= from)
        .map(|(offered, time)| time - offered)
        .collect()
}

fn check(seed: u64) {
    let mut draws = Draws(ChaCha8Rng::seed_from_u64(seed));
    let ways = [Way::draw(&mut draws), Way::draw(&mut draws)];
    let streams = streams(&mut draws);
    let settings = Settings::default();
    let story = live(&streams, ways.clone(), &settings, &mut draws);
    let [there, back] = &ways;
    let about = || format!("seed {seed}: {streams:?} over {there:?} and {back:?}");

    for (message, outcome) in &story.reported {
        let (kind, seq) = *message;
        // Where messages overtake each other, an older one is forgotten for a newer one.
        let newer = || story.given.range((kind, seq)..).any(|((of, _), _)| *of == kind);
        match outcome {
            Outcome::Sent if is_bulk(kind) => assert!(newer(), "{message:?} did not arrive; {}", about()),
            Outcome::Superseded => {
                let given = story.given.contains_key(message);
                assert!(!given, "{message:?} arrived all the same; {}", about());
            }
            _ => {}
        }
    }
    let largest = streams.iter().map(|stream| stream.bytes).max().unwrap_or(0);
    let (sending, receiving) = story.largest_held;
    assert!(
        sending <= 8 * largest && receiving <= 10 * largest,
        "{sending} {receiving}; {}",
        about()
    );

    let small: f64 = streams
        .iter()
        .filter(|stream| !is_bulk(stream.kind))
        .map(Stream::bits)
        .sum();
    let slowest = there.rates.iter().map(|(_, rate)| *rate).fold(f64::INFINITY, f64::min);
    let settled = 3 * SECOND;
    if there.is_steady() && back.is_steady() && small < 0.3 * slowest {
        // Before a small message stand the queue that bulk may fill, parts, and other small ones.
        let part = (16_384.0f64.min(slowest * 0.01).max(1024.0) / slowest * 1e9) as Nanos;
        let own = (12_000.0 / slowest * 1e9) as Nanos;
        let bound = there.delay + 2 * there.jitter + back.jitter + 3 * settings.queue + 8 * part + own;
        for kind in [Kind::Boxes, Kind::AgentState] {
            let worst = ages(&story, kind, settled).into_iter().max().unwrap_or(0);
            assert!(worst <= bound, "{kind} of age {worst} ns, bound {bound}; {}", about());
        }
        for kind in [Kind::Points, Kind::Features] {
            let worst = ages(&story, kind, settled).into_iter().max().unwrap_or(0);
            let bound = settings.deadline + bound;
            assert!(worst <= bound, "{kind} of age {worst} ns, bound {bound}; {}", about());
        }
    }

    // What fits easily arrives, once nothing is cut any more and however much is lost: one in every turn at least, which takes no longer
    // than the period or, of bulk, than a message of each kind beside what small ones take of the way. What shares the way with it
    // crosses until its deadline at most. A quarter of the turns is for what is lost, another one where the way changed: what it carries
    // is found anew by trials of which jitter hides some. A turn is for where counting begins. Nothing is promised where the queue is
    // too short for a part that goes while nothing is known of the rate: what follows that part is dropped.
    let healed = [there, back]
        .iter()
        .flat_map(|way| &way.cuts)
        .map(|(_, to)| *to)
        .max()
        .unwrap_or(0);
    let crossing = |stream: &Stream| stream.bytes as f64 / (there.rate(LASTS) - small) * 1e9;
    for stream in &streams {
        let alone = stream.bytes as f64 / slowest * 1e9;
        let round = (there.delay + back.delay + there.jitter + back.jitter) as f64;
        let holds = there.queue as f64 * slowest * 1e-9 > settings.part as f64;
        let fits = alone + 2.0 * round < 0.2 * settings.deadline as f64 && small < 0.3 * slowest && holds;
        let richer = streams
            .iter()
            .any(|other| other.kind < stream.kind && other.phase == stream.phase);
        if fits && !richer && there.loss.max(back.loss) < 0.03 {
            let from = (healed + 4 * SECOND).max(there.rates.last().map_or(0, |(from, _)| from + 4 * SECOND));
            let others = streams
                .iter()
                .filter(|other| is_bulk(other.kind) && is_bulk(stream.kind) && other.kind != stream.kind);
            let others: f64 = others.map(|other| crossing(other).min(settings.deadline as f64)).sum();
            let turn = (stream.period as f64).max(crossing(stream) + others);
            let offered = story.offered.iter();
            let offered = offered.filter(|((kind, _), time)| *kind == stream.kind && **time >= from);
            let turns = offered.count() as f64 * stream.period as f64 / turn;
            let arrived = ages(&story, stream.kind, from).len();
            let changed = healed > 0 || there.rates.len() + back.rates.len() > 2;
            let share = if changed { 0.5 } else { 0.75 };
            assert!(
                arrived as f64 >= share * (turns - 1.0),
                "{arrived} {} arrived in {turns:.1} turns; {}",
                stream.kind,
                about()
            );
        }
    }
}

/// Times without a message of a kind that came in, after `from` and to the end of what was offered, ns; the longest first.
fn pauses(story: &Story, kind: Kind, from: Nanos) -> Vec<Nanos> {
    let given = story.given.iter().filter(|((of, _), _)| *of == kind);
    let mut times: Vec<Nanos> = given.map(|(_, time)| *time).filter(|time| *time > from).collect();
    times.extend([from, LASTS]);
    times.sort_unstable();
    let mut pauses: Vec<Nanos> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    pauses.sort_unstable_by_key(|pause| Reverse(*pause));
    pauses
}

/// Two bulk kinds that tell of other moments offer more than a steady link carries.
///
/// They take turns: the kind that began longest ago begins next. While the other kind's message crosses, which it does for `other` or
/// until its deadline, the newest of this kind waits: when its turn comes it is no older than its period, nor than `other`. If it arrives in
/// time from there it is begun, and so one arrives in every turn of both: after it, the next is offered within the period, waits
/// for one message of the other kind, and crosses beside another one at most, which may not make it late. Every ten seconds the way is
/// emptied for a round trip, to see how long that takes; a message that becomes late by this costs its kind one turn more.
fn check_turns(seed: u64) {
    let mut draws = Draws(ChaCha8Rng::seed_from_u64(seed));
    let settings = Settings::default();
    let mut ways = [Way::draw(&mut draws), Way::draw(&mut draws)];
    for way in &mut ways {
        (way.loss, way.duplicate, way.jitter) = (0.0, 0.0, way.jitter / 10);
        way.delay = way.delay.min(40 * MS);
        way.rates = vec![(0, way.rates[0].1.max(4e5))];
        way.cuts.clear();
    }
    let rate = ways[0].rates[0].1;
    let deadline = settings.deadline as f64;
    let period = draws.between(50e6, 200e6);
    let mut stream = |kind, min: f64, most: f64, part: f64| {
        let crossing = draws.scaled(min, most) * deadline;
        Stream {
            kind,
            bytes: ((crossing * 1e-9 * rate) as usize).min(LARGEST),
            period: period as Nanos,
            phase: (draws.between(part, part + 0.3) * period) as Nanos,
        }
    };
    let bulk = [
        stream(Kind::Points, 0.1, 1.5, 0.0),
        stream(Kind::Features, 0.1, 0.5, 0.5),
    ];
    let small = Stream {
        kind: Kind::Boxes,
        bytes: 1_000,
        period: period as Nanos,
        phase: 0,
    };
    let streams = [bulk[0].clone(), bulk[1].clone(), small];
    if bulk.iter().map(Stream::bits).sum::<f64>() < 1.1 * rate {
        return;
    }
    let story = live(&streams, ways.clone(), &settings, &mut draws);
    let [there, back] = &ways;
    let about = || format!("seed {seed}: {streams:?} over {there:?} and {back:?}");
    let settled = 3 * SECOND;
    let round = there.delay + back.delay + there.jitter + back.jitter + settings.queue;
    let part = (16_384.0f64.min(rate * 0.01).max(1024.0) / rate * 1e9) as Nanos;
    let bound =
        there.delay + 2 * there.jitter + back.jitter + 3 * settings.queue + 8 * part + (12_000.0 / rate * 1e9) as Nanos;
    let worst = ages(&story, Kind::Boxes, settled).into_iter().max().unwrap_or(0);
    assert!(worst <= bound, "boxes of age {worst} ns, bound {bound}; {}", about());
    for (own, other) in [(&bulk[0], &bulk[1]), (&bulk[1], &bulk[0])] {
        let crossing = |stream: &Stream| (stream.bytes as f64 / rate * 1e9) as Nanos;
        let (alone, other) = (crossing(own), crossing(other).min(settings.deadline));
        // With a quarter of the deadline for what is not known exactly.
        if alone + round + other.min(own.period) > settings.deadline * 3 / 4 {
            continue;
        }
        let turn = own.period.max(alone + other);
        let most = own.period + 2 * (other + round) + alone;
        let pauses = pauses(&story, own.kind, settled);
        let emptied = 1 + (LASTS - settled) / (10 * SECOND);
        let arrived = ages(&story, own.kind, settled).len() as Nanos;
        for (place, pause) in (0..).zip(&pauses) {
            let most = if place < emptied { most + turn } else { most };
            assert!(
                *pause <= most,
                "no {} for {pause} ns, bound {most}; {}",
                own.kind,
                about()
            );
        }
        assert!(
            2 * arrived * turn >= LASTS - settled,
            "{arrived} {} arrived; {}",
            own.kind,
            about()
        );
    }
}

/// Messages in a stream of TCP, which begins slowly after every pause: such as the protocol makes while it awaits the time of its next trial.
/// What would arrive within three quarters of its deadline, with the round trips in which the stream's window grows, arrives again and again.
fn check_stream(seed: u64) {
    let mut draws = Draws(ChaCha8Rng::seed_from_u64(seed));
    let (deadline, delay, rate, grows) = loop {
        let (deadline, delay, rate) = (
            draws.scaled(0.4e9, 2e9),
            draws.scaled(1e6, 40e6),
            draws.scaled(5e5, 2e7),
        );
        // The window doubles in every round trip, until it holds what the way carries in one.
        let fills = rate * 2e-9 * delay / (10 * SlowStart::SEGMENT) as f64;
        let grows = 2.0 * delay * (fills.log2().max(0.0) + 1.0);
        if grows < 0.5 * deadline {
            break (deadline, delay as Nanos, rate, grows);
        }
    };
    let settings = Settings {
        deadline: deadline as Nanos,
        ..Settings::default()
    };
    let way = Way {
        rates: vec![(0, rate)],
        delay,
        jitter: 0,
        queue: 10 * SECOND,
        loss: 0.0,
        duplicate: 0.0,
        cuts: Vec::new(),
        free: 0,
        stream: Some(SlowStart::new(delay)),
    };
    let alone = draws.between(0.1, 1.0) * (0.75 * deadline - grows);
    let bytes = ((alone * 1e-9 * rate) as usize).min(LARGEST);
    let stream = Stream {
        kind: Kind::Points,
        bytes,
        period: draws.between(50e6, 200e6) as Nanos,
        phase: 0,
    };
    let ways = [way.clone(), Way { stream: None, ..way }];
    let story = live(std::slice::from_ref(&stream), ways, &settings, &mut draws);
    let from = 5 * SECOND;
    let arrived = ages(&story, stream.kind, from).len();
    let turns = (LASTS - from) as f64 / (alone + grows).max(stream.period as f64);
    assert!(
        arrived as f64 >= 0.5 * (turns - 1.0),
        "seed {seed}: {arrived} arrived in {turns:.1} turns of {stream:?} at {rate} bytes/s, {delay} ns, {settings:?}"
    );
}

/// Which seeds are tried: `REALO_SEEDS`, a number of them or `FROM..TO`, or as many as usual.
fn seeds(usual: u64) -> Range<u64> {
    let Ok(text) = std::env::var("REALO_SEEDS") else {
        return 0..usual;
    };
    let (from, to) = text.split_once("..").unwrap_or(("0", &text));
    match (from.parse(), to.parse()) {
        (Ok(from), Ok(to)) => from..to,
        _ => panic!("REALO_SEEDS: expected a number or FROM..TO, found `{text}`"),
    }
}

fn over_seeds(usual: u64, check: fn(u64)) {
    let seeds = seeds(usual);
    let next = AtomicU64::new(seeds.start);
    let some = || {
        let own = std::iter::from_fn(|| Some(next.fetch_add(1, Ordering::Relaxed)));
        own.take_while(|seed| *seed < seeds.end)
            .filter_map(|seed| catch_unwind(|| check(seed)).err().map(|panic| (seed, said(&*panic))))
            .collect::<Vec<(u64, String)>>()
    };
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let mut failed: Vec<(u64, String)> = std::thread::scope(|scope| {
        let running: Vec<_> = (0..threads).map(|_| scope.spawn(some)).collect();
        let parts = running.into_iter().map(|thread| thread.join());
        parts.flat_map(|part| part.expect("what panics is caught")).collect()
    });
    failed.sort_unstable();
    let lines: String = failed.iter().map(|(seed, why)| format!("\n{seed}: {why}")).collect();
    assert!(failed.is_empty(), "{} of the seeds {seeds:?}:{lines}", failed.len());
}

/// What a panic said, in a line.
fn said(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref().copied()).unwrap_or("not text");
    text.replace('\n', " ")
}

#[test]
fn holds_over_networks_drawn_at_random() {
    over_seeds(1000, check);
}

/// Way back out of order so that one acknowledgement covers a whole trial; jitter as long as a trial; small messages on a full link, in several
/// ways; a long way that was just found to carry more; small messages that leave no room, so that most of what begins is given up.
#[test]
fn holds_over_networks_that_showed_something() {
    [93_032, 12_332, 6_122, 14_583, 9_209, 15_926, 13_647]
        .into_iter()
        .for_each(check);
}

#[test]
fn streams_that_begin_slowly_carry_what_fits() {
    over_seeds(200, check_stream);
}

#[test]
fn kinds_take_turns_on_a_link_that_is_full() {
    over_seeds(500, check_turns);
}

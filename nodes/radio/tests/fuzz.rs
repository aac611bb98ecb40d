//! What somebody sends an agent, sound, made up or damaged, is taken or refused, and every refusal counts; nothing that was not signed
//! is taken where signatures are asked for, and memory stays within what was sent.
//!
//! Seeds are the frames of `corpus`. `REALO_FUZZ_CASES=1000000 cargo test --release -p realo-radio --test fuzz` runs as many cases.

mod corpus;

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;
use damage::{Draw, cases, most_held};
use realo_radio::body;
use realo_radio::protocol::Offer;
use realo_radio::refusal::Refusal;
use realo_radio::seal::WINDOW;
use realo_radio::station::{Moment, Station, Topic};
use realo_schemas::Kind;

use corpus::{MS, POINTS, Seed, cav1, corpus, moment, offer, seal, sends};

/// Why an agent refuses it; `None`: it is taken.
fn refusal(station: &mut Station, topic: Topic, bytes: &Bytes, now: Moment) -> Option<Refusal> {
    let before = station.refused().clone();
    station.take(&"rsu1".into(), topic, bytes, now);
    let more = station.refused().iter().filter_map(|(refusal, count)| {
        let more = count - before.get(refusal).unwrap_or(&0);
        (more > 0).then_some((*refusal, more))
    });
    match more.collect::<Vec<_>>()[..] {
        [] => None,
        [(refusal, 1)] => Some(refusal),
        ref several => panic!("refused more than once: {several:?}"),
    }
}

/// Digest of the frames of each topic. Another one means that agents of two releases do not understand each other.
const DIGESTS: [(&str, &str); 11] = [
    ("ack.open", "396f9ced213ad3f3"),
    ("ack.sealed", "c898c19140fcdc61"),
    ("body.open", "31b6396fed2094e6"),
    ("books.open", "87f39319dfb65128"),
    ("books.sealed", "5726f72bc6874dc7"),
    ("bulk.open", "0f6f975968061258"),
    ("bulk.sealed", "30b068fa6c899751"),
    ("clock.open", "7142d8dd71712592"),
    ("clock.sealed", "6ddd270b83b9f895"),
    ("small.open", "ee81d477c65c37cd"),
    ("small.sealed", "dabb6f8616798258"),
];

#[test]
fn frames_are_the_same_bytes_as_ever() {
    let mut groups: BTreeMap<String, blake3::Hasher> = BTreeMap::new();
    for seed in corpus() {
        let group = groups.entry(seed.group()).or_default();
        group
            .update(&(seed.bytes.len() as u64).to_le_bytes())
            .update(&seed.bytes);
    }
    let found: Vec<_> = (groups.into_iter())
        .map(|(group, digest)| (group, digest.finalize().to_hex()[..16].to_owned()))
        .collect();
    let found: Vec<_> = found.iter().map(|(group, digest)| (&**group, &**digest)).collect();
    assert_eq!(found, DIGESTS);
}

#[test]
fn no_two_frames_have_one_name() {
    let names: BTreeSet<String> = corpus().iter().map(Seed::name).collect();
    assert_eq!(names.len(), corpus().len());
}

#[test]
fn frames_are_taken_or_refused_as_expected() {
    let corpus = corpus();
    for seed in &corpus {
        let bytes = Bytes::from(seed.bytes.clone());
        let found = match seed.topic {
            Some(topic) => refusal(&mut cav1(seed.is_sealed), topic, &bytes, moment(0)),
            None => body::of_bytes(&bytes).is_none().then_some(Refusal::Malformed),
        };
        assert_eq!(found, seed.expected, "{}", seed.name());
    }
    let all: BTreeSet<_> = corpus.iter().map(|seed| (seed.topic, seed.is_sealed)).collect();
    assert_eq!(
        all.len(),
        2 * Topic::ALL.len() + 1,
        "every topic, sealed and not, and bodies"
    );
}

#[test]
fn any_two_of_the_corpus_are_taken_or_refused() {
    let corpus = corpus();
    let open = || corpus.iter().filter(|seed| !seed.is_sealed);
    for (first, second) in open().flat_map(|first| open().map(move |second| (first, second))) {
        let mut station = cav1(false);
        for (seed, now) in [(first, 10 * MS), (second, 20 * MS)] {
            if let Some(topic) = seed.topic {
                refusal(&mut station, topic, &seed.bytes.clone().into(), moment(now));
            }
            sends(&mut station, moment(now));
        }
    }
}

/// Frames to an agent one after the other, of which some are of the corpus, damaged, spliced, or signed by who may sign.
struct Attack<'a> {
    corpus: &'a [Seed],
    draw: Draw,
    is_sealed: bool,
    /// What was signed for cav1.
    signed: BTreeSet<(Topic, Vec<u8>)>,
    refused: BTreeMap<Refusal, u64>,
    taken: u64,
}

impl Attack<'_> {
    fn frame(&mut self, now: Moment) -> (Topic, Bytes) {
        let draw = &mut self.draw;
        let seed = &self.corpus[draw.below(self.corpus.len())];
        let usual = seed.topic.unwrap_or(Topic::Bulk);
        let topic = if draw.chance(8) { draw.pick(&Topic::ALL) } else { usual };
        let mut bytes = seed.bytes.clone();
        match draw.below(8) {
            0 => {
                let other = &self.corpus[draw.below(self.corpus.len())].bytes;
                let (at, from) = (draw.below(bytes.len()), draw.below(other.len()));
                bytes.truncate(at);
                bytes.extend(&other[from..]);
            }
            // A number of the head, which places and dates are.
            1..=3 if bytes.len() >= 44 => {
                let (at, width) = draw.pick(&[(4, 8), (12, 8), (20, 4), (24, 4), (28, 8), (36, 8)]);
                let mut old = [0; 8];
                old[..width].copy_from_slice(&bytes[at..at + width]);
                let new = draw.length(u64::from_le_bytes(old)).to_le_bytes();
                bytes[at..at + width].copy_from_slice(&new[..width]);
            }
            4 => {}
            _ => draw.damage(&mut bytes),
        }
        // Who is trusted may be hostile too.
        if self.is_sealed && draw.chance(2) {
            let date = now.wall + draw.pick(&[0, 0, 0, WINDOW + 1, -WINDOW - 1]);
            bytes = seal("rsu1").close("cav1", topic, &bytes, date).to_vec();
            self.signed.insert((topic, bytes.clone()));
        }
        (topic, bytes.into())
    }

    fn run(&mut self, station: &mut Station) -> usize {
        let (mut now, mut sent) = (0, 0);
        for number in 0..=self.draw.below(24) as u64 {
            let (topic, bytes) = self.frame(moment(now));
            sent += bytes.len();
            match refusal(station, topic, &bytes, moment(now)) {
                Some(refusal) => *self.refused.entry(refusal).or_default() += 1,
                None => {
                    self.taken += 1;
                    let signed = !self.is_sealed || self.signed.contains(&(topic, bytes.to_vec()));
                    assert!(signed, "taken on {topic:?} though nobody signed it: {bytes:?}");
                }
            }
            let _ = body::of_bytes(&bytes);
            if self.draw.chance(3) {
                now += self.draw.pick(&[0, MS, 50 * MS, 600 * MS, 3_000 * MS]);
                let fresh = Offer {
                    born: now,
                    ..offer(Kind::Points, POINTS + number, 3_000)
                };
                station.offer(&fresh);
            }
            sends(station, moment(now));
            let _ = (station.wakes_at(), station.clock_of("rsu1", moment(now)));
        }
        station.take_events(moment(now));
        assert_eq!(*station.refused(), self.refused, "refusals add up");
        let reported: u64 = (station.reports(moment(now)).iter())
            .flat_map(|report| report.refused.values())
            .sum();
        assert_eq!(reported, self.refused.values().sum::<u64>());
        station.end();
        sent
    }
}

/// Lists of parts, a few windows of what the agent itself sends, and of a sheet's line of 20 bytes a fate with two names, which
/// is held three times while lists grow.
fn bound(bytes: usize) -> u64 {
    (256 << 10) + 24 * bytes as u64
}

#[test]
fn forged_frames_are_taken_or_refused() {
    let corpus = corpus();
    let (mut taken, mut refused) = (0, 0);
    for case in 0..cases(4_000) {
        let is_sealed = case % 2 == 1;
        let fits = |seed: &Seed| seed.is_sealed == is_sealed || seed.topic.is_none() || case % 8 < 2;
        let corpus: Vec<Seed> = corpus.iter().filter(|seed| fits(seed)).cloned().collect();
        let signed = corpus.iter().filter(|seed| {
            let nobody = [Refusal::Forged, Refusal::Unsigned];
            seed.is_sealed && !seed.expected.is_some_and(|refusal| nobody.contains(&refusal))
        });
        let mut signed: BTreeSet<_> = signed
            .filter_map(|seed| Some((seed.topic?, seed.bytes.clone())))
            .collect();
        // It comes on the topic for which it was signed here and there.
        let other = corpus.iter().filter(|seed| seed.case == "other_topic");
        signed.extend(other.map(|seed| (Topic::Bulk, seed.bytes.clone())));
        let mut attack = Attack {
            corpus: &corpus,
            draw: Draw::new(case),
            is_sealed,
            signed,
            refused: BTreeMap::new(),
            taken: 0,
        };
        let mut station = cav1(is_sealed);
        let mut sent = 0;
        let held = most_held(|| sent = attack.run(&mut station));
        assert!(held <= bound(sent), "case {case} of {sent} bytes took {held} bytes");
        taken += attack.taken;
        refused += attack.refused.values().sum::<u64>();
    }
    assert!(
        taken > refused / 20 && refused > taken / 20,
        "{taken} taken, {refused} refused"
    );
}

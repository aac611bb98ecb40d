//! Agents among each other, over ways that lose, delay and copy: what every receiver's books say adds up.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

use bytes::Bytes;
use ed25519_dalek::SigningKey;
use proptest::prelude::*;
use rand_chacha::ChaCha8Rng;
use rand_core::{Rng, SeedableRng};
use realo_radio::keys::{Own, Trusted};
use realo_radio::offset::Basis;
use realo_radio::protocol::{Arrived, Frame, Head, Offer, Settings};
use realo_radio::refusal::Refusal;
use realo_radio::seal::{Seal, WINDOW};
use realo_radio::station::{Event, MOST_BYTES, MOST_PEERS, MessageId, Moment, Station, Topic};
use realo_schemas::report::Fate;
use realo_schemas::{Kind, Name, Nanos};

const MS: Nanos = 1_000_000;
const SECOND: Nanos = 1_000 * MS;

/// What happens next, in order of time.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Next {
    Offer(usize, u64),
    Arrives(usize, Name, Topic, Vec<u8>),
    /// As [`Next::Arrives`], from somebody who hears and sends, but has no key that is trusted.
    Injected(usize, Name, Topic, Vec<u8>),
    Down(usize, Name),
    Up(usize, Name),
    /// An agent starts anew, its time line so much further.
    Restart(usize, Nanos),
    Wake,
}

/// What an agent knows of another one's messages.
#[derive(Default)]
struct Account {
    sent: u64,
    arrived: BTreeSet<(Kind, u64)>,
    gone: BTreeMap<(Kind, u64), Fate>,
}

struct World {
    stations: Vec<Station>,
    names: Vec<Name>,
    queue: BinaryHeap<Reverse<(Nanos, u64, Next)>>,
    count: u64,
    draws: ChaCha8Rng,
    loss: f64,
    /// By receiver and sender.
    accounts: BTreeMap<(usize, Name), Account>,
    /// How far each agent's time line lies from the world's.
    lines: Vec<Nanos>,
    /// When each agent started, and by how much its line moved then.
    started: Vec<Nanos>,
    moved: Vec<Nanos>,
    /// What agents say that their clocks are off by at most.
    error: Nanos,
    is_hostile: bool,
    /// Frames that were injected and came in.
    injected: u64,
}

/// Seals of agents that trust each other.
fn seals(names: &[Name]) -> Vec<Seal> {
    let own = |n: usize| Own {
        agent: names[n].clone(),
        key: SigningKey::from_bytes(&[n as u8 + 1; 32]),
    };
    let mut trusted = Trusted::default();
    (0..names.len()).for_each(|n| trusted.0.extend(own(n).public().0));
    (0..names.len())
        .map(|n| Seal::new("site", own(n), trusted.clone()))
        .collect()
}

impl World {
    fn new(agents: usize, seed: u64, loss: f64) -> World {
        let names: Vec<Name> = (0..agents).map(|n| Name::from(format!("agent{n}"))).collect();
        let station = |name: &Name| Station::new(name.clone(), Settings::default(), 4 << 20, 7, None);
        World {
            stations: names.iter().map(station).collect(),
            is_hostile: false,
            injected: 0,
            names,
            queue: BinaryHeap::new(),
            count: 0,
            draws: ChaCha8Rng::seed_from_u64(seed),
            loss,
            accounts: BTreeMap::new(),
            lines: (0..agents as i64).map(|n| n * 123 * MS).collect(),
            started: vec![0; agents],
            moved: vec![0; agents],
            error: MS / 100,
        }
    }

    /// All sign, and somebody injects what he can.
    fn hostile(agents: usize, seed: u64, loss: f64) -> World {
        let world = World::new(agents, seed, loss);
        let sealed = world.names.iter().zip(seals(&world.names));
        let station =
            |(name, seal): (&Name, Seal)| Station::new(name.clone(), Settings::default(), 4 << 20, 7, Some(seal));
        World {
            stations: sealed.map(station).collect(),
            is_hostile: true,
            ..world
        }
    }

    /// Sends something that was heard on the way once more: changed, in another name, about something else, or to somebody else.
    fn inject(&mut self, at: Nanos, to: usize, from: &Name, topic: Topic, bytes: &Bytes) {
        let mut bytes = bytes.to_vec();
        let (mut to, mut from, mut topic) = (to, from.clone(), topic);
        match (self.unit() * 5.0) as usize {
            0 => {
                let place = (self.unit() * bytes.len() as f64) as usize;
                bytes[place] ^= 1 << (self.unit() * 8.0) as usize;
            }
            1 => from = "mallory".into(),
            2 => topic = Topic::ALL[(topic as usize + 1) % 5],
            3 if self.names.len() > 2 => {
                to = (0..self.names.len())
                    .find(|other| *other != to && self.names[*other] != from)
                    .expect("a third");
            }
            _ => bytes.truncate((self.unit() * bytes.len() as f64) as usize),
        }
        self.at(at, Next::Injected(to, from, topic, bytes));
    }

    fn at(&mut self, time: Nanos, next: Next) {
        self.count += 1;
        self.queue.push(Reverse((time, self.count, next)));
    }

    fn unit(&mut self) -> f64 {
        (self.draws.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn moment(&self, agent: usize, now: Nanos) -> Moment {
        Moment {
            steady: now,
            log: Some(now + self.lines[agent]),
            wall: now,
            // The last one says nothing of its clock.
            wall_error: (agent + 1 < self.lines.len()).then_some(self.error),
        }
    }

    /// Lets everybody send, and takes what came.
    fn turn(&mut self, now: Nanos) {
        for agent in 0..self.stations.len() {
            let moment = self.moment(agent, now);
            while let Some(outgoing) = self.stations[agent].next(moment) {
                // Strangers get answers too.
                let Some(to) = self.names.iter().position(|name| *name == outgoing.to) else {
                    continue;
                };
                let lost = self.unit() < self.loss;
                let arrives = now + 5 * MS + (self.unit() * 10.0 * MS as f64) as Nanos;
                let from = self.names[agent].clone();
                if self.is_hostile && self.unit() < 0.1 {
                    self.inject(arrives, to, &from, outgoing.topic, &outgoing.bytes);
                }
                if !lost {
                    let next = Next::Arrives(to, from, outgoing.topic, outgoing.bytes.to_vec());
                    self.at(arrives, next.clone());
                    if self.unit() < 0.05 {
                        self.at(arrives + 3 * MS, next);
                    }
                }
            }
            let events = self.stations[agent].take_events(moment);
            self.assert_placed(agent, &events);
            self.note(agent, events);
            if let Some(wakes) = self.stations[agent].wakes_at() {
                self.at(wakes.max(now + MS), Next::Wake);
            }
        }
    }

    /// What is given to the graph is placed in time by the clock that its sender had when it was offered.
    fn assert_placed(&self, agent: usize, events: &[Event]) {
        for event in events {
            let Event::Arrived(from, message, clock) = event else {
                continue;
            };
            let sender = self.names.iter().position(|name| name == from).expect("an agent");
            let is_of_now = message.stamp >= self.started[sender];
            let line = self.lines[sender] - if is_of_now { 0 } else { self.moved[sender] };
            let offset = line - self.lines[agent];
            assert!((clock.offset - offset).abs() <= clock.bound + MS, "{clock:?}, {offset}");
        }
    }

    fn note(&mut self, agent: usize, events: Vec<Event>) {
        for event in events {
            match event {
                Event::Arrived(from, Arrived { kind, seq, .. }, _)
                | Event::Skipped(from, MessageId { kind, seq, .. }) => {
                    let account = self.accounts.entry((agent, from)).or_default();
                    assert!(account.arrived.insert((kind, seq)), "given twice");
                }
                Event::OnAir(..) => {}
                Event::Books(from, news) => {
                    let account = self.accounts.entry((agent, from)).or_default();
                    account.sent += news.traffic.values().map(|traffic| traffic.sent).sum::<u64>();
                    for fated in news.fates {
                        let key = (fated.message.kind, fated.message.seq);
                        assert!(
                            account.gone.insert(key, fated.fate).is_none(),
                            "reported twice: {fated:?}"
                        );
                    }
                }
            }
        }
    }

    fn live(&mut self, until: Nanos, sizes: &[(Kind, usize)]) {
        let agents = self.stations.len();
        for agent in 0..agents {
            for other in (0..agents).filter(|other| *other != agent) {
                let name = self.names[other].clone();
                self.at(0, Next::Up(agent, name));
            }
            self.at((agent as Nanos + 1) * 7 * MS, Next::Offer(agent, 0));
        }
        let mut last = -1;
        while let Some(Reverse((now, _, next))) = self.queue.pop() {
            if now > until + 6 * SECOND {
                break;
            }
            match next {
                Next::Offer(agent, seq) => {
                    for (kind, bytes) in sizes {
                        self.stations[agent].offer(&Offer {
                            kind: *kind,
                            seq,
                            stamp: now,
                            born: now,
                            bytes: vec![seq as u8; *bytes].into(),
                        });
                    }
                    if now < until {
                        self.at(now + 100 * MS, Next::Offer(agent, seq + 1));
                    }
                }
                Next::Arrives(to, from, topic, bytes) => {
                    let moment = self.moment(to, now);
                    self.stations[to].take(&from, topic, &Bytes::from(bytes), moment);
                }
                Next::Injected(to, from, topic, bytes) => {
                    let moment = self.moment(to, now);
                    self.stations[to].take(&from, topic, &Bytes::from(bytes), moment);
                    self.injected += 1;
                }
                Next::Up(agent, name) => {
                    let moment = self.moment(agent, now);
                    self.stations[agent].up(&name, moment);
                }
                Next::Down(agent, name) => self.stations[agent].down(&name),
                Next::Restart(agent, later) => {
                    self.lines[agent] += later;
                    (self.started[agent], self.moved[agent]) = (now, later);
                    let name = self.names[agent].clone();
                    self.accounts.retain(|(to, from), _| *to != agent && *from != name);
                    self.stations[agent] = Station::new(name, Settings::default(), 4 << 20, 8, None);
                    for other in (0..agents).filter(|other| *other != agent) {
                        let name = self.names[other].clone();
                        self.at(now, Next::Up(agent, name));
                    }
                }
                // Many ask for the same wake.
                Next::Wake if now == last => continue,
                Next::Wake => last = now,
            }
            self.turn(now);
        }
        for agent in 0..agents {
            let events = self.stations[agent].end();
            self.note(agent, events);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    #[test]
    fn the_books_of_every_receiver_add_up(
        agents in 2usize..4,
        seed in any::<u64>(),
        loss in prop::sample::select(vec![0.0, 0.01, 0.1]),
        bulk in 1_000usize..200_000,
        outage in any::<bool>(),
        hostile in any::<bool>(),
    ) {
        let mut world = if hostile { World::hostile(agents, seed, loss) } else { World::new(agents, seed, loss) };
        if outage {
            let (first, second) = (world.names[0].clone(), world.names[1].clone());
            world.at(SECOND, Next::Down(0, second.clone()));
            world.at(SECOND + 3 * MS, Next::Down(1, first.clone()));
            world.at(2 * SECOND, Next::Up(0, second));
            world.at(2 * SECOND, Next::Up(1, first));
        }
        world.live(3 * SECOND, &[(Kind::Boxes, 900), (Kind::Features, bulk)]);
        for ((agent, from), account) in &world.accounts {
            let both: Vec<_> = account.gone.keys().filter(|key| account.arrived.contains(key)).collect();
            // What its sender gave up may arrive all the same, and counts as what the graph makes of it.
            let known: BTreeSet<_> = account.arrived.iter().chain(account.gone.keys()).collect();
            prop_assert_eq!(account.sent, known.len() as u64, "{} of {}: {:?}", agent, from, both);
            if loss == 0.0 && !outage {
                prop_assert!(account.arrived.len() as u64 + 12 >= account.sent, "{:?}", account.gone);
                let clock = world.stations[*agent].clock_of(from, world.moment(*agent, 3 * SECOND)).unwrap();
                let other = world.names.iter().position(|name| name == from).unwrap();
                let offset = world.lines[other] - world.lines[*agent];
                prop_assert!((clock.offset - offset).abs() <= 6 * MS, "{:?}, {}", clock, offset);
                // Both say what their clocks are off by, unless one is the last.
                let is_said = agent.max(&other) + 1 < agents;
                prop_assert_eq!(clock.basis, if is_said { Basis::Machines } else { Basis::Exchanges });
                prop_assert!(!is_said || clock.offset == offset, "{:?}, {}", clock, offset);
            }
        }
        prop_assert_eq!(world.accounts.len(), agents * (agents - 1));
        let refused: u64 = world.stations.iter().flat_map(|station| station.refused().values()).sum();
        prop_assert!(refused == world.injected && (world.injected > 0) == hostile, "{} of {}", refused, world.injected);
    }

    #[test]
    fn any_bytes_on_any_topic_do_no_harm(frames in prop::collection::vec((0usize..5, prop::collection::vec(any::<u8>(), 0..200)), 0..50)) {
        let mut world = World::new(1, 1, 0.0);
        let from = Name::from("stranger");
        for (k, (topic, bytes)) in frames.into_iter().enumerate() {
            let moment = world.moment(0, k as Nanos * MS);
            world.stations[0].take(&from, Topic::ALL[topic], &bytes.into(), moment);
        }
        world.turn(SECOND);
        world.stations[0].end();
    }
}

#[test]
fn what_an_agent_says_after_a_restart_is_placed_by_its_new_clock() {
    for (seed, later) in [(1, 200 * MS), (2, -200 * MS), (3, 3_600 * SECOND), (4, 0)] {
        let mut world = World::new(3, seed, 0.01);
        world.at(1_234 * MS, Next::Restart(1, later));
        world.live(3 * SECOND, &[(Kind::Boxes, 900), (Kind::Features, 60_000)]);
        let given = &world.accounts[&(0, world.names[1].clone())].arrived;
        assert!(given.len() >= 25, "{later} ns later: {given:?}");
    }
}

#[test]
fn who_has_gone_makes_room_and_who_is_there_stays() {
    let mut world = World::new(1, 1, 0.0);
    let station = &mut world.stations[0];
    let moment = |time| Moment {
        steady: time,
        log: Some(time),
        wall: time,
        wall_error: None,
    };
    let name = |n: usize| Name::from(format!("peer{n}"));
    for n in 0..MOST_PEERS {
        station.up(&name(n), moment(n as Nanos));
    }
    station.up(&name(MOST_PEERS), moment(SECOND));
    assert_eq!(station.refused()[&Refusal::Stranger], 1, "all are there");
    station.down(&name(5));
    station.down(&name(3));
    station.up(&name(MOST_PEERS), moment(SECOND));
    station.take(&name(MOST_PEERS + 1), Topic::Clock, &Bytes::new(), moment(SECOND));
    let known: Vec<Name> = station
        .reports(moment(SECOND))
        .into_iter()
        .map(|report| report.peer)
        .collect();
    assert_eq!(known.len(), MOST_PEERS);
    assert!(!known.contains(&name(3)) && !known.contains(&name(5)), "{known:?}");
    let me = Name::from("agent0");
    station.up(&me, moment(SECOND));
    assert_eq!(station.refused()[&Refusal::Stranger], 2, "nobody is one's own peer");
}

#[test]
fn what_peers_leave_incomplete_takes_so_much_memory_at_most() {
    let mut world = World::new(1, 1, 0.0);
    let (moment, station) = (world.moment(0, 0), &mut world.stations[0]);
    let (largest, parts) = (4usize << 20, 4_000u32);
    let part = Bytes::from(vec![1; 1000]);
    let mut kept = 0;
    for peer in 0..20 {
        for index in 0..parts - 1 {
            let head = Head {
                kind: Kind::Points,
                asks: false,
                waits: false,
                session: 1,
                seq: 1,
                index,
                count: parts,
                sent: 0,
                stamp: 0,
            };
            let frame = Frame::Part(head, part.clone()).to_bytes();
            station.take(&format!("peer{peer}").into(), Topic::Bulk, &frame, moment);
            kept = kept.max(station.kept());
        }
    }
    assert!((3 * largest..=4 * largest).contains(&kept), "{kept}");
    let forgotten: u64 = station
        .reports(moment)
        .iter()
        .map(|report| report.received.forgotten)
        .sum();
    assert!(forgotten >= 15, "{forgotten}");
}

#[test]
fn what_was_sent_before_does_not_come_in_again_even_after_a_restart() {
    let mut world = World::hostile(2, 3, 0.0);
    let (first, names) = (world.moment(0, SECOND), world.names.clone());
    world.stations[1].up(&names[0], first);
    world.stations[1].offer(&Offer {
        kind: Kind::Boxes,
        seq: 0,
        stamp: 0,
        born: SECOND,
        bytes: Bytes::from_static(b"boxes"),
    });
    let sent = std::iter::from_fn(|| world.stations[1].next(first)).find(|out| out.topic == Topic::Small);
    let bytes = sent.expect("it goes out at once").bytes;
    let arrived = |station: &mut Station, now: Moment| {
        station.take(&names[1], Topic::Small, &bytes, now);
        // Of its sender nothing is known that would place it.
        let events = station.take_events(now).into_iter().chain(station.end());
        let given = |event: &Event| matches!(event, Event::Arrived(..) | Event::Skipped(..));
        events.filter(given).count()
    };
    assert_eq!(arrived(&mut world.stations[0], first), 1);
    assert_eq!(arrived(&mut world.stations[0], first), 0, "its number has come in");
    let later = world.moment(0, SECOND + WINDOW + 1);
    let seal = seals(&names).swap_remove(0);
    let mut anew = Station::new(names[0].clone(), Settings::default(), 4 << 20, 8, Some(seal));
    assert_eq!(arrived(&mut anew, later), 0);
    assert_eq!(anew.refused()[&Refusal::Replayed], 1);
    let reports = anew.reports(later);
    assert_eq!(
        (&*reports[0].peer, reports[0].refused[&Refusal::Replayed]),
        ("agent1", 1)
    );
}

#[test]
fn what_no_frame_can_be_is_refused_by_its_size_alone() {
    let mut world = World::hostile(2, 3, 0.0);
    let (moment, from) = (world.moment(0, 0), world.names[1].clone());
    world.stations[0].take(&from, Topic::Bulk, &vec![0; MOST_BYTES + 1].into(), moment);
    world.stations[0].up(&"mallory".into(), moment);
    let expected = [(Refusal::Oversized, 1), (Refusal::Stranger, 1)];
    assert_eq!(*world.stations[0].refused(), expected.into());
}

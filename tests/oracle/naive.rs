//! DESIGN §4 and §7 once more, stage after stage over the whole history: no events, and no queue but a line of those who
//! wait.

use std::collections::{BTreeMap, BTreeSet};

use realo_link::{Arrivals, StreamKey, transmit};
use realo_schemas::{Kind, Nanos};

use crate::account::{Account, Answer, Fusion, Id, Line};
use crate::world::{EGO, MS, Sweep, World};

/// Greatest difference of stamps offline, inclusive.
const REACH: Nanos = 50 * MS;

/// A sweep's message at some point of the graph.
#[derive(Clone, Copy)]
struct At<'w> {
    sweep: &'w Sweep,
    ready: Nanos,
}

fn id(sweep: &Sweep) -> Id {
    (sweep.agent.clone(), sweep.seq)
}

/// Order of what happens in a stage at one instant.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Class {
    ServerFree,
    State,
    Data,
    Wake,
    Query,
}

/// Place among the calls of a stage: time, class, port, agent, seq.
type Place<'w> = (Nanos, Class, usize, &'w str, u64);

/// Ports that keep everything: the calls of a stage in order. Each agent has a server of its own, so that
/// start = max(input ready, server free); who waited comes before all else of the instant in which it starts.
fn serve_all<'w, T>(mut arrivals: Vec<(Place<'w>, T)>, compute: Nanos) -> Vec<(Place<'w>, T)> {
    arrivals.sort_by_key(|(place, _)| *place);
    let mut free = BTreeMap::new();
    for (place, _) in &mut arrivals {
        let agent = place.3;
        let free = free.entry(agent).or_insert(Nanos::MIN);
        if *free > place.0 {
            *place = (*free, Class::ServerFree, 0, agent, 0);
        }
        *free = place.0 + compute;
    }
    arrivals.sort_by_key(|(place, _)| *place);
    arrivals
}

/// A port that keeps the newest of each agent: what the stage was called with, then ready when the call is done, and
/// what it passed over.
fn serve_latest<'w>(arrivals: &[At<'w>], compute: Nanos) -> (Vec<At<'w>>, Vec<At<'w>>) {
    let (mut done, mut passed_over) = (Vec::new(), Vec::new());
    let agents: BTreeSet<&str> = arrivals.iter().map(|at| &*at.sweep.agent).collect();
    for agent in agents {
        let mut arrivals: Vec<At> = arrivals.iter().filter(|at| at.sweep.agent == agent).copied().collect();
        arrivals.sort_by_key(|at| (at.ready, at.sweep.seq));
        let mut free = Nanos::MIN;
        let mut waiting: Option<At> = None;
        let mut call = |at: At<'w>, start: Nanos| {
            let ready = start + compute;
            done.push(At { ready, ..at });
            ready
        };
        for at in arrivals {
            if let Some(first) = waiting.take_if(|_| free <= at.ready) {
                free = call(first, free);
            }
            if free <= at.ready {
                free = call(at, at.ready);
            } else if waiting.is_some_and(|waiting| waiting.sweep.stamp > at.sweep.stamp) {
                passed_over.push(at);
            } else {
                passed_over.extend(waiting.replace(at));
            }
        }
        waiting.map(|last| call(last, free));
    }
    (done, passed_over)
}

/// Size of a packet, by the layout that `realo-transmission` documents.
fn bytes(sweep: &Sweep) -> usize {
    let envelope = 21 + 1 + sweep.agent.len() + if sweep.posed { 56 } else { 0 };
    let classes = if sweep.boxes > 0 { 1 + "Car".len() } else { 0 };
    envelope + 3 + classes + sweep.boxes * (34 + if sweep.tracked { 12 + 4 } else { 0 })
}

/// A message that entered the channel, and when its copies arrive.
struct Sent<'w> {
    sweep: &'w Sweep,
    arrivals: Arrivals,
    start: Nanos,
    /// How long before `start` it was sent; that much of its delay is over.
    waited: Nanos,
}

/// Packets of one sender that wait until it has told a position.
const WAITING: usize = 16;

/// What the link does with packets: those that it sent, and those of agents too far away or at no known place.
fn cross<'w>(world: &'w World, packets: &[At<'w>]) -> (Vec<Sent<'w>>, Vec<&'w Sweep>) {
    enum What<'w> {
        Packet(&'w Sweep),
        Position(Nanos, [f64; 2]),
    }
    let packet = |at: &At<'w>| {
        let sweep = at.sweep;
        (
            (at.ready, Class::Data, 3, &*sweep.agent, sweep.seq),
            What::Packet(sweep),
        )
    };
    let positions = world.fixes.iter().map(|fix| {
        let port = if fix.agent == EGO { 0 } else { 1 };
        (
            (fix.ready, Class::State, port, &*fix.agent, fix.seq),
            What::Position(fix.stamp, fix.at),
        )
    });
    let calls = serve_all(
        packets.iter().map(packet).chain(positions).collect(),
        compute(world, "link"),
    );
    let position = |agent: &str, calls: &[(Place, What)]| {
        let of_agent = calls.iter().filter_map(|((.., name, _), what)| match what {
            What::Position(stamp, at) if *name == agent => Some((*stamp, *at)),
            _ => None,
        });
        of_agent.max_by_key(|(stamp, _)| *stamp).map(|(_, at)| at)
    };
    let key = StreamKey::new(world.channel_seed, "link");
    let (mut sent, mut out_of_range) = (Vec::new(), Vec::new());
    for (number, (place, what)) in calls.iter().enumerate() {
        let What::Packet(sweep) = what else { continue };
        // The first call before which the sender is known, offline the ego too: it is waited for.
        let known = |number: &usize| {
            let so_far = &calls[..*number];
            let ego = || position(EGO, so_far).is_some();
            position(&sweep.agent, so_far).is_some() && (!world.offline || ego())
        };
        let placed = (number..=calls.len()).find(known);
        let of_sender = |(_, what): &&(Place, What)| matches!(what, What::Packet(other) if other.agent == sweep.agent);
        let behind = |until: usize| calls[number + 1..until].iter().filter(of_sender).count();
        let (so_far, start) = match placed {
            Some(at) if at == number => (&calls[..number], place.0),
            Some(at) if behind(at) < WAITING => (&calls[..at], calls[at - 1].0.0),
            _ => {
                out_of_range.push(*sweep);
                continue;
            }
        };
        let distance = position(&sweep.agent, so_far).zip(position(EGO, so_far)).map(|(a, b)| {
            let [dx, dy] = [a[0] - b[0], a[1] - b[1]];
            (dx * dx + dy * dy).sqrt()
        });
        if distance.is_none_or(|distance| distance > world.range_m) {
            out_of_range.push(*sweep);
            continue;
        }
        let draws = key.draws(&sweep.agent, EGO, Kind::Boxes, sweep.seq);
        let at_once = Arrivals {
            first: Some(0),
            second: None,
        };
        let arrivals = if world.offline {
            at_once
        } else {
            transmit(&world.channel, bytes(sweep), draws)
        };
        let waited = start - place.0;
        sent.push(Sent {
            sweep,
            arrivals,
            start,
            waited,
        });
    }
    (sent, out_of_range)
}

fn compute(world: &World, stage: &str) -> Nanos {
    world.compute.get(stage).copied().unwrap_or(0)
}

/// A message in the bank.
struct Held<'w> {
    place: Place<'w>,
    at: At<'w>,
}

/// A query and its answer.
struct Asked<'w> {
    query: At<'w>,
    /// When the Selection is ready.
    ready: Nanos,
    entries: Vec<&'w Sweep>,
    /// What would have been selected, were it not too old.
    stale: Vec<&'w Sweep>,
}

/// What entered the bank, what it did not take, and its answers in order.
fn bank<'w>(world: &World, decoded: &[At<'w>], queries: &[At<'w>]) -> (Vec<Held<'w>>, Vec<At<'w>>, Vec<Asked<'w>>) {
    let place = |at: &At<'w>, class, port| (at.ready, class, port, &*at.sweep.agent, at.sweep.seq);
    let messages = decoded.iter().map(|at| (place(at, Class::Data, 1), *at));
    let asked = queries.iter().map(|at| (place(at, Class::Query, 0), *at));
    let compute = compute(world, "bank");
    let (mut held, mut rejected, mut asking) = (Vec::new(), Vec::new(), Vec::new());
    let mut known = BTreeSet::new();
    for (place, at) in serve_all(messages.chain(asked).collect(), compute) {
        if at.sweep.agent == EGO {
            asking.push((place, at));
        } else if at.sweep.stamp - at.ready > Nanos::from(world.ahead_ms) * MS {
            rejected.push(at);
        } else if known.insert(id(at.sweep)) {
            held.push(Held { place, at });
        }
    }
    let answer = |(place, query): (Place<'w>, At<'w>)| {
        if world.offline {
            let wake = (query.sweep.stamp + REACH, Class::Wake, 0, EGO, 0);
            let entries = of_each_sender(&held, |held| nearest(held, wake, query));
            return Asked {
                query,
                ready: wake.0,
                entries,
                stale: Vec::new(),
            };
        }
        let newest = of_each_sender(&held, |held| newest(held, place, query));
        let window = Nanos::from(world.window_ms) * MS;
        let (entries, stale) = newest
            .into_iter()
            .partition(|sweep| query.ready - sweep.stamp <= window);
        Asked {
            query,
            ready: place.0 + compute,
            entries,
            stale,
        }
    };
    let asked = asking.into_iter().map(answer).collect();
    (held, rejected, asked)
}

/// One message at most of each sender, by name.
fn of_each_sender<'w>(held: &[Held<'w>], choose: impl Fn(&[&Held<'w>]) -> Option<&'w Sweep>) -> Vec<&'w Sweep> {
    let agents: BTreeSet<&str> = held.iter().map(|held| &*held.at.sweep.agent).collect();
    let of = |agent: &str| {
        held.iter()
            .filter(|held| held.at.sweep.agent == agent)
            .collect::<Vec<_>>()
    };
    agents.into_iter().filter_map(|agent| choose(&of(agent))).collect()
}

/// Online: the newest stamp with ready ≤ the query's ready, of what has entered the bank.
fn newest<'w>(held: &[&Held<'w>], now: Place, query: At) -> Option<&'w Sweep> {
    let there = held
        .iter()
        .filter(|held| held.place < now && held.at.ready <= query.ready);
    there.max_by_key(|held| held.at.sweep.stamp).map(|held| held.at.sweep)
}

/// Offline: the least difference of stamps, at most the reach; of two the earlier.
fn nearest<'w>(held: &[&Held<'w>], now: Place, query: At) -> Option<&'w Sweep> {
    let away = |held: &&&Held| (held.at.sweep.stamp.abs_diff(query.sweep.stamp), held.at.sweep.stamp);
    let there = held.iter().filter(|held| held.place < now);
    let near = there
        .min_by_key(away)
        .filter(|held| away(held).0 <= REACH.unsigned_abs());
    near.map(|held| held.at.sweep)
}

/// Sets of the ego's message and its Selection: the fusions that took place, and how many sets did not come to one.
fn fuse<'w>(world: &World, asked: &[Asked<'w>]) -> (Vec<At<'w>>, u64) {
    let mut sets: Vec<At> = asked
        .iter()
        .map(|asked| At {
            ready: asked.ready,
            ..asked.query
        })
        .collect();
    sets.sort_by_key(|set| (set.ready, set.sweep.seq));
    // A set that is older than one that was complete before it is discarded.
    let in_order = |number: usize| {
        sets[..number]
            .iter()
            .all(|before| before.sweep.stamp < sets[number].sweep.stamp)
    };
    let complete: Vec<At> = (0..sets.len())
        .filter(|number| in_order(*number))
        .map(|number| sets[number])
        .collect();
    let (fused, skipped) = serve_latest(&complete, compute(world, "fusion"));
    (fused, (sets.len() - complete.len() + skipped.len()) as u64)
}

/// What one fusion did with what was selected for it: what it used, what was beyond its limit, what it could not take.
fn fusion(world: &World, set: &At, asked_at: Nanos, entries: &[&Sweep]) -> (Fusion, Vec<Id>, Vec<Id>) {
    let (placed, rejected): (Vec<&Sweep>, Vec<&Sweep>) =
        entries.iter().partition(|entry| entry.posed && set.sweep.posed);
    let limit = world.max_collaborators.unwrap_or(usize::MAX).min(placed.len());
    let (taken, over_limit) = placed.split_at(limit);
    let fusion = Fusion {
        query: set.sweep.seq,
        ready: set.ready,
        boxes: set.sweep.boxes + taken.iter().map(|sweep| sweep.boxes).sum::<usize>(),
        used: taken.iter().map(|sweep| (id(sweep), asked_at - sweep.stamp)).collect(),
    };
    let ids = |sweeps: &[&Sweep]| sweeps.iter().map(|sweep| id(sweep)).collect();
    (fusion, ids(over_limit), ids(&rejected))
}

/// Everything that ever happened to messages, by which each has its term.
#[derive(Default)]
struct History {
    selected: BTreeSet<Id>,
    used: BTreeSet<Id>,
    /// By the decoder, or in a Selection that no fusion took up.
    passed_over: BTreeSet<Id>,
    over_limit: BTreeSet<Id>,
    stale: BTreeSet<Id>,
    superseded: BTreeSet<Id>,
    /// By the decoder, the bank or a fusion.
    rejected: BTreeSet<Id>,
}

impl History {
    /// Adds the message to the first term that fits.
    fn count(&self, sent: &Sent, line: &mut Line) {
        let id = id(sent.sweep);
        let asked_for = self.selected.contains(&id);
        let terms = [
            (self.used.contains(&id), &mut line.used),
            (self.passed_over.contains(&id), &mut line.skipped),
            (self.over_limit.contains(&id), &mut line.over_limit),
            (self.stale.contains(&id) && !asked_for, &mut line.stale),
            (self.superseded.contains(&id) && !asked_for, &mut line.superseded),
            (sent.arrivals.first.is_none(), &mut line.lost),
            (self.rejected.contains(&id), &mut line.rejected),
            (true, &mut line.in_flight),
        ];
        if let Some((_, term)) = terms.into_iter().find(|(fits, _)| *fits) {
            *term += 1;
        }
    }
}

/// Online: the ones that were asked for when they were too old, and the ones that had a newer one beside them.
fn online(asked: &[Asked], held: &[Held], history: &mut History) {
    history
        .stale
        .extend(asked.iter().flat_map(|asked| asked.stale.iter().map(|sweep| id(sweep))));
    let newer = |a: &Sweep, b: &Sweep| a.agent == b.agent && a.stamp > b.stamp;
    let superseded = held
        .iter()
        .filter(|old| held.iter().any(|new| newer(new.at.sweep, old.at.sweep)));
    history.superseded.extend(superseded.map(|held| id(held.at.sweep)));
}

/// Offline: the ones in reach of a query that took a nearer one, and of the others those that are behind a query.
fn offline(asked: &[Asked], held: &[Held], history: &mut History) {
    for Held {
        at: At { sweep, .. }, ..
    } in held
    {
        let queries = || asked.iter().map(|asked| asked.query.sweep.stamp);
        if queries().any(|query| query.abs_diff(sweep.stamp) <= REACH.unsigned_abs()) {
            history.superseded.insert(id(sweep));
        } else if queries().any(|query| query > sweep.stamp) {
            history.stale.insert(id(sweep));
        }
    }
}

/// What a run of the world must give.
pub fn account(world: &World) -> Account {
    let at = |sweep| At {
        sweep,
        ready: sweep.ready,
    };
    let (own, others): (Vec<At>, Vec<At>) = world.sweeps.iter().map(at).partition(|at| at.sweep.agent == EGO);
    let (queries, ego_missed) = serve_latest(&own, compute(world, "ego-nms"));
    let (detected, missed) = serve_latest(&others, compute(world, "nms"));
    let (packets, unsent) = serve_latest(&detected, compute(world, "encoder"));
    let (sent, out_of_range) = cross(world, &packets);
    let done = compute(world, "link");
    let copies = sent.iter().flat_map(|sent| {
        let delays = [sent.arrivals.first, sent.arrivals.second].into_iter().flatten();
        delays.map(move |delay| At {
            sweep: sent.sweep,
            ready: sent.start + done + (delay - sent.waited).max(0),
        })
    });
    let (decoded, undecoded) = serve_latest(&copies.collect::<Vec<_>>(), compute(world, "decoder"));
    let (fitting, too_large): (Vec<At>, Vec<At>) =
        decoded.into_iter().partition(|at| bytes(at.sweep) <= world.max_bytes);
    let (held, refused, asked) = bank(world, &fitting, &queries);
    let (fused, not_fused) = fuse(world, &asked);

    let ids = |list: &[&Sweep]| list.iter().map(|sweep| id(sweep)).collect::<Vec<_>>();
    let mut history = History {
        selected: asked.iter().flat_map(|asked| ids(&asked.entries)).collect(),
        rejected: refused.iter().chain(&too_large).map(|at| id(at.sweep)).collect(),
        passed_over: undecoded.iter().map(|at| id(at.sweep)).collect(),
        ..History::default()
    };
    match world.offline {
        true => offline(&asked, &held, &mut history),
        false => online(&asked, &held, &mut history),
    }
    let mut fusions = Vec::new();
    for set in &fused {
        let asked = asked.iter().find(|asked| asked.query.sweep == set.sweep);
        let asked = asked.expect("a set has its query");
        let (fusion, over_limit, rejected) = fusion(world, set, asked.query.ready, &asked.entries);
        history.used.extend(fusion.used.iter().map(|(id, _)| id.clone()));
        history.over_limit.extend(over_limit);
        history.rejected.extend(rejected);
        fusions.push(fusion);
    }
    for asked in &asked {
        if !fused.iter().any(|set| set.sweep == asked.query.sweep) {
            history.passed_over.extend(ids(&asked.entries));
        }
    }

    let mut channels: BTreeMap<String, Line> = BTreeMap::new();
    for sent in &sent {
        let line = channels.entry(sent.sweep.agent.clone()).or_default();
        line.sent += 1;
        line.bytes += bytes(sent.sweep) as u64;
        line.duplicated += u64::from(sent.arrivals.second.is_some());
        history.count(sent, line);
    }
    for sweep in out_of_range {
        channels.entry(sweep.agent.clone()).or_default().out_of_range += 1;
    }
    let answers = asked.iter().map(|asked| Answer {
        query: asked.query.sweep.seq,
        ready: asked.ready,
        entries: asked
            .entries
            .iter()
            .map(|sweep| (id(sweep), asked.query.ready - sweep.stamp))
            .collect(),
    });
    let count = |list: &[At]| list.len() as u64;
    let passed_over = [
        ("ego-nms", count(&ego_missed)),
        ("nms", count(&missed)),
        ("encoder", count(&unsent)),
        ("link", 0),
        ("decoder", count(&undecoded)),
        ("bank", 0),
        ("fusion", 2 * not_fused),
    ];
    Account {
        selections: answers.collect(),
        fusions,
        channels,
        passed_over: passed_over.map(|(stage, count)| (stage.to_string(), count)).into(),
    }
}

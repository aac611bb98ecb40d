//! The rules of time and of accounting once more, stage after stage over the whole history: no events, and no queue but a line of those who
//! wait.

use std::collections::{BTreeMap, BTreeSet};

use realo_schemas::Nanos;

use crate::account::{Account, Answer, Fusion, Id, Line, Place as InEgo, Reached, add, id};
use crate::bank::{Asked, Banked, Held, REACH, bank};
use crate::link::{Crossed, Link, Sent, bytes, kind};
use crate::stage::{At, Class, Place, serve_all, serve_latest};
use crate::world::{EGO, Strategy, World, content};

/// The states of the ego that came to the others over their link, and what became of them on the way.
#[derive(Default)]
struct Reported<'w> {
    to_ego: Crossed<'w>,
    to_others: Crossed<'w>,
    /// By receiver: the calls in which its encoder took a state.
    known: BTreeMap<&'w str, Vec<(Place<'w>, At<'w>)>>,
    /// Receiver and number of those that a busy decoder skipped.
    skipped: BTreeSet<(&'w str, u64)>,
    /// Receiver and number of those by which a sweep was brought to the ego's frame.
    used: BTreeSet<(&'w str, u64)>,
    /// Messages skipped, by stage.
    by_stage: BTreeMap<String, u64>,
}

/// Everybody's states through the link of states.
fn report(world: &World) -> Reported<'_> {
    let (own, others): (Vec<At>, Vec<At>) = world.states.iter().map(At::log).partition(|at| at.agent() == EGO);
    let own = serve_latest(&own, world.compute("ego-sender"));
    let others = serve_latest(&others, world.compute("state-sender"));
    let link = Link::of_states(world, &own.done(), &others.done());
    let mut reported = Reported {
        to_ego: link.to_ego(),
        to_others: link.to_others(),
        ..Reported::default()
    };
    let receivers: BTreeSet<&str> = reported.to_others.sent.iter().map(|sent| sent.to).collect();
    let mut late = 0;
    for receiver in receivers {
        let sent = reported.to_others.sent.iter().filter(|sent| sent.to == receiver);
        let arrivals: Vec<At> = sent.flat_map(Sent::arrivals).collect();
        // What came for one agent does not wait for, nor replace, what came for another.
        let decoded = serve_latest(&arrivals, world.compute("state-receiver"));
        late += decoded.skipped.len();
        let skipped = decoded.skipped.iter().map(|at| (receiver, at.said.seq));
        reported.skipped.extend(skipped);
        let taken = decoded.done().into_iter().map(|at| (at.place(Class::State, 1), at));
        reported
            .known
            .insert(receiver, serve_all(taken.collect(), world.compute("encoder")));
    }
    reported.known.retain(|_, taken| !taken.is_empty());
    let count = [
        ("ego-sender", own.skipped.len()),
        ("state-sender", others.skipped.len()),
        ("state-link", 0),
        ("state-receiver", late),
    ];
    reported.by_stage = count.map(|(stage, count)| (stage.to_string(), count as u64)).into();
    reported
}

impl Reported<'_> {
    /// The books of the channels of states.
    fn channels(&self) -> BTreeMap<String, Line> {
        let mut channels = books("agent_state", &self.to_ego);
        for sent in &self.to_ego.sent {
            let line = channels.get_mut(&name(sent, "agent_state")).expect("it has a line");
            line.lost += u64::from(sent.copies.first.is_none());
        }
        channels.extend(books("agent_state", &self.to_others));
        for (name, line) in &mut channels {
            // The encoder takes what the channel delivers: it had some of this receiver.
            let (_, to) = name
                .trim_end_matches(".agent_state")
                .split_once('-')
                .expect("two agents");
            line.accounted = self.known.contains_key(to);
        }
        for sent in &self.to_others.sent {
            let line = channels.get_mut(&name(sent, "agent_state")).expect("it has a line");
            let (number, stamp) = ((sent.to, sent.at.said.seq), sent.at.said.stamp);
            let taken = || self.known.get(sent.to).into_iter().flatten().map(|(_, at)| at.said);
            let there = taken().any(|said| said.stamp == stamp);
            let terms = [
                (self.used.contains(&number), &mut line.used),
                (self.skipped.contains(&number), &mut line.skipped),
                (there && taken().any(|said| said.stamp > stamp), &mut line.superseded),
                (sent.copies.first.is_none(), &mut line.lost),
                (true, &mut line.in_flight),
            ];
            if let Some((_, term)) = terms.into_iter().find(|(fits, _)| *fits) {
                *term += 1;
            }
        }
        // Of what nobody takes only the channel itself speaks.
        for line in channels.values_mut().filter(|line| !line.accounted) {
            (line.skipped, line.in_flight) = (0, 0);
        }
        channels
    }
}

fn name(sent: &Sent, kind: &str) -> String {
    format!("{}-{}.{kind}", sent.at.agent(), sent.to)
}

/// What the channels of a link carried.
fn books(kind: &str, crossed: &Crossed) -> BTreeMap<String, Line> {
    let mut channels: BTreeMap<String, Line> = BTreeMap::new();
    for sent in &crossed.sent {
        let line = channels.entry(name(sent, kind)).or_default();
        line.sent += 1;
        line.bytes += sent.bytes as u64;
        line.duplicated += u64::from(sent.copies.second.is_some());
    }
    for (from, to) in &crossed.out_of_range {
        channels.entry(format!("{from}-{to}.{kind}")).or_default().out_of_range += 1;
    }
    channels
}

/// What the encoders made of sweeps.
#[derive(Default)]
struct Encoded<'w> {
    packets: Vec<At<'w>>,
    skipped: u64,
    no_ego_state: u64,
    errors: u64,
}

/// Sweeps to packets; a sender that projects takes the newest state of the ego that it has received.
fn encode<'w>(world: &World, sweeps: &[At<'w>], reported: &mut Reported<'w>, reached: &mut Reached) -> Encoded<'w> {
    let served = serve_latest(sweeps, world.compute("encoder"));
    let mut encoded = Encoded {
        skipped: served.skipped.len() as u64,
        ..Encoded::default()
    };
    for (place, at) in &served.calls {
        if world.strategy != Strategy::Projected {
            // Nobody can use what is nowhere.
            encoded.packets.extend(at.said.spot.map(|_| *at));
            continue;
        }
        let taken = reported.known.get(at.agent()).into_iter().flatten();
        let before = taken.filter(|(taken, _)| taken < place);
        let Some(ego) = before.map(|(_, state)| state.said).max_by_key(|said| said.stamp) else {
            encoded.no_ego_state += 1;
            continue;
        };
        if at.said.spot.is_none() {
            encoded.errors += 1;
            continue;
        }
        reported.used.insert((at.agent(), ego.seq));
        encoded.packets.push(At { by: Some(ego), ..*at });
        let log_had = world
            .states
            .iter()
            .filter(|said| said.agent == EGO && said.ready < place.0);
        let log_had = log_had.map(|said| said.stamp).max();
        add(
            reached,
            "projected with a state that the link made old",
            log_had > Some(ego.stamp),
        );
        add(reached, "projected", true);
    }
    encoded
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
    sets.sort_by_key(|set| (set.ready, set.said.seq));
    // A set that is older than one that was complete before it is discarded.
    let in_order = |number: usize| {
        sets[..number]
            .iter()
            .all(|before| before.said.stamp < sets[number].said.stamp)
    };
    let complete: Vec<At> = (0..sets.len())
        .filter(|number| in_order(*number))
        .map(|number| sets[number])
        .collect();
    let served = serve_latest(&complete, world.compute("fusion"));
    let not_fused = sets.len() - complete.len() + served.skipped.len();
    (served.done(), not_fused as u64)
}

/// What one fusion did with what was selected for it: what it used, what was beyond its limit, what it could not take.
fn fusion(world: &World, set: &At, asked_at: Nanos, entries: &[At]) -> (Fusion, Vec<Id>, Vec<Id>) {
    let posed = |at: &At| at.said.spot.is_some() && set.said.spot.is_some();
    let (mut placed, mut rejected): (Vec<At>, Vec<At>) = entries.iter().partition(|entry| posed(entry));
    let distance = |at: &At| {
        let ([x, y], [ego_x, ego_y]) = [at, set].map(|at| at.said.spot.expect("it was placed").at).into();
        (x - ego_x).hypot(y - ego_y)
    };
    let limit = world.max_collaborators.unwrap_or(usize::MAX).min(placed.len());
    placed.sort_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.agent().cmp(b.agent())));
    let (chosen, over_limit) = placed.split_at_mut(limit);
    chosen.sort_by(|a, b| a.agent().cmp(b.agent()));
    // What stays as it was sent must have been sent in the ego's frame.
    let (taken, elsewhere): (Vec<At>, Vec<At>) = chosen.iter().partition(|at| !world.as_sent || at.by.is_some());
    rejected.extend(elsewhere);
    let own = (0..set.said.count).map(|place| InEgo(content(place)));
    let theirs = taken
        .iter()
        .flat_map(|at| (0..at.said.count).map(|place| in_ego(world, set, at, content(place))));
    let fusion = Fusion {
        query: set.said.seq,
        ready: set.ready,
        content: own.chain(theirs).collect(),
        used: taken.iter().map(|at| (id(at.said), asked_at - at.said.stamp)).collect(),
    };
    let ids = |list: &[At]| list.iter().map(|at| id(at.said)).collect();
    (fusion, ids(over_limit), ids(&rejected))
}

/// Where the fusion puts a point of a sender's frame: where it was in `map`, seen by the ego at the query's stamp; as it
/// was sent, by the ego at the stamp of the state that the sender knew.
fn in_ego(world: &World, set: &At, at: &At, point: [f64; 2]) -> InEgo {
    let in_map = at.said.spot.expect("it was placed").map_from_here(point);
    let seen_by = at.by.filter(|_| world.as_sent).unwrap_or(set.said);
    InEgo(seen_by.spot.expect("it was placed").here_from_map(in_map))
}

/// Everything that ever happened to sweeps, by which each has its term.
#[derive(Default)]
struct History {
    selected: BTreeSet<Id>,
    used: BTreeSet<Id>,
    /// By the decoder, or in a Selection that no fusion took up.
    skipped: BTreeSet<Id>,
    over_limit: BTreeSet<Id>,
    stale: BTreeSet<Id>,
    superseded: BTreeSet<Id>,
    /// By the decoder, the bank or a fusion.
    rejected: BTreeSet<Id>,
}

impl History {
    /// Adds the message to the first term that fits.
    fn count(&self, sent: &Sent, line: &mut Line) {
        let id = id(sent.at.said);
        let asked_for = self.selected.contains(&id);
        let terms = [
            (self.used.contains(&id), &mut line.used),
            (self.skipped.contains(&id), &mut line.skipped),
            (self.over_limit.contains(&id), &mut line.over_limit),
            (self.stale.contains(&id) && !asked_for, &mut line.stale),
            (self.superseded.contains(&id) && !asked_for, &mut line.superseded),
            (sent.copies.first.is_none(), &mut line.lost),
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
    let stale = asked.iter().flat_map(|asked| asked.stale.iter().map(|at| id(at.said)));
    history.stale.extend(stale);
    let newer = |new: &Held, old: &Held| new.at.agent() == old.at.agent() && new.is_newer(old);
    let superseded = held.iter().filter(|old| held.iter().any(|new| newer(new, old)));
    history.superseded.extend(superseded.map(|held| id(held.at.said)));
}

/// Offline: of the queries that were answered with it there, the ones in reach of one, which took a nearer one; and of
/// the others those that are behind one.
fn offline(asked: &[Asked], held: &[Held], history: &mut History) {
    for Held { place, at, .. } in held {
        let there = asked.iter().filter(|asked| asked.now > *place);
        let queries: Vec<Nanos> = there.map(|asked| asked.query.said.stamp).collect();
        let in_reach = |query: &Nanos| query.abs_diff(at.said.stamp) <= REACH.unsigned_abs();
        if queries.iter().any(in_reach) {
            history.superseded.insert(id(at.said));
        } else if queries.iter().any(|query| *query > at.said.stamp) {
            history.stale.insert(id(at.said));
        }
    }
}

/// What a run of the world must give, and what of it is rare.
pub fn account(world: &World) -> (Account, Reached) {
    let mut reached = Reached::new();
    let mut skipped: BTreeMap<String, u64> = BTreeMap::new();
    let (own, others): (Vec<At>, Vec<At>) = world.sweeps.iter().map(At::log).partition(|at| at.agent() == EGO);
    let (queries, others) = match world.strategy {
        Strategy::Late => {
            let own = serve_latest(&own, world.compute("ego-nms"));
            let others = serve_latest(&others, world.compute("nms"));
            skipped.insert("ego-nms".into(), own.skipped.len() as u64);
            skipped.insert("nms".into(), others.skipped.len() as u64);
            (own.done(), others.done())
        }
        Strategy::Early | Strategy::Projected => (own, others),
    };
    let mut reported = match world.strategy {
        Strategy::Projected => report(world),
        Strategy::Late | Strategy::Early => Reported::default(),
    };
    let encoded = encode(world, &others, &mut reported, &mut reached);
    let crossed = Link::of_sweeps(world, &encoded.packets).to_ego();
    add(
        &mut reached,
        "worlds in which a link's room ran out",
        crossed.pushed_out > 0,
    );
    let copies: Vec<At> = crossed.sent.iter().flat_map(Sent::arrivals).collect();
    let decoded = serve_latest(&copies, world.compute("decoder"));
    let (fitting, too_large): (Vec<At>, Vec<At>) = decoded
        .done()
        .into_iter()
        .partition(|at| bytes(world, at) <= world.max_bytes);
    let Banked { held, rejected, asked } = bank(world, &fitting, &queries, &mut reached);
    let (fused, not_fused) = fuse(world, &asked);

    let ids = |list: &[At]| list.iter().map(|at| id(at.said)).collect::<Vec<_>>();
    let mut history = History {
        selected: asked.iter().flat_map(|asked| ids(&asked.entries)).collect(),
        rejected: rejected.iter().chain(&too_large).map(|at| id(at.said)).collect(),
        skipped: decoded.skipped.iter().map(|at| id(at.said)).collect(),
        ..History::default()
    };
    match world.offline {
        true => offline(&asked, &held, &mut history),
        false => online(&asked, &held, &mut history),
    }
    let mut fusions = Vec::new();
    for set in &fused {
        let asked = asked.iter().find(|asked| asked.query.said == set.said);
        let asked = asked.expect("a set has its query");
        let (fusion, over_limit, rejected) = fusion(world, set, asked.query.ready, &asked.entries);
        let projected = world.strategy == Strategy::Projected && !fusion.used.is_empty();
        add(
            &mut reached,
            "fusions of what was projected and stayed as sent",
            projected && world.as_sent,
        );
        add(
            &mut reached,
            "fusions of what was projected and brought up to date",
            projected && !world.as_sent,
        );
        history.used.extend(fusion.used.iter().map(|(id, _)| id.clone()));
        history.over_limit.extend(over_limit);
        history.rejected.extend(rejected);
        fusions.push(fusion);
    }
    for asked in &asked {
        if !fused.iter().any(|set| set.said == asked.query.said) {
            history.skipped.extend(ids(&asked.entries));
        }
    }

    let mut channels = books(kind(world), &crossed);
    for sent in &crossed.sent {
        history.count(sent, channels.get_mut(&name(sent, kind(world))).expect("it has a line"));
    }
    channels.values_mut().for_each(|line| line.accounted = true);
    channels.extend(reported.channels());
    let answers = asked.iter().map(|asked| Answer {
        query: asked.query.said.seq,
        ready: asked.ready,
        entries: asked
            .entries
            .iter()
            .map(|at| (id(at.said), asked.query.ready - at.said.stamp))
            .collect(),
    });
    let shared = [
        ("encoder", encoded.skipped),
        ("link", 0),
        ("decoder", decoded.skipped.len() as u64),
        ("bank", 0),
        ("fusion", 2 * not_fused),
    ];
    skipped.extend(shared.map(|(stage, count)| (stage.to_string(), count)));
    skipped.extend(reported.by_stage);
    let account = Account {
        selections: answers.collect(),
        fusions,
        channels,
        no_ego_state: encoded.no_ego_state,
        errors: encoded.errors,
        skipped,
    };
    (account, reached)
}

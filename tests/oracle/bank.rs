//! The bank once more: what it holds, whom its queries wait for, when each is answered, and with what.

use std::collections::{BTreeMap, BTreeSet};

use realo_schemas::Nanos;

use crate::account::{Reached, add, id};
use crate::stage::{At, Class, Place, freed, serve_all};
use crate::world::{EGO, MS, World};

/// Largest difference of stamps offline, inclusive.
pub const REACH: Nanos = 50 * MS;
/// Messages of one sender that are held.
const HELD: usize = 16;
/// Messages of one sender by which copies are known.
const REMEMBERED: usize = 64;

/// A message in the bank.
pub struct Held<'w> {
    /// Place of the call in which it came.
    pub place: Place<'w>,
    pub at: At<'w>,
    /// When it left, because so many newer ones of its sender are there.
    left: Option<Place<'w>>,
}

impl Held<'_> {
    /// Of one stamp, what came later counts as newer.
    pub fn is_newer(&self, other: &Held) -> bool {
        (self.at.said.stamp, self.place) > (other.at.said.stamp, other.place)
    }

    /// Whether a call finds it; one that brings a message finds that one.
    fn is_there(&self, now: Place) -> bool {
        self.place <= now && self.left.is_none_or(|left| left > now)
    }
}

/// A query and its answer.
pub struct Asked<'w> {
    pub query: At<'w>,
    /// When it was answered.
    pub now: Place<'w>,
    /// When the Selection is ready.
    pub ready: Nanos,
    pub entries: Vec<At<'w>>,
    /// What would have been selected, were it not too old.
    pub stale: Vec<At<'w>>,
}

/// What entered the bank, what it did not take, and its answers in order.
pub struct Banked<'w> {
    pub held: Vec<Held<'w>>,
    pub rejected: Vec<At<'w>>,
    pub asked: Vec<Asked<'w>>,
}

/// A call of the bank, and when it is done.
#[derive(Clone, Copy)]
struct Call<'w> {
    now: Place<'w>,
    done: Nanos,
}

/// A query, the call in which it came, and the call in which it was answered.
struct Turn<'w> {
    query: At<'w>,
    came: Place<'w>,
    answered: Call<'w>,
}

pub fn bank<'w>(world: &World, decoded: &[At<'w>], queries: &[At<'w>], reached: &mut Reached) -> Banked<'w> {
    let messages = decoded.iter().map(|at| (at.place(Class::Data, 1), *at));
    let (mut held, mut rejected) = (Vec::new(), Vec::new());
    for (place, at) in serve_all(messages.collect(), world.compute_of_bank("others")) {
        if at.said.stamp - at.ready > millis(world.ahead_ms) {
            rejected.push(at);
        } else if is_new(&held, at) {
            held.push(Held { place, at, left: None });
        }
    }
    limit(&mut held);
    let turns = match world.offline {
        true => offline_turns(queries),
        false => online_turns(world, &held, queries, reached),
    };
    let asked = turns.into_iter().map(|turn| answer(world, &held, turn, reached));
    let asked = asked.collect();
    Banked { held, rejected, asked }
}

fn millis(millis: u32) -> Nanos {
    Nanos::from(millis) * MS
}

/// Whether none of the last messages of its sender is the same.
fn is_new(held: &[Held], at: At) -> bool {
    let of_sender = held.iter().rev().filter(|held| held.at.agent() == at.agent());
    of_sender.take(REMEMBERED).all(|held| held.at.said.seq != at.said.seq)
}

/// Sets when each message left for want of room: when the last of the 16 newer ones came that fill it.
fn limit(held: &mut [Held]) {
    let lefts: Vec<_> = held
        .iter()
        .map(|old| {
            let newer = held
                .iter()
                .filter(|new| new.at.agent() == old.at.agent() && new.is_newer(old));
            // In the order in which they came.
            newer.map(|new| new.place.max(old.place)).nth(HELD - 1)
        })
        .collect();
    held.iter_mut().zip(lefts).for_each(|(held, left)| held.left = left);
}

/// Each is answered when what it reaches is there.
fn offline_turns<'w>(queries: &[At<'w>]) -> Vec<Turn<'w>> {
    let calls = queries.iter().map(|at| (at.place(Class::Query, 0), *at));
    let turns = serve_all(calls.collect(), 0).into_iter().map(|(came, query)| {
        let done = query.said.stamp + REACH;
        let now = (done, Class::Wake, 0, EGO, 0);
        let answered = Call { now, done };
        Turn { query, came, answered }
    });
    turns.collect()
}

/// A query that waits.
struct Waiting<'w> {
    query: At<'w>,
    came: Place<'w>,
    until: Nanos,
    /// For whom.
    due: Vec<&'w str>,
}

/// The calls of the ego's server: queries, and the wakes that they ask for who wait.
fn online_turns<'w>(world: &World, held: &[Held<'w>], queries: &[At<'w>], reached: &mut Reached) -> Vec<Turn<'w>> {
    let patience = millis(world.patience_ms);
    let queries = queries.iter().map(|at| (at.place(Class::Query, 0), Some(*at)));
    let mut line: BTreeMap<Place, Option<At>> = queries.collect();
    let mut turns = Vec::new();
    let mut waiting: Option<Waiting> = None;
    let mut free = Nanos::MIN;
    while let Some((arrived, query)) = line.pop_first() {
        let now = if free > arrived.0 { freed(free, EGO) } else { arrived };
        free = now.0 + world.compute_of_bank(if query.is_some() { "ego" } else { "wake" });
        let call = Call { now, done: free };
        if let Some(first) = waiting.take() {
            match end_of_wait(world, held, &first, call, query.is_some(), reached) {
                Some(answered) => turns.push(Turn {
                    query: first.query,
                    came: first.came,
                    answered,
                }),
                None => waiting = Some(first),
            }
        }
        let Some(query) = query else { continue };
        let (came, until) = (now, query.ready + patience);
        let due = due(world, held, query, now, reached);
        if due.is_empty() || until <= now.0 {
            let too_late = !due.is_empty();
            add(reached, "queries whose patience was over at their turn", too_late);
            turns.push(Turn {
                query,
                came,
                answered: call,
            });
        } else {
            add(reached, "queries that waited", true);
            line.insert((until, Class::Wake, 0, EGO, 0), None);
            waiting = Some(Waiting {
                query,
                came,
                until,
                due,
            });
        }
    }
    turns
}

/// The call that answered a query which has waited, if one up to this call of the ego's did.
fn end_of_wait<'w>(
    world: &World,
    held: &[Held<'w>],
    waiting: &Waiting<'w>,
    call: Call<'w>,
    is_query: bool,
    reached: &mut Reached,
) -> Option<Call<'w>> {
    // Messages have servers of their own: the last that it waited for may have come before.
    let last = last_of(held, &waiting.due, waiting.came).filter(|last| *last < call.now);
    let (what, end) = match last {
        Some(now) => {
            let done = now.0 + world.compute_of_bank("others");
            ("waits that a message ended", Call { now, done })
        }
        None if is_query => ("waits that the next query ended", call),
        None if waiting.until <= call.now.0 => ("waits that ran out", call),
        None => return None,
    };
    let (of_several, older) = (waiting.due.len() > 1, heard_older(held, waiting, end.now));
    add(reached, what, true);
    add(
        reached,
        "waits that the last of several ended",
        last.is_some() && of_several,
    );
    add(reached, "waits that an older message did not end", older);
    Some(end)
}

/// Those of whom a message is due: a whole number of periods after the newest came, at most the patience from the query.
fn due<'w>(world: &World, held: &[Held<'w>], query: At, now: Place, reached: &mut Reached) -> Vec<&'w str> {
    let patience = millis(world.patience_ms);
    let mut is_due = |agent: &&str| {
        let heard: Vec<_> = newest_of_their_time(held, agent)
            .filter(|held| held.place < now)
            .collect();
        let [.., before, newest] = heard[..] else { return false };
        let (from, to) = (before.at.said, newest.at.said);
        let period = (to.stamp - from.stamp) / (to.seq - from.seq) as Nanos;
        if query.ready - to.stamp > millis(world.window_ms) {
            return false;
        }
        let mut next = newest.at.ready + period;
        while next < query.ready - patience {
            next += period;
        }
        let is_due = next <= query.ready + patience;
        let (gap, silence) = (to.seq - from.seq > 1, next > newest.at.ready + period);
        add(reached, "messages due after a gap in their seq", is_due && gap);
        add(reached, "messages due after a period without one", is_due && silence);
        is_due
    };
    let agents: BTreeSet<&str> = held.iter().map(|held| held.at.agent()).collect();
    let due = agents.into_iter().filter(|agent| patience > 0 && is_due(agent));
    due.collect()
}

/// The messages of an agent that were newer than all of it that had come before.
fn newest_of_their_time<'h, 'w>(held: &'h [Held<'w>], agent: &str) -> impl Iterator<Item = &'h Held<'w>> {
    let mut newest = Nanos::MIN;
    held.iter()
        .filter(move |held| held.at.agent() == agent)
        .filter(move |held| {
            let newer = held.at.said.stamp > newest;
            newest = newest.max(held.at.said.stamp);
            newer
        })
}

/// The message with which each of these agents has sent a newer one since.
fn last_of<'w>(held: &[Held<'w>], agents: &[&str], since: Place) -> Option<Place<'w>> {
    let next = |agent: &&str| {
        let next = newest_of_their_time(held, agent).map(|held| held.place);
        next.filter(|place| *place > since).min()
    };
    let all: Option<Vec<Place>> = agents.iter().map(next).collect();
    all?.into_iter().max()
}

/// Whether a message of whom it waited for was older than one before.
fn heard_older(held: &[Held], waiting: &Waiting, answered: Place) -> bool {
    let came = |held: &&Held| waiting.came < held.place && held.place < answered;
    waiting.due.iter().any(|agent| {
        let of_agent = held.iter().filter(|held| held.at.agent() == *agent);
        of_agent.filter(came).count() > newest_of_their_time(held, agent).filter(came).count()
    })
}

fn answer<'w>(world: &World, held: &[Held<'w>], turn: Turn<'w>, reached: &mut Reached) -> Asked<'w> {
    let Turn { query, came, answered } = turn;
    let Call { now, done } = answered;
    let in_time = |at: &At| world.offline || query.ready - at.said.stamp <= millis(world.window_ms);
    let chosen = |there: &dyn Fn(&Held) -> bool| {
        of_each_sender(held, |held| {
            let there = held.iter().filter(|held| there(held)).map(|held| held.at);
            match world.offline {
                true => nearest(there, query),
                false => newest(there, world, query),
            }
        })
    };
    let ids = |list: &[At]| {
        let in_time = list.iter().filter(|at| in_time(at));
        in_time.map(|at| id(at.said)).collect::<Vec<_>>()
    };
    let found = chosen(&|held| held.is_there(now));
    let had_room = chosen(&|held| held.place <= now);
    let at_once = chosen(&|held| held.is_there(came));
    let limited = match world.offline {
        true => "answers offline that the bank's limit changed",
        false => "answers that the bank's limit changed",
    };
    let (waited, in_line) = (!world.offline && now != came, !world.offline && now == came);
    let meanwhile = found.iter().any(|at| at.ready > query.ready);
    add(reached, limited, ids(&found) != ids(&had_room));
    add(
        reached,
        "answers that waiting changed",
        waited && ids(&found) != ids(&at_once),
    );
    add(
        reached,
        "answers with what came while they were in line",
        in_line && meanwhile,
    );
    let (entries, stale) = found.into_iter().partition(in_time);
    Asked {
        query,
        now,
        ready: done,
        entries,
        stale,
    }
}

/// One message at most of each sender, by name.
fn of_each_sender<'w>(held: &[Held<'w>], choose: impl Fn(&[&Held<'w>]) -> Option<At<'w>>) -> Vec<At<'w>> {
    let agents: BTreeSet<&str> = held.iter().map(|held| held.at.agent()).collect();
    let of = |agent: &str| held.iter().filter(|held| held.at.agent() == agent).collect::<Vec<_>>();
    agents.into_iter().filter_map(|agent| choose(&of(agent))).collect()
}

/// Online: the newest stamp with ready ≤ the query's ready; with patience of all that is there.
fn newest<'w>(there: impl Iterator<Item = At<'w>>, world: &World, query: At) -> Option<At<'w>> {
    there
        .filter(|at| world.patience_ms > 0 || at.ready <= query.ready)
        .max_by_key(|at| at.said.stamp)
}

/// Offline: the smallest difference of stamps, at most the reach; of two the earlier.
fn nearest<'w>(there: impl Iterator<Item = At<'w>>, query: At) -> Option<At<'w>> {
    let away = |at: &At| (at.said.stamp.abs_diff(query.said.stamp), at.said.stamp);
    there.min_by_key(away).filter(|at| away(at).0 <= REACH.unsigned_abs())
}

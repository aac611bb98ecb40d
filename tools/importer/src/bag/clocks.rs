//! How the clocks of bags differ: by what is in them, or by the map file.

mod log_times;
mod spans;

use realo_schemas::{Nanos, to_millis, to_seconds};

use self::log_times::LogTimes;
use super::Import;
use super::agents::Agent;
use super::small::{References, Seen, Small};
use crate::ImportError;

/// Stamps and log times that are nearer are of one clock, ns.
pub const ONE_CLOCK: Nanos = 1_000_000_000;
/// So many messages of two bags must be equal.
const LEAST_EQUAL: usize = 3;
/// Half of the offsets of equal messages must be within this of their median, ns.
const SPREAD: Nanos = 50_000_000;
/// Equal messages must lie over so much log time of both bags, ns.
const LEAST_SPAN: Nanos = 2_000_000_000;
/// References of a bag whose offsets differ by more contradict each other, ns.
const CONTRADICT: Nanos = 100_000_000;
/// The first day of 2000, ns.
const YEAR_2000: Nanos = 946_684_800_000_000_000;

/// What is added to times of an agent, ns.
#[derive(Clone, Debug, Default)]
pub struct AgentClock {
    /// To stamps.
    pub stamp: Nanos,
    /// To log times, so that they are of the clock of the stamps.
    pub ready: Nanos,
}

/// The clocks of all agents.
pub struct Clocks {
    /// By agent.
    pub agents: Vec<AgentClock>,
    /// How they were found, a line each.
    pub words: Vec<String>,
}

/// Finds the offsets between the clocks.
///
/// # Errors
/// Agents that have no time in common; time references of a bag that contradict each other.
pub fn joined(import: &Import, small: &Small) -> Result<Clocks, ImportError> {
    let (mut words, mut unused) = (Vec::new(), Vec::new());
    let by_bag = of_bags(import, small, &mut words, &mut unused)?;
    let said: Vec<Option<Nanos>> = import
        .agents
        .iter()
        .map(|agent| said_by_map(agent, &mut words).or(by_bag[agent.bag]))
        .collect();
    let log_times = LogTimes::new(import, small);
    let moves = by_log_times(import, small, &log_times, &said, &mut words)?;
    spans::have_time_in_common(import, small, &moves)?;
    let is_joined = import.agents.iter().any(|agent| agent.bag != import.agents[0].bag);
    if is_joined && words.is_empty() {
        words.push(taken_as_one(import, small));
    }
    words.extend(unused);
    let clock = |(place, stamp): (usize, Nanos)| {
        let own = log_times.to_log(place).map_or(0, |to_log| to_log.shift);
        AgentClock {
            stamp,
            ready: stamp.saturating_sub(own),
        }
    };
    let agents = moves.into_iter().enumerate().map(clock).collect();
    Ok(Clocks { agents, words })
}

/// What the map file says is added to an agent's stamps, ns.
fn said_by_map(agent: &Agent, words: &mut Vec<String>) -> Option<Nanos> {
    let seconds = agent.map.offset?;
    words.push(format!("clock of `{}`: {seconds:+.4} s by the map file", agent.name));
    Some((seconds * 1e9) as Nanos)
}

/// What is added to the stamps of all agents, ns: as something else says it, else by log times where stamps have another epoch.
///
/// Log times count where the agents have no time in common, and where stamps are ahead by leap seconds of a clock that is known.
///
/// # Errors
/// Bags that cannot be read.
fn by_log_times(
    import: &Import,
    small: &Small,
    log_times: &LogTimes,
    said: &[Option<Nanos>],
    words: &mut Vec<String>,
) -> Result<Vec<Nanos>, ImportError> {
    let mut moves: Vec<Nanos> = said.iter().map(|said| said.unwrap_or(0)).collect();
    let is_other = |place: &usize| said[*place].is_none() && log_times.to_log(*place).is_some();
    if !(0..moves.len()).any(|place| is_other(&place)) {
        return Ok(moves);
    }
    let is_apart = spans::apart(import, small, &moves)?.is_some();
    // From log times to the one clock on which all bags end, by what is said of the reference.
    let from_log_times = said[log_times.reference].map_or(0, |said| {
        said.saturating_sub(log_times.to_log(log_times.reference).map_or(0, |to_log| to_log.shift))
    });
    for place in (0..moves.len()).filter(is_other) {
        let Some(to_log) = log_times.to_log(place) else {
            continue;
        };
        if is_apart || (to_log.is_leap && log_times.has_reference_in_step()) {
            moves[place] = to_log.shift.saturating_add(from_log_times);
            words.push(format!(
                "clock of `{}`: {}; `offset` in the map file says it otherwise",
                import.agents[place].name, to_log.words
            ));
        }
    }
    Ok(moves)
}

/// Says that nothing in the bags compares their clocks, and what could not be compared.
fn taken_as_one(import: &Import, small: &Small) -> String {
    let clock = import.map.clock.as_str();
    let uncompared: Vec<&str> = small
        .bags
        .iter()
        .flat_map(|bag| &bag.uncompared)
        .map(String::as_str)
        .collect();
    match uncompared[..] {
        [] => format!(
            "clocks of the bags: taken as one by {clock} time; nothing in the bags says otherwise (`offset` in the map file)"
        ),
        _ => format!(
            "clocks of the bags: taken as one by {clock} time. The bags are of ROS 1 and ROS 2, so messages of {} cannot be compared, because \
             their type is not read; if the clocks differ, give `offset` (s) of an agent in the map file",
            uncompared[..uncompared.len().min(4)].join(", ")
        ),
    }
}

/// What is added to the stamps of each bag by its messages, ns; `None` where nothing says it.
///
/// # Errors
/// Time references of a bag that contradict each other.
fn of_bags(
    import: &Import,
    small: &Small,
    words: &mut Vec<String>,
    unused: &mut Vec<String>,
) -> Result<Vec<Option<Nanos>>, ImportError> {
    let path = |bag: usize| import.joined.bags[bag].path();
    let (mut references, mut joined) = (Vec::new(), Vec::new());
    for (bag, said) in small.bags.iter().enumerate() {
        // What the map file says of all its agents needs no messages.
        if given(import, bag).is_some() {
            references.push(None);
            joined.push(None);
            continue;
        }
        let mut told = Vec::new();
        let found = by_references(&said.references, &mut told).map_err(|reason| {
            let reason = format!("{reason}; give `offset` (s) of its agents in the map file");
            ImportError::content(path(bag), reason)
        })?;
        let equal = (bag > 0).then(|| by_equal(&small.bags[0].seen, &said.seen, &mut told));
        let shown = path(bag).display();
        unused.extend(told.into_iter().map(|line| format!("clock of `{shown}`: {line}")));
        references.push(found);
        joined.push(equal.flatten());
    }
    let offsets = [
        references
            .iter()
            .map(|found| found.as_ref().map(|found| found.offset))
            .collect(),
        joined
            .iter()
            .map(|found| found.as_ref().map(|found| found.offset))
            .collect(),
    ];
    let composed = composed(given(import, 0), &offsets);
    say_offsets(import, &references, &joined, &composed, words);
    Ok(composed)
}

/// Says by what the offset of each bag was found.
fn say_offsets(
    import: &Import,
    references: &[Option<Reference>],
    joined: &[Option<Joined>],
    composed: &[Option<Nanos>],
    words: &mut Vec<String>,
) {
    let path = |bag: usize| import.joined.bags[bag].path();
    let first = path(0).display();
    let is_back = given(import, 0).is_none() && references[0].is_none() && composed[0].is_some();
    for (bag, offset) in composed.iter().enumerate() {
        let shown = path(bag).display();
        let Some(offset) = offset.map(to_millis) else {
            if references.iter().any(Option::is_some) && given(import, bag).is_none() {
                words.push(format!(
                    "clock of `{shown}`: nothing says how far it is from the reference, so its stamps are taken as they are (`offset` in \
                     the map file)"
                ));
            }
            continue;
        };
        if let Some(found) = &references[bag] {
            words.push(format!(
                "clock of `{shown}`: {offset:+.3} ms by {} time references ({}), which say how far its reference is ahead",
                found.count, found.name
            ));
        } else if bag == 0 && is_back {
            words.push(format!(
                "clock of `{shown}`: {offset:+.3} ms, to the time references of a bag that recorded the same messages"
            ));
        }
        if let Some(found) = &joined[bag]
            && (references[bag].is_none() || is_back)
        {
            words.push(format!(
                "clock of `{shown}`: {:+.3} ms, half of them within {:.3} ms, by {} messages that it and `{first}` recorded; write \
                 `offset: 0` if the stamps of both are GPS time",
                to_millis(found.offset),
                to_millis(found.spread),
                found.count
            ));
            if references[bag].is_none() && to_millis(found.offset) != offset {
                words.push(format!(
                    "clock of `{shown}`: {offset:+.3} ms with the offset of `{first}`, so that both have one clock"
                ));
            }
        }
    }
}

/// The offset that the map file gives to a bag: of its first agent, where all have one, ns.
fn given(import: &Import, bag: usize) -> Option<Nanos> {
    let agents = import.agents.iter().filter(|agent| agent.bag == bag);
    let offsets: Option<Vec<f64>> = agents.map(|agent| agent.map.offset).collect();
    offsets?.first().map(|seconds| (seconds * 1e9) as Nanos)
}

/// What is added to the stamps of each bag, by their offsets to a reference and to the first bag.
///
/// All bags that anything joins end on one clock. That is the reference, if any of them has one, else the first bag's. `given` is the
/// first bag's offset by the map file.
fn composed(given: Option<Nanos>, [references, joined]: &[Vec<Option<Nanos>>; 2]) -> Vec<Option<Nanos>> {
    let mut both = references.iter().zip(joined).skip(1);
    let back = both.find_map(|(reference, joined)| Some((*reference)?.saturating_sub((*joined)?)));
    let first = given.or(references.first().copied().flatten()).or(back);
    let of_bag = |(bag, (reference, joined)): (usize, (&Option<Nanos>, &Option<Nanos>))| match bag {
        0 => first,
        _ => reference.or(joined.map(|joined| joined.saturating_add(first.unwrap_or(0)))),
    };
    references.iter().zip(joined).enumerate().map(of_bag).collect()
}

/// The clock of a reference.
#[derive(Debug, PartialEq)]
struct Reference {
    offset: Nanos,
    count: usize,
    /// Topic and source.
    name: String,
}

/// The plausible reference that says the most; `unused`: why others are not used.
fn by_references(references: &References, unused: &mut Vec<String>) -> Result<Option<Reference>, String> {
    let mut found: Option<Reference> = None;
    for ([topic, source], times) in references {
        let name = format!("`{}` of `{}`", topic.escape_debug(), source.escape_debug());
        let mut offsets: Vec<Nanos> = times.iter().map(|[offset, _]| *offset).collect();
        let Some(offset) = median(&mut offsets) else { continue };
        // They are sorted now.
        let change = offsets[offsets.len() - 1].saturating_sub(offsets[0]);
        if times.iter().any(|[_, reference]| *reference < YEAR_2000) {
            unused.push(format!(
                "time references ({name}) are not used: expected dates after 2000"
            ));
            continue;
        }
        if change > ONE_CLOCK {
            unused.push(format!(
                "time references ({name}) are not used: expected one offset, found offsets that differ by {:.3} s",
                to_seconds(change)
            ));
            continue;
        }
        if let Some(other) = &found
            && other.offset.saturating_sub(offset).saturating_abs() > CONTRADICT
        {
            return Err(format!(
                "time references contradict each other: {} say {:+.3} ms, {name} say {:+.3} ms",
                other.name,
                to_millis(other.offset),
                to_millis(offset)
            ));
        }
        let count = offsets.len();
        if found.as_ref().is_none_or(|other| other.count < count) {
            found = Some(Reference { offset, count, name });
        }
    }
    Ok(found)
}

/// How the clock of a bag differs from the first bag's.
#[derive(Debug, PartialEq)]
struct Joined {
    offset: Nanos,
    spread: Nanos,
    count: usize,
}

/// The offset by messages that both recorded; `unused`: why they are not used.
fn by_equal(first: &Seen, seen: &Seen, unused: &mut Vec<String>) -> Option<Joined> {
    let both = seen.iter();
    let both = both.filter_map(|(hash, time)| Some([first.get(hash).copied()??, (*time)?]));
    let both: Vec<[Nanos; 2]> = both.collect();
    let mut offsets: Vec<Nanos> = both.iter().map(|[a, b]| a.saturating_sub(*b)).collect();
    let count = offsets.len();
    let offset = median(&mut offsets).filter(|_| count >= LEAST_EQUAL)?;
    let off = |other: Nanos| other.saturating_sub(offset).saturating_abs();
    let mut spread: Vec<Nanos> = offsets.iter().map(|other| off(*other)).collect();
    let spread = median(&mut spread).filter(|spread| *spread <= SPREAD)?;
    let near = both.iter().filter(|[a, b]| off(a.saturating_sub(*b)) <= SPREAD);
    let near: Vec<[Nanos; 2]> = near.copied().collect();
    let lasts = |side: usize| {
        let times = near.iter().map(|times| times[side]);
        let last = times.clone().max().unwrap_or(0);
        last.saturating_sub(times.min().unwrap_or(0))
    };
    let lasts = lasts(0).min(lasts(1));
    if lasts < LEAST_SPAN {
        unused.push(format!(
            "{count} messages that it and the first bag recorded are not used: expected them over {:.0} s, found them within {:.3} s, \
             as of messages that a recorder writes when it starts",
            to_seconds(LEAST_SPAN),
            to_seconds(lasts)
        ));
        return None;
    }
    Some(Joined { offset, spread, count })
}

fn median(values: &mut [Nanos]) -> Option<Nanos> {
    values.sort_unstable();
    values.get(values.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = 1_000_000;
    const NOW: Nanos = 1_700_000_000_000_000_000;

    #[test]
    fn joined_bags_end_on_one_clock() {
        // The first bag has references: the second follows it.
        let offsets = [vec![Some(5), None, None], vec![None, Some(7), None]];
        assert_eq!(composed(None, &offsets), [Some(5), Some(12), None]);
        // Only the second has: the first and the third go to its reference.
        let offsets = [vec![None, Some(100), None], vec![None, Some(7), Some(3)]];
        assert_eq!(composed(None, &offsets), [Some(93), Some(100), Some(96)]);
        // The map file says it above all.
        let offsets = [vec![None, None], vec![None, Some(7)]];
        assert_eq!(composed(Some(1), &offsets), [Some(1), Some(8)]);
        assert_eq!(composed(None, &offsets), [None, Some(7)]);
        let offsets = [vec![None, Some(100)], vec![None, None]];
        assert_eq!(composed(None, &offsets), [None, Some(100)]);
    }

    fn references(all: &[(&str, &str, Nanos, Nanos)]) -> References {
        let mut references = References::new();
        for (topic, source, offset, reference) in all {
            let of_source = references.entry([topic.to_string(), source.to_string()]);
            of_source.or_default().push([*offset, *reference]);
        }
        references
    }

    #[test]
    fn plausible_references_are_used() {
        let mut unused = Vec::new();
        let all = references(&[
            ("/a", "boot", -NOW, 5),
            ("/b", "gps", 30 * MS, NOW),
            ("/b", "gps", 31 * MS, NOW),
            ("/b", "ntp", 35 * MS, NOW),
            ("/c", "drifts", 0, NOW),
            ("/c", "drifts", 2000 * MS, NOW),
        ]);
        let found = by_references(&all, &mut unused).unwrap().unwrap();
        assert_eq!(
            (found.offset, found.count, found.name.as_str()),
            (31 * MS, 2, "`/b` of `gps`")
        );
        assert_eq!(unused.len(), 2);
        assert!(
            unused[0].contains("after 2000") && unused[1].contains("differ by 2.000 s"),
            "{unused:?}"
        );
        assert_eq!(by_references(&References::new(), &mut unused), Ok(None));
    }

    #[test]
    fn contradicting_references_are_refused_by_name() {
        let all = references(&[("/a", "gps", 18_000 * MS, NOW), ("/b", "utc", 0, NOW)]);
        let error = by_references(&all, &mut Vec::new()).unwrap_err();
        for part in [
            "contradict",
            "`/a` of `gps` say +18000.000 ms",
            "`/b` of `utc` say +0.000 ms",
        ] {
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn messages_written_when_a_recorder_starts_say_nothing() {
        let seen =
            |late: Nanos, step: Nanos| -> Seen { (0..6).map(|k| (k, Some(NOW + k as Nanos * step - late))).collect() };
        let mut unused = Vec::new();
        assert_eq!(by_equal(&seen(0, MS), &seen(9000 * MS, MS), &mut unused), None);
        assert!(unused[0].contains("are not used"), "{unused:?}");
        let found = by_equal(&seen(0, 500 * MS), &seen(37 * MS, 500 * MS), &mut unused).unwrap();
        assert_eq!(
            (found.offset, found.spread, found.count, unused.len()),
            (37 * MS, 0, 6, 1)
        );
    }
}

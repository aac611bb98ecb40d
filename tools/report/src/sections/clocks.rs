//! Rows of the clocks of agents' sensors.

use std::collections::BTreeSet;

use realo_results::Run;
use realo_schemas::report::{OffsetBy, SensorClock};

use super::Rows;

/// The player's counters of messages whose stamps cannot be those of the log's clock, and what stands in a cell of them.
const APART: [(&str, &str); 2] = [
    ("no_common_time", "no time in common with the ego"),
    ("clock_off", "another clock, left out"),
];

/// Whether some run has something to say of clocks.
pub(super) fn has_clocks(runs: &[&Run], full: bool) -> bool {
    runs.iter().any(|run| !labels(run, full).is_empty())
}

/// A row for each sensor whose clock is off, and for each agent that has no time in common with the others; in full for all sensors.
pub(super) fn clocks(rows: &mut Rows, full: bool) {
    let all: BTreeSet<(String, String)> = rows.runs.iter().flat_map(|run| labels(run, full)).collect();
    for (agent, sensor) in all {
        rows.add(format!("{agent} {sensor}").trim_end(), |run| cell(run, &agent, &sensor));
    }
}

/// The same as a sentence; empty where all clocks are right.
pub fn said(run: &Run) -> String {
    let said = labels(run, false).into_iter().filter_map(|(agent, sensor)| {
        let words = cell(run, &agent, &sensor)?;
        Some(format!("{agent} {sensor}").trim_end().to_string() + ": " + &words)
    });
    said.collect::<Vec<_>>().join("; ")
}

/// What a run says of a sensor's clock, or without a sensor of an agent's.
fn cell(run: &Run, agent: &str, sensor: &str) -> Option<String> {
    let mut clocks = run.result.clocks.iter();
    match sensor.is_empty() {
        true => apart(run, agent),
        false => clocks
            .find(|clock| clock.agent == agent && clock.sensor == sensor)
            .map(words),
    }
}

/// Agent and sensor of each row of a run; no sensor where a whole agent is meant.
fn labels(run: &Run, full: bool) -> BTreeSet<(String, String)> {
    let clocks = run.result.clocks.iter().filter(|clock| full || clock.is_notable());
    let mut labels: BTreeSet<_> = clocks
        .map(|clock| (clock.agent.clone(), clock.sensor.clone()))
        .collect();
    let losses = run.result.nodes.values().flat_map(|node| &node.losses);
    let losses = losses.filter(|(counter, _)| APART.iter().any(|(known, _)| known == counter));
    let agents = losses.flat_map(|(_, loss)| loss.worth_a_note().map(|(agent, _)| agent.to_string()));
    labels.extend(agents.map(|agent| (agent, String::new())));
    labels
}

/// How an agent's stamps are apart from those of all others.
fn apart(run: &Run, agent: &str) -> Option<String> {
    let of = |(counter, words): &(&str, &str)| {
        let mut losses = run.result.nodes.values().filter_map(|node| node.losses.get(*counter));
        losses.find(|loss| loss.agents.get(agent).is_some_and(|share| share.count > 0))?;
        Some((*words).to_string())
    };
    APART.iter().find_map(of)
}

/// Offset, what it is from, and what is wrong.
fn words(clock: &SensorClock) -> String {
    let mut words = match (clock.offset_ms, clock.bound_ms) {
        (Some(offset), Some(bound)) => vec![format!("{offset:+.1} ± {bound:.1}")],
        // As the player has found it by the log's times.
        (Some(offset), None) => vec![format!("{offset:+.1}")],
        (None, _) => vec!["offset unknown".into()],
    };
    if clock.by == Some(OffsetBy::Motion) {
        words.push("by motion".into());
    }
    if let Some((apart, bound)) = clock.to_poses_ms.zip(clock.to_poses_bound_ms) {
        words.push(format!("to the poses {apart:+.1} ± {bound:.1}"));
    }
    if let Some(counts) = &clock.counts {
        words.push(match counts.as_str() {
            "tai" => "counts TAI".into(),
            "gps" => "counts GPS time".into(),
            "boot" => "counts from boot".into(),
            "weeks" => "weeks of GPS rolled over".into(),
            other => format!("another clock ({other})"),
        });
    }
    if let Some(step) = clock.step_ms {
        words.push(format!("stepped by {step:+.0}"));
    }
    for (fault, named) in [
        ("stamp_repeated", "repeated"),
        ("stamp_stands_still", "standing still"),
        ("stamp_backwards", "backwards"),
        ("stamp_ahead", "ahead"),
    ] {
        if let Some(count) = clock.faults.get(fault) {
            words.push(format!("{count} of {} {named}", clock.messages));
        }
    }
    if clock.contradicted {
        words.push("! arrival and motion contradict".into());
    }
    words.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::run;
    use crate::{Options, shown};

    fn clock(agent: &str, sensor: &str, offset: f64) -> SensorClock {
        SensorClock {
            agent: agent.into(),
            sensor: sensor.into(),
            messages: 100,
            offset_ms: Some(offset),
            bound_ms: Some(2.5),
            ..SensorClock::default()
        }
    }

    #[test]
    fn clocks_that_are_off_are_shown_and_all_of_them_in_full() {
        let mut first = run("log", "cav1", 1);
        let stepped = SensorClock {
            step_ms: Some(600.4),
            counts: Some("tai".into()),
            faults: [("stamp_jump".to_string(), 1)].into(),
            ..clock("cav2", "lidar", -37_000.0)
        };
        for clock in [clock("cav1", "imu", 1.0), clock("cav2", "imu", -80.04), stepped] {
            first.result.add_clock(&clock);
        }
        let second = run("log", "cav2", 2);
        let options = Options {
            width: 200,
            ..Options::default()
        };
        let table = shown(&[("late", &first), ("none", &second)], &options);
        for part in [
            "clocks: to be added to stamps",
            "cav2 imu",
            "-80.0 ± 2.5",
            "counts TAI, stepped by +600",
        ] {
            assert!(table.contains(part), "no `{part}` in {table}");
        }
        assert!(!table.contains("cav1 imu"), "{table}");
        let full = Options { full: true, ..options };
        assert!(shown(&[("late", &first), ("none", &second)], &full).contains("cav1 imu"));
        let three = [("late", &first), ("none", &second), ("other", &second)];
        let list = shown(&three, &options);
        assert!(
            list.contains("clocks (late), to be added to stamps") && list.contains("cav2 imu: -80.0"),
            "{list}"
        );
        assert!(!shown(&[("none", &second)], &options).contains("clocks"));
    }
}

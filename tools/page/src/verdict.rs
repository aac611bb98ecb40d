//! What came out of runs, in three sentences.

use std::collections::BTreeSet;

use realo_report::has_recorded_detections;
use realo_results::{Ages, Fates, Run, Spread};
use realo_schemas::Kind;

use crate::alone::{Against, against, is_alone};
use crate::localized::localization_cost;

/// The overlap that sentences are about, where the protocol has it.
const IOU: &str = "0.5";

/// The overlap that sentences are about: 0.5, else the first of the runs.
pub fn overlap(runs: &[(&str, &Run)]) -> String {
    let accuracies = runs.iter().filter_map(|(_, run)| run.result.accuracy.as_ref());
    let ious: BTreeSet<&String> = accuracies.flat_map(|accuracy| accuracy.sorted.mean_ap.keys()).collect();
    match ious.iter().any(|iou| *iou == IOU) {
        true => IOU.into(),
        false => ious.first().map_or(String::new(), |iou| (*iou).clone()),
    }
}

/// Who beat whom, what cooperation gained or harmed, which runs did not come to their end, and what was lost or late.
pub fn sentences(runs: &[(&str, &Run)]) -> Vec<String> {
    let iou = overlap(runs);
    let scored = scored(runs, &iou);
    let mut said = vec![ranking(&scored, &iou)];
    if let (Some(found), [first]) = (boxes_found(runs), &mut said[..])
        && scored.is_empty()
    {
        *first = format!("{first} {found}");
    }
    let against = against(runs);
    said.extend(margins(&scored, &against));
    if let (Some(last), Some(without)) = (said.last_mut(), without_margin(&scored, &against)) {
        *last = format!("{last} {without}");
    }
    said.extend(localization_cost(runs, runs));
    said.extend(ended(runs));
    said.push(traffic(runs));
    said
}

/// The places of runs, the one of the highest score first; those without a score come last, in their order.
pub fn by_score(runs: &[(&str, &Run)]) -> Vec<usize> {
    let mut means = vec![f64::NEG_INFINITY; runs.len()];
    for one in scored(runs, &overlap(runs)) {
        means[one.at] = one.mean;
    }
    let mut order: Vec<usize> = (0..runs.len()).collect();
    order.sort_by(|a, b| means[*b].total_cmp(&means[*a]));
    order
}

/// The mean average precision of a run.
pub(crate) fn mean(run: &Run, iou: &str) -> Option<f64> {
    Scored::of(0, "", run, iou).map(|scored| scored.mean)
}

fn scored<'a>(runs: &[(&'a str, &'a Run)], iou: &str) -> Vec<Scored<'a>> {
    let all = runs.iter().enumerate();
    all.filter_map(|(at, (name, run))| Scored::of(at, name, run, iou))
        .collect()
}

/// A run with a mean average precision.
struct Scored<'a> {
    /// Its place among all runs.
    at: usize,
    name: &'a str,
    run: &'a Run,
    mean: f64,
    /// Whether every class has objects, so that the mean is over all.
    is_whole: bool,
    interval: Option<[f64; 2]>,
    /// By class.
    ap: Vec<(&'a str, f64)>,
}

impl<'a> Scored<'a> {
    fn of(at: usize, name: &'a str, run: &'a Run, iou: &str) -> Option<Self> {
        let accuracy = &run.result.accuracy.as_ref()?.sorted;
        let known = |(class, ap): (&'a String, &std::collections::BTreeMap<String, Option<f64>>)| {
            Some((class.as_str(), ap.get(iou).copied().flatten()?))
        };
        let ap: Vec<(&str, f64)> = accuracy.ap.iter().filter_map(known).collect();
        let sum: f64 = ap.iter().map(|(_, ap)| ap).sum();
        let whole = accuracy.mean_ap.get(iou).copied().flatten();
        let intervals = run.result.intervals.as_ref();
        Some(Scored {
            at,
            name,
            run,
            // Where classes have no objects, the mean of the others, as tables say it.
            mean: whole.or_else(|| (!ap.is_empty()).then(|| sum / ap.len() as f64))?,
            is_whole: whole.is_some(),
            interval: intervals.and_then(|all| all.accuracy.sorted.mean_ap.get(iou).copied().flatten()),
            ap,
        })
    }

    /// What it was scored on: protocol, logs and egos, how many sweeps where somebody ended it, and whether detections came out of the log.
    fn scope(&self) -> Scope<'_> {
        let result = &self.run.result;
        (
            result.protocol.as_deref(),
            result.logs.iter().map(String::as_str).collect(),
            result.egos.iter().map(String::as_str).collect(),
            result.ended_by.as_ref().map(|_| result.frames.key),
            has_recorded_detections(self.run),
        )
    }

    /// What the mean is: mAP only over all classes.
    fn metric(&self) -> String {
        let classes: Vec<&str> = self.ap.iter().map(|(class, _)| *class).collect();
        match &classes[..] {
            _ if self.is_whole => "mAP".into(),
            [class] => format!("AP of {class}"),
            classes => format!("mAP of {}", classes.join(", ")),
        }
    }

    /// The value, with what it is where the runs before it have another.
    fn value_after(&self, before: &Scored) -> String {
        match self.metric() == before.metric() {
            true => self.value(),
            false => format!("{} {}", self.metric(), self.value()),
        }
    }

    fn value(&self) -> String {
        match self.interval {
            Some([low, high]) => format!("{:.3} (95 % interval {low:.3} to {high:.3})", self.mean),
            None => format!("{:.3}", self.mean),
        }
    }
}

type Scope<'a> = (Option<&'a str>, BTreeSet<&'a str>, BTreeSet<&'a str>, Option<u64>, bool);

fn ranking(scored: &[Scored], iou: &str) -> String {
    let mut order: Vec<&Scored> = scored.iter().collect();
    order.sort_by(|a, b| b.mean.total_cmp(&a.mean));
    let same_logs = order.iter().all(|scored| scored.scope() == order[0].scope());
    match order.as_slice() {
        [] => "No run was scored: the log has no truth, or the graph has no evaluator.".into(),
        [only] => format!("{} reaches {} {} at IoU {iou}.", only.name, only.metric(), only.value()),
        [first, second, ..] if three(first.mean) == three(second.mean) => {
            let level = order
                .iter()
                .take_while(|one| three(one.mean) == three(first.mean))
                .count();
            let last = order.last().filter(|_| level < order.len());
            let last = last.map_or(String::new(), |last| {
                format!("; last is {} with {:.3}", last.name, last.mean)
            });
            let names = match level {
                2 => format!("{} and {}", first.name, second.name),
                _ if level == order.len() => format!("All {level} runs"),
                _ => format!("{}, {} and {} more", first.name, second.name, level - 2),
            };
            format!(
                "{names} are level, at {} {:.3} at IoU {iou}{last}.",
                first.metric(),
                first.mean
            )
        }
        [first, second, ..] => {
            let last = order.last().filter(|_| order.len() > 2);
            let last = last.map_or(String::new(), |last| {
                format!("; last is {} with {:.3}", last.name, last.mean)
            });
            let classes = match same_logs {
                true => better_on_classes(&order),
                false => String::new(),
            };
            format!(
                "{} {}, with {} {} at IoU {iou}: {:.3} more than {}, which has {}{last}.{classes} {}",
                first.name,
                if same_logs { "is best" } else { "has the highest score" },
                first.metric(),
                first.value(),
                first.mean - second.mean,
                second.name,
                second.value_after(first),
                match same_logs {
                    true => certainty(first, second).into(),
                    false => format!(
                        "They are not of the same {}, so this does not say which is better.",
                        apart(&order)
                    ),
                }
            )
        }
    }
}

/// How many boxes runs found: all that is known of boxes that are not scored.
fn boxes_found(runs: &[(&str, &Run)]) -> Option<String> {
    const MOST: usize = 4;
    let of = |(name, run): &(&str, &Run)| {
        let boxes = run.result.boxes.as_ref()?;
        Some(format!(
            "{name} found {} boxes, {:.1} a sweep",
            boxes.total, boxes.per_frame
        ))
    };
    let mut all: Vec<String> = runs.iter().filter_map(of).collect();
    if all.len() > MOST {
        let more = all.len() - MOST;
        all.truncate(MOST);
        all.push(format!("{more} more are in the table"));
    }
    (!all.is_empty()).then(|| format!("{}.", all.join("; ")))
}

/// From here on a run is said to be better on a class than the best one.
const BETTER: f64 = 0.01;

/// Classes on which another run that fuses is better than the best; what fusing harms has words of its own.
fn better_on_classes(order: &[&Scored]) -> String {
    const MOST: usize = 3;
    let (first, others) = (order[0], &order[1..]);
    let mut said = Vec::new();
    for (class, ap) in &first.ap {
        let fused = others.iter().filter(|one| !is_alone(one.run));
        let of = |one: &&Scored| {
            let known = one.ap.iter().find(|(known, _)| known == class);
            known.map(|(_, ap)| *ap)
        };
        let best = fused.filter_map(|one| Some((one.name, of(one)?)));
        if let Some((name, most)) = best.max_by(|a, b| a.1.total_cmp(&b.1))
            && most - ap >= BETTER
        {
            said.push(format!(
                "{name} is better on {class} ({most:.3}, {} {ap:.3})",
                first.name
            ));
        }
    }
    if said.len() > MOST {
        let more = said.len() - MOST;
        said.truncate(MOST);
        said.push(format!("others on {more} more classes"));
    }
    match said.is_empty() {
        true => String::new(),
        false => format!(" But {}.", said.join(", ")),
    }
}

/// What runs have been scored on that is not the same for all.
fn apart(scored: &[&Scored]) -> String {
    let (protocol, logs, egos, ended, recorded) = scored[0].scope();
    let all = |is_same: &dyn Fn(&Scored) -> bool| scored.iter().all(|one| is_same(one));
    let parts = [
        ("logs", all(&|one| one.scope().1 == logs)),
        ("egos", all(&|one| one.scope().2 == egos)),
        ("protocol", all(&|one| one.scope().0 == protocol)),
        ("sweeps", all(&|one| one.scope().3 == ended)),
        ("source of detections", all(&|one| one.scope().4 == recorded)),
    ];
    let apart: Vec<&str> = parts.iter().filter(|(_, same)| !same).map(|(name, _)| *name).collect();
    apart.join(" and ")
}

fn three(value: f64) -> i64 {
    (value * 1000.0).round() as i64
}

fn certainty(first: &Scored, second: &Scored) -> &'static str {
    match (first.interval, second.interval) {
        (Some([low, _]), Some([_, high])) if low > high => "The intervals do not overlap.",
        (Some(_), Some(_)) => "The intervals overlap: other logs may turn the order.",
        _ => "Intervals need two logs or more: a small difference may be chance.",
    }
}

/// Runs of the ego alone that have a sentence of their own.
const MOST_ALONE: usize = 4;

/// Fused minus ego alone, for each run that fuses, in a sentence for each run of the ego alone.
fn margins(scored: &[Scored], against: &[Against]) -> Vec<String> {
    let alone: Vec<&Scored> = scored.iter().filter(|one| is_alone(one.run)).collect();
    let of = |alone: &&Scored| margin(alone, scored, against);
    let mut said: Vec<String> = alone.iter().filter_map(of).collect();
    if said.len() > MOST_ALONE {
        let more = said.len() - MOST_ALONE;
        said.truncate(MOST_ALONE);
        said.push(format!(
            "Margins over {more} more runs of the ego alone are in the table."
        ));
    }
    said
}

/// What fusing gained and harmed over one run of the ego alone.
fn margin(alone: &Scored, scored: &[Scored], against: &[Against]) -> Option<String> {
    let is_compared = |one: &&Scored| against[one.at].against == Some(alone.at);
    let mut fused: Vec<&Scored> = scored.iter().filter(is_compared).collect();
    fused.sort_by(|a, b| b.mean.total_cmp(&a.mean));
    if fused.is_empty() {
        return None;
    }
    const MOST: usize = 6;
    let margin = |fused: &&Scored| format!("{} {:+.3}", fused.name, fused.mean - alone.mean);
    let mut all: Vec<String> = fused.iter().take(MOST).map(margin).collect();
    if fused.len() > MOST {
        all.push(format!("{} more in the table", fused.len() - MOST));
    }
    let mut harm: Vec<String> = fused.iter().flat_map(|fused| harmed(fused, alone)).collect();
    if harm.len() > MOST {
        let more = harm.len() - MOST;
        harm.truncate(MOST);
        harm.push(format!("{more} more in the table"));
    }
    let harm = match harm.is_empty() {
        true => "no class became worse".into(),
        false => format!("worse than the ego alone: {}", harm.join(", ")),
    };
    Some(format!(
        "Margin over the ego alone ({}): {}; {harm}.",
        alone.name,
        all.join(", ")
    ))
}

/// Runs that fuse and have no run of the ego alone to compare with, though there are some.
fn without_margin(scored: &[Scored], against: &[Against]) -> Option<String> {
    const MOST: usize = 4;
    let mut by_reason: std::collections::BTreeMap<&str, Vec<&str>> = Default::default();
    for one in scored {
        if let Some(what) = against[one.at].no_margin {
            by_reason.entry(what).or_default().push(one.name);
        }
    }
    let in_words = |(what, names): (&&str, &Vec<&str>)| {
        let more = names.len().saturating_sub(MOST);
        let few = names[..names.len().min(MOST)].join(", ");
        let more = if more > 0 {
            format!(" and {more} more")
        } else {
            String::new()
        };
        format!("No margin for {few}{more}: no run of the ego alone here has the same {what}.")
    };
    let said: Vec<String> = by_reason.iter().map(in_words).collect();
    (!said.is_empty()).then(|| said.join(" "))
}

/// Runs that somebody ended before their logs.
fn ended(runs: &[(&str, &Run)]) -> Option<String> {
    const MOST: usize = 4;
    let by = |(name, run): &(&str, &Run)| {
        let result = &run.result;
        let by = result.ended_by.as_ref()?;
        Some(format!("{name} by {by}, after {} scored sweeps", result.frames.key))
    };
    let mut all: Vec<String> = runs.iter().filter_map(by).collect();
    if all.len() > MOST {
        let more = all.len() - MOST;
        all.truncate(MOST);
        all.push(format!("{more} more"));
    }
    (!all.is_empty()).then(|| format!("Ended before the log was: {}.", all.join("; ")))
}

/// Classes in which a run is worse than the ego alone.
fn harmed(fused: &Scored, alone: &Scored) -> Vec<String> {
    let worse = |(class, ap): &(&str, f64)| {
        let (_, before) = alone.ap.iter().find(|(known, _)| known == class)?;
        (three(*ap) < three(*before)).then(|| format!("{} on {class} ({:+.3})", fused.name, ap - before))
    };
    fused.ap.iter().filter_map(worse).collect()
}

fn traffic(runs: &[(&str, &Run)]) -> String {
    let (mut sent, mut lost, mut fates) = (0, 0, Fates::default());
    let mut ages = Ages::default();
    let (mut skipped, mut key, mut within) = (0, 0, 0);
    for (_, run) in runs {
        let channels = run
            .result
            .channels()
            .filter(|(_, kind, _)| *kind != Kind::AgentState.as_str());
        for (.., books) in channels.filter(|(.., books)| books.accounted.is_some()) {
            (sent, lost) = (sent + books.sent, lost + books.lost);
            if let Some(accounted) = &books.accounted {
                fates.add(&accounted.fates);
            }
        }
        let kinds = run
            .samples
            .ages_ns
            .iter()
            .filter(|(kind, _)| **kind != Kind::AgentState);
        let offline = run.result.settings.mode == "offline";
        kinds.for_each(|(_, of_kind)| ages.merge(&if offline { of_kind.distances() } else { of_kind.clone() }));
        skipped += run.result.frames.key_skipped;
        key += run.result.frames.key;
        within += run.result.transport.total_lost;
    }
    let boxes = match skipped {
        _ if key == 0 => "no sweep is scored".to_string(),
        0 => format!("all {key} scored sweeps got boxes"),
        _ => format!("{skipped} of {key} scored sweeps got no boxes"),
    };
    let boxes = match within {
        0 => boxes,
        lost => format!("{boxes}; dora lost {lost} between nodes, so scores are those of a disturbed run"),
    };
    if sent == 0 {
        return format!("No message for fusion crossed a link; {boxes}.");
    }
    let not_used = [
        ("lost on the link", lost),
        ("too old when asked for", fates.stale),
        ("skipped by busy stages", fates.skipped),
        ("replaced by newer ones", fates.superseded),
        ("distrusted", fates.distrusted),
        ("over the limit of the fusion", fates.over_limit),
        ("rejected", fates.rejected),
    ];
    let not_used: Vec<String> = not_used
        .iter()
        .filter(|(_, count)| *count > 0)
        .map(|(what, count)| format!("{count} {what}"))
        .collect();
    let not_used = match not_used.is_empty() {
        true => "none was lost or late".into(),
        false => not_used.join(", "),
    };
    let of = if runs.len() > 1 {
        "In all runs together, of"
    } else {
        "Of"
    };
    let spread = Spread::of_ages(&ages);
    let all_offline = runs.iter().all(|(_, run)| run.result.settings.mode == "offline");
    let age = match (spread.p50, spread.p95) {
        (Some(half), Some(most)) if all_offline => {
            format!(
                "; stamps of fused data are {} apart in the median, {} at p95",
                ms(half),
                ms(most)
            )
        }
        (Some(half), Some(most)) => format!("; fused data are {} old in the median, {} at p95", ms(half), ms(most)),
        _ => String::new(),
    };
    format!(
        "{of} {sent} messages {} were used ({:.0} %), {not_used}{age}; {boxes}.",
        fates.used,
        100.0 * fates.used as f64 / sent as f64
    )
}

fn ms(value: f64) -> String {
    match value.abs() < 9.95 {
        true => format!("{value:.1} ms"),
        false => format!("{value:.0} ms"),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::collections::BTreeMap;

    use realo_results::{Accounted, Cooperation, FinalBoxes, LinkBooks, RunResult, Samples, Settings, Timing};
    use realo_scoring::{Accuracy, Bounds, Intervals, Orders};

    use super::*;

    pub(crate) fn run(vehicle: f64, pedestrian: f64, fuses: bool) -> Run {
        let iou = |value| BTreeMap::from([("0.5".to_string(), Some(value))]);
        let accuracy = Accuracy {
            ap: BTreeMap::from([("vehicle".into(), iou(vehicle)), ("pedestrian".into(), iou(pedestrian))]),
            mean_ap: iou((vehicle + pedestrian) / 2.0),
            ..Accuracy::default()
        };
        let mut result = RunResult::new(Settings::default());
        result.accuracy = Some(Orders {
            sorted: accuracy.clone(),
            v2x_real: accuracy,
        });
        result.cooperation = fuses.then(Cooperation::default);
        result.frames.key = 20;
        Run {
            result,
            timing: Timing::default(),
            samples: Samples::default(),
        }
    }

    fn with_interval(mut run: Run, bounds: [f64; 2]) -> Run {
        let of = Bounds {
            mean_ap: BTreeMap::from([("0.5".into(), Some(bounds))]),
            ..Bounds::default()
        };
        let orders = || Orders {
            sorted: of.clone(),
            v2x_real: of.clone(),
        };
        run.result.intervals = Some(Intervals {
            accuracy: orders(),
            accuracy_seen: orders(),
        });
        run
    }

    #[test]
    fn the_best_is_named_with_its_lead_and_what_it_harms() {
        let (late, none) = (run(0.9, 0.5, true), run(0.6, 0.6, false));
        let said = sentences(&[("none", &none), ("late", &late)]);
        assert_eq!(
            said[0],
            "late is best, with mAP 0.700 at IoU 0.5: 0.100 more than none, which has 0.600. Intervals need two logs or more: \
             a small difference may be chance."
        );
        assert_eq!(
            said[1],
            "Margin over the ego alone (none): late +0.100; worse than the ego alone: late on pedestrian (-0.100)."
        );
        assert_eq!(
            said[2],
            "No message for fusion crossed a link; all 40 scored sweeps got boxes."
        );
    }

    #[test]
    fn who_is_better_on_a_class_than_the_best_is_named() {
        let (attfuse, late, none) = (run(0.9, 0.7, true), run(0.7, 0.75, true), run(0.6, 0.9, false));
        let said = |late: &Run| sentences(&[("none", &none), ("late", late), ("attfuse", &attfuse)])[0].clone();
        assert!(
            said(&late).contains("0.050 more than none, which has 0.750; last is late with 0.725. But late is better on pedestrian (0.750, attfuse 0.700). Intervals"),
            "{}",
            said(&late)
        );
        let level = said(&run(0.7, 0.709, true));
        assert!(!level.contains("But"), "{level}");
        let mut elsewhere = late.clone();
        elsewhere.result.logs = vec!["elsewhere".into()];
        let elsewhere = said(&elsewhere);
        assert!(!elsewhere.contains("But"), "{elsewhere}");
    }

    #[test]
    fn runs_over_other_logs_are_not_ranked() {
        let (mut late, none) = (run(0.9, 0.5, true), run(0.6, 0.6, false));
        late.result.logs = vec!["elsewhere".into()];
        let said = sentences(&[("none", &none), ("late", &late)]);
        assert_eq!(said.len(), 2, "no margin over another log");
        let said = &said[0];
        assert!(
            said.ends_with("No margin for late: no run of the ego alone here has the same logs."),
            "{said}"
        );
        assert!(said.starts_with("late has the highest score"), "{said}");
        assert!(
            said.contains("not of the same logs, so") && !said.contains("is best"),
            "{said}"
        );
    }

    #[test]
    fn a_run_is_compared_with_the_ego_alone_of_its_own_log() {
        let on = |log: &str, mut run: Run| {
            run.result.logs = vec![log.into()];
            run
        };
        // Over log a fusing harms; the ego alone over log b is far worse than that over log a.
        let (late_a, none_a) = (on("a", run(0.7, 0.7, true)), on("a", run(0.8, 0.8, false)));
        let (late_b, none_b) = (on("b", run(0.5, 0.5, true)), on("b", run(0.4, 0.4, false)));
        let other = on("c", run(0.6, 0.6, true));
        let said = sentences(&[
            ("late a", &late_a),
            ("late b", &late_b),
            ("none b", &none_b),
            ("none a", &none_a),
            ("late c", &other),
        ]);
        assert_eq!(
            said[1..3],
            [
                "Margin over the ego alone (none b): late b +0.100; no class became worse.",
                "Margin over the ego alone (none a): late a -0.100; worse than the ego alone: late a on pedestrian (-0.100), late a \
                 on vehicle (-0.100). No margin for late c: no run of the ego alone here has the same logs.",
            ]
        );
    }

    #[test]
    fn runs_that_are_level_are_counted_and_the_best_come_first() {
        let (low, high) = (run(0.5, 0.5, true), run(0.7, 0.7, true));
        let same = [("r1", &high), ("r10", &high), ("r11", &high)];
        assert_eq!(sentences(&same)[0], "All 3 runs are level, at mAP 0.700 at IoU 0.5.");
        let all = [("r0", &low), ("r1", &high), ("r10", &high), ("r11", &high)];
        assert_eq!(
            sentences(&all)[0],
            "r1, r10 and 1 more are level, at mAP 0.700 at IoU 0.5; last is r0 with 0.500."
        );
        let mut silent = run(0.9, 0.9, true);
        silent.result.accuracy = None;
        assert_eq!(by_score(&[("s", &silent), all[0], all[1], all[2]]), [2, 3, 1, 0]);
    }

    #[test]
    fn a_run_that_somebody_ended_is_named_and_not_ranked_with_whole_ones() {
        let (mut late, none) = (run(0.9, 0.5, true), run(0.6, 0.6, false));
        late.result.ended_by = Some("Ctrl-C".into());
        late.result.frames.key = 7;
        let said = sentences(&[("none", &none), ("late", &late)]);
        assert!(said[0].contains("not of the same sweeps"), "{said:?}");
        assert!(said[0].contains("No margin for late"), "{said:?}");
        assert_eq!(
            said[1],
            "Ended before the log was: late by Ctrl-C, after 7 scored sweeps."
        );
    }

    #[test]
    fn intervals_say_how_sure_the_order_is() {
        let first = with_interval(run(0.9, 0.7, true), [0.75, 0.85]);
        for (high, words) in [(0.7, "do not overlap"), (0.8, "overlap: other logs")] {
            let second = with_interval(run(0.6, 0.6, true), [0.5, high]);
            let said = &sentences(&[("a", &first), ("b", &second)])[0];
            assert!(
                said.contains(words) && said.contains("0.800 (95 % interval 0.750 to 0.850)"),
                "{said}"
            );
        }
        assert!(sentences(&[("a", &first), ("b", &first)])[0].starts_with("a and b are level"));
    }

    #[test]
    fn a_mean_over_some_classes_is_called_what_it_is() {
        let only_of = |classes: &[&str], value: f64| {
            let mut run = run(value, value, true);
            let accuracy = &mut run.result.accuracy.as_mut().unwrap().sorted;
            accuracy.mean_ap.values_mut().for_each(|mean| *mean = None);
            for (class, ap) in &mut accuracy.ap {
                let has_objects = classes.contains(&class.as_str());
                ap.values_mut().for_each(|ap| *ap = ap.filter(|_| has_objects));
            }
            accuracy.ap.insert("truck".into(), [("0.5".to_string(), None)].into());
            run
        };
        let (one, two) = (only_of(&["vehicle"], 1.0), only_of(&["vehicle", "pedestrian"], 0.5));
        let said = |runs: &[(&str, &Run)]| sentences(runs)[0].clone();
        assert_eq!(said(&[("late", &one)]), "late reaches AP of vehicle 1.000 at IoU 0.5.");
        assert_eq!(
            said(&[("late", &two)]),
            "late reaches mAP of pedestrian, vehicle 0.500 at IoU 0.5."
        );
        assert_eq!(
            said(&[("a", &one), ("b", &one)]),
            "a and b are level, at AP of vehicle 1.000 at IoU 0.5."
        );
        let apart = said(&[("a", &one), ("b", &two)]);
        assert!(
            apart.contains(
                "with AP of vehicle 1.000 at IoU 0.5: 0.500 more than b, which has mAP of pedestrian, vehicle 0.500"
            ),
            "{apart}"
        );
    }

    #[test]
    fn what_was_lost_or_late_is_counted() {
        let mut late = run(0.9, 0.5, true);
        let books = LinkBooks {
            sent: 100,
            lost: 7,
            accounted: Some(Accounted {
                fates: Fates {
                    used: 90,
                    stale: 3,
                    ..Fates::default()
                },
                unaccounted: 0,
            }),
            ..LinkBooks::default()
        };
        late.result
            .links
            .insert("rsu1-cav1".into(), BTreeMap::from([("boxes".into(), books)]));
        let said = sentences(&[("late", &late)]);
        assert_eq!(said.len(), 2, "no ego alone, no margin");
        assert_eq!(
            said[1],
            "Of 100 messages 90 were used (90 %), 7 lost on the link, 3 too old when asked for; all 20 scored sweeps got boxes."
        );
    }

    #[test]
    fn a_run_without_scores_says_so() {
        let mut silent = run(0.9, 0.5, true);
        silent.result.accuracy = None;
        silent.result.frames.key = 0;
        let said = sentences(&[("a", &silent)]);
        assert_eq!(
            said[0],
            "No run was scored: the log has no truth, or the graph has no evaluator."
        );
        silent.result.boxes = Some(FinalBoxes {
            frames: 2,
            total: 3,
            per_frame: 1.5,
            ..FinalBoxes::default()
        });
        let found = &sentences(&[("a", &silent)])[0];
        assert!(
            found.ends_with("no evaluator. a found 3 boxes, 1.5 a sweep."),
            "{found}"
        );
        let runs: Vec<(&str, &Run)> = ["a", "b", "c", "d", "e", "f"].map(|name| (name, &silent)).into();
        let found = &sentences(&runs)[0];
        assert!(found.ends_with("; 2 more are in the table."), "{found}");
        assert_eq!(said[1], "No message for fusion crossed a link; no sweep is scored.");
    }
}

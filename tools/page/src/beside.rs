//! How a run that was played by itself compares with earlier ones of the same logs.

use realo_results::Run;

use crate::alone::{is_alone, is_comparable};
use crate::verdict::{mean, overlap};

/// Earlier runs that are named at most.
const MOST: usize = 3;

/// How much more or less a run has than earlier ones of the same logs, in a sentence: the ego alone first, then the best. Where no run
/// of the ego alone is among them, what to play for it. `None` of the ego alone, and where nothing is scored.
pub fn beside(run: &Run, earlier: &[(&str, &Run)]) -> Option<String> {
    if is_alone(run) {
        return None;
    }
    let iou = overlap(&[("", run)]);
    let own = mean(run, &iou)?;
    let comparable = earlier.iter().filter(|(_, other)| is_comparable(run, other));
    let mut scored: Vec<(bool, f64, &str)> = comparable
        .filter_map(|(name, other)| Some((is_alone(other), mean(other, &iou)?, *name)))
        .collect();
    scored.sort_by(|a, b| b.0.cmp(&a.0).then(b.1.total_cmp(&a.1)));
    let has_alone = scored.first().is_some_and(|(is_alone, ..)| *is_alone);
    scored.truncate(MOST);
    let margin = |(_, mean, name): &(bool, f64, &str)| {
        let more = own - mean;
        if more.abs() < 0.0005 {
            return format!("as much as {name}");
        }
        format!(
            "{:.3} {} than {name}",
            more.abs(),
            if more < 0.0 { "less" } else { "more" }
        )
    };
    let margins: Vec<String> = scored.iter().map(margin).collect();
    let hint = "Play no_fusion on the same logs, before or in one command, to see what is gained over the ego alone.";
    Some(match (margins.split_last(), has_alone) {
        (None, _) => hint.into(),
        (Some((last, [])), true) => format!("That is {last}, played before."),
        (Some((last, others)), true) => format!("That is {} and {last}, played before.", others.join(", ")),
        (Some((last, [])), false) => format!("That is {last}, played before. {hint}"),
        (Some((last, others)), false) => format!("That is {} and {last}, played before. {hint}", others.join(", ")),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verdict::tests::run;

    #[test]
    fn a_run_by_itself_stands_beside_those_before_it() {
        let (own, late, points) = (run(0.8, 0.6, true), run(0.7, 0.6, true), run(0.9, 0.6, true));
        let alone = run(0.5, 0.6, false);
        let mut other_log = run(0.1, 0.1, false);
        other_log.result.logs = vec!["other".into()];
        let mut other_mode = late.clone();
        other_mode.result.settings.mode = "virtual".into();
        let hint =
            "Play no_fusion on the same logs, before or in one command, to see what is gained over the ego alone.";
        assert_eq!(beside(&alone, &[("late", &late)]), None);
        let unusable = [("other", &other_log), ("virtual", &other_mode)];
        assert_eq!(beside(&own, &unusable).as_deref(), Some(hint));
        assert_eq!(
            beside(&own, &[("late", &late)]),
            Some(format!("That is 0.050 more than late, played before. {hint}"))
        );
        assert_eq!(
            beside(&own, &[("again", &own.clone()), ("none", &alone)]).as_deref(),
            Some("That is 0.150 more than none and as much as again, played before.")
        );
        assert_eq!(
            beside(
                &own,
                &[
                    ("late", &late),
                    ("early", &points),
                    ("none", &alone),
                    ("other", &other_log)
                ]
            )
            .as_deref(),
            Some("That is 0.150 more than none, 0.050 less than early and 0.050 more than late, played before.")
        );
    }
}

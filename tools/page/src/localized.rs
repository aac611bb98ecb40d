//! What it costs that agents estimate their poses.

use realo_results::{Run, Settings};

use crate::alone::{is_alone, is_comparable};
use crate::verdict::{mean, overlap};

/// Runs that are named at most.
const MOST: usize = 4;

/// How much less runs have whose agents estimated their poses than the same with the poses of the log, in a sentence; those are looked for
/// among `others`. `None` where there are none.
pub fn localization_cost(runs: &[(&str, &Run)], others: &[(&str, &Run)]) -> Option<String> {
    let iou = overlap(runs);
    let costs = runs.iter().filter(|(_, run)| !is_alone(run)).filter_map(|(name, run)| {
        let (reference, exact) = others.iter().find(|(_, other)| differs_in_poses_alone(run, other))?;
        let (own, exact) = (mean(run, &iou)?, mean(exact, &iou)?);
        let theirs = match run.result.settings.mode.as_str() {
            "offline" => "exact ones",
            _ => "those of the log",
        };
        let settings = &run.result.settings;
        Some(format!(
            "{}, and {exact:.3} with {theirs} ({reference})",
            cost(name, &settings.pose_source, own, exact)
        ))
    });
    let mut costs: Vec<String> = costs.collect();
    if costs.is_empty() {
        return None;
    }
    if costs.len() > MOST {
        let more = costs.len() - MOST;
        costs.truncate(MOST);
        costs.push(format!("{more} more are in the table"));
    }
    Some(format!("Localization, at IoU {iou}: {}.", costs.join("; ")))
}

fn cost(name: &str, source: &str, own: f64, exact: f64) -> String {
    let lost = exact - own;
    let says = match lost {
        _ if lost.abs() < 0.0005 => "cost nothing".into(),
        _ if lost > 0.0 => format!("cost {lost:.3}"),
        _ => format!("gain {:.3}", -lost),
    };
    format!("poses of {source} {says} in {name}: {own:.3}")
}

/// Whether one run has estimated poses, the other has those of the log, and all else that was chosen is the same.
fn differs_in_poses_alone(run: &Run, other: &Run) -> bool {
    let chosen = |run: &Run| Settings {
        pose_source: String::new(),
        ..run.result.settings.clone()
    };
    let (own, exact) = (&run.result.settings.pose_source, &other.result.settings.pose_source);
    let is_same = !is_alone(other) && is_comparable(run, other) && chosen(run) == chosen(other);
    !own.is_empty() && exact.is_empty() && is_same
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verdict::tests::run;

    fn estimated(vehicle: f64, source: &str) -> Run {
        let mut run = run(vehicle, 0.6, true);
        run.result.settings.pose_source = source.into();
        run
    }

    #[test]
    fn runs_are_compared_with_the_same_but_for_their_poses() {
        let (recorded, map, gnss) = (
            run(0.8, 0.6, true),
            estimated(0.79, "map (m-1)"),
            estimated(0.4, "gnss"),
        );
        let all = [("log", &recorded), ("map", &map), ("gnss", &gnss)];
        assert_eq!(
            localization_cost(&all, &all).as_deref(),
            Some(
                "Localization, at IoU 0.5: poses of map (m-1) cost 0.005 in map: 0.695, and 0.700 with those of the log (log); poses of \
                 gnss cost 0.200 in gnss: 0.500, and 0.700 with those of the log (log)."
            )
        );
        let better = estimated(0.9, "gnss");
        let said = localization_cost(&[("gnss", &better)], &[("log", &recorded)]).unwrap();
        assert!(said.contains("gain 0.050"), "{said}");
        let same = estimated(0.8, "gnss");
        let said = localization_cost(&[("gnss", &same)], &[("log", &recorded)]).unwrap();
        assert!(said.contains("cost nothing"), "{said}");
    }

    #[test]
    fn what_differs_in_more_is_no_reference() {
        let (map, recorded) = (estimated(0.7, "map"), run(0.8, 0.6, true));
        let mut other_link = recorded.clone();
        other_link.result.settings.link = "paper".into();
        let mut other_log = recorded.clone();
        other_log.result.logs = vec!["other".into()];
        let alone = run(0.5, 0.6, false);
        for other in [&other_link, &other_log, &alone, &estimated(0.8, "gnss")] {
            assert_eq!(localization_cost(&[("map", &map)], &[("other", other)]), None);
        }
        assert_eq!(localization_cost(&[("log", &recorded)], &[("log", &recorded)]), None);
        let mut alone_by_map = alone.clone();
        alone_by_map.result.settings.pose_source = "map".into();
        assert_eq!(localization_cost(&[("map", &alone_by_map)], &[("alone", &alone)]), None);
    }
}

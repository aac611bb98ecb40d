//! Which run of the ego alone a run is compared with.

use std::collections::BTreeSet;

use realo_report::has_recorded_detections;
use realo_results::Run;
use serde::Serialize;

/// The run of the ego alone that a run is compared with.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Against {
    /// Its place among the runs.
    pub against: Option<usize>,
    /// What no run of the ego alone has as this run has it; `None` where there is one, where this one is the ego alone, and where
    /// no run is.
    pub no_margin: Option<&'static str>,
}

/// Whether nothing of others is fused.
pub fn is_alone(run: &Run) -> bool {
    run.result.cooperation.is_none()
}

/// For each run: the run of the ego alone over the same sweeps, by the same protocol, of detections of the same source.
pub fn against(runs: &[(&str, &Run)]) -> Vec<Against> {
    runs.iter().map(|(_, run)| of(run, runs)).collect()
}

fn of(run: &Run, runs: &[(&str, &Run)]) -> Against {
    if is_alone(run) {
        return Against::default();
    }
    let alone = || runs.iter().enumerate().filter(|(_, (_, other))| is_alone(other));
    let fitting = alone().filter(|(_, (_, other))| apart(run, other).is_none());
    // Of several the one that is nearest, and of those the first.
    let nearest = fitting.max_by_key(|(at, (_, other))| (nearness(run, other), std::cmp::Reverse(*at)));
    match nearest {
        Some((at, _)) => Against {
            against: Some(at),
            no_margin: None,
        },
        None => {
            let apart = alone().filter_map(|(_, (_, other))| apart(run, other));
            let nearest = apart.max_by_key(|what| PARTS.iter().position(|known| known == what));
            Against {
                against: None,
                no_margin: nearest,
            }
        }
    }
}

/// What has to be the same, in the order in which it is looked at.
const PARTS: [&str; 6] = ["logs", "egos", "protocol", "source of detections", "sweeps", "mode"];

/// The first thing in which a run of the ego alone differs so that a margin over it would say nothing.
fn apart(run: &Run, alone: &Run) -> Option<&'static str> {
    let (own, other) = (&run.result, &alone.result);
    let names = |names: &[String]| names.iter().cloned().collect::<BTreeSet<String>>();
    // One that was ended has not come as far.
    let ended = own.ended_by.is_some() || other.ended_by.is_some();
    let same = [
        names(&own.logs) == names(&other.logs),
        names(&own.egos) == names(&other.egos),
        own.protocol == other.protocol,
        has_recorded_detections(run) == has_recorded_detections(alone),
        !ended || own.frames.key == other.frames.key,
        // Alone and without a sweep that was skipped the ego has the same boxes in every mode.
        is_same_mode(run, alone) || (own.frames.key_skipped == 0 && other.frames.key_skipped == 0),
    ];
    PARTS.iter().zip(same).find(|(_, same)| !same).map(|(part, _)| *part)
}

/// Whether what a run has more than another one says anything.
pub fn is_comparable(run: &Run, other: &Run) -> bool {
    apart(run, other).is_none() && (is_alone(other) || is_same_mode(run, other))
}

fn is_same_mode(run: &Run, alone: &Run) -> bool {
    let (own, other) = (&run.result.settings, &alone.result.settings);
    own.mode == other.mode && own.compute == other.compute
}

/// How much more than what it must have a run of the ego alone has in common with a run.
fn nearness(run: &Run, alone: &Run) -> [bool; 2] {
    let same_model = run.result.settings.model == alone.result.settings.model;
    [is_same_mode(run, alone), same_model]
}

#[cfg(test)]
mod tests {
    use realo_results::{Cooperation, NodeSummary, RunResult, Samples, Settings, Timing};

    use super::*;

    fn run(log: &str, mode: &str, fuses: bool) -> Run {
        let mut result = RunResult::new(Settings {
            mode: mode.into(),
            ..Settings::default()
        });
        result.logs = vec![log.into()];
        result.egos = vec!["cav1".into()];
        result.protocol = Some("default".into());
        result.cooperation = fuses.then(Cooperation::default);
        result.frames.key = 20;
        Run {
            result,
            timing: Timing::default(),
            samples: Samples::default(),
        }
    }

    fn of(fused: &Run, alone: &[&Run]) -> Against {
        let mut runs = vec![("fused", fused)];
        runs.extend(alone.iter().map(|run| ("none", *run)));
        against(&runs)[0].clone()
    }

    #[test]
    fn each_run_has_the_ego_alone_of_its_own_log() {
        let (a, b) = (run("a", "virtual", true), run("b", "virtual", true));
        let (alone_a, alone_b) = (run("a", "virtual", false), run("b", "virtual", false));
        let runs = [("a", &a), ("b", &b), ("alone b", &alone_b), ("alone a", &alone_a)];
        let found: Vec<Option<usize>> = against(&runs).iter().map(|one| one.against).collect();
        assert_eq!(found, [Some(3), Some(2), None, None]);
        assert_eq!(of(&a, &[&alone_b]).no_margin, Some("logs"));
        assert_eq!(of(&a, &[]), Against::default(), "nobody expects a margin then");
    }

    #[test]
    fn a_run_of_another_ego_protocol_source_or_end_is_not_compared() {
        let fused = run("a", "virtual", true);
        let alone = |change: &dyn Fn(&mut Run)| {
            let mut alone = run("a", "virtual", false);
            change(&mut alone);
            of(&fused, &[&alone]).no_margin
        };
        assert_eq!(alone(&|_| {}), None);
        assert_eq!(alone(&|run| run.result.egos = vec!["cav2".into()]), Some("egos"));
        assert_eq!(
            alone(&|run| run.result.protocol = Some("kitti".into())),
            Some("protocol")
        );
        let recorded = |run: &mut Run| {
            let stage = NodeSummary {
                operator: "recorded-detections".into(),
                ..NodeSummary::default()
            };
            run.result.nodes.insert("ego.detector".into(), stage);
        };
        assert_eq!(alone(&recorded), Some("source of detections"));
        let ended = |run: &mut Run| {
            run.result.ended_by = Some("Ctrl-C".into());
            run.result.frames.key = 7;
        };
        assert_eq!(alone(&ended), Some("sweeps"));
    }

    #[test]
    fn the_mode_matters_where_sweeps_were_skipped() {
        let fused = run("a", "realtime", true);
        let offline = run("a", "offline", false);
        assert_eq!(of(&fused, &[&offline]).against, Some(1));
        let mut busy = fused.clone();
        busy.result.frames.key_skipped = 3;
        assert_eq!(of(&busy, &[&offline]).no_margin, Some("mode"));
        let realtime = run("a", "realtime", false);
        assert_eq!(of(&fused, &[&offline, &realtime]).against, Some(2), "the nearest");
        assert_eq!(of(&busy, &[&offline, &realtime]).against, Some(2));
    }
}

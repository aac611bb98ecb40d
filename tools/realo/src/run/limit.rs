//! How many collaborators the one fusion of a graph takes, where those beyond need not be computed.

use crate::roles;
use std::ops::RangeInclusive;

use eyre::Result;
use realo_graph::{FlatGraph, FlatNode};
use realo_operator::Role;

use super::networks::Networks;
use super::nodes::{argument, decided_argument, given, registration};

/// The setting of fusions that says how many collaborators they take.
const MOST: &str = "max_collaborators";
/// The player's setting.
const FUSED_AT_MOST: &str = "fused_at_most";
/// Standard deviations of errors of poses, by which another agent may seem to be the nearest.
const NOISE: [&str; 2] = ["position_noise_m", "heading_noise_deg"];
/// Age up to which messages are taken, ms, and between what it has to be for the player to know which those are.
const WINDOW: &str = "window_ms";
const WINDOWS: RangeInclusive<f64> = 300.0..=500.0;
/// The link that loses and delays nothing.
pub const PERFECT: &str = "perfect";

/// Has the player leave out sweeps of which nothing can be fused, if the graph is such that this is certain and nobody said
/// otherwise. Whether the run is in virtual time and computing takes none, who asks has to know.
///
/// # Errors
/// A model that cannot be loaded.
pub fn leave_out_too_far(graph: &mut FlatGraph, offline: bool, networks: &mut Networks) -> Result<()> {
    let player = graph.nodes.iter().position(|node| {
        let is_source = registration(node).is_some_and(|known| known.role == Role::Source);
        is_source && has(node, FUSED_AT_MOST)
    });
    let Some(player) = player.filter(|player| given(&graph.nodes[*player], FUSED_AT_MOST).is_none()) else {
        return Ok(());
    };
    if !arrives_at_once(graph, offline) {
        return Ok(());
    }
    if let Some(limit) = limit(graph, networks)? {
        graph.nodes[player].set(FUSED_AT_MOST, &limit.to_string());
    }
    Ok(())
}

fn has(node: &FlatNode, key: &str) -> bool {
    registration(node).is_some_and(|known| known.settings.iter().any(|setting| setting.name == key))
}

/// Whether whatever is sent within range is there when it is asked for, and agents are where they say that they are.
fn arrives_at_once(graph: &FlatGraph, offline: bool) -> bool {
    graph.nodes.iter().all(|node| {
        let number = |key: &str| argument(node, key).and_then(|value| value.parse::<f64>().ok());
        let link = decided_argument(node, roles::LINK).and_then(|key| argument(node, key));
        // Of a program nobody knows what it takes and how long.
        registration(node).is_some()
            && link.is_none_or(|link| offline || link == PERFECT)
            && NOISE.iter().all(|key| !has(node, key) || number(key) == Some(0.0))
            && (!has(node, WINDOW) || number(WINDOW).is_some_and(|window| WINDOWS.contains(&window)))
    })
}

/// How many collaborators the fusion takes; `None` without a limit, or with another fusion that may take the others.
fn limit(graph: &FlatGraph, networks: &mut Networks) -> Result<Option<usize>> {
    let mut fusions = graph.nodes.iter().filter(|node| has(node, MOST));
    let (Some(fusion), None) = (fusions.next(), fusions.next()) else {
        return Ok(None);
    };
    let said = argument(fusion, MOST).and_then(|value| value.parse::<usize>().ok());
    Ok(match said {
        Some(said) => Some(said),
        None => networks.agents(fusion)?.map(|agents| agents.saturating_sub(1)),
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// Value of `fused_at_most` that the player gets in a graph that is changed so.
    fn reported(name: &str, offline: bool, changes: &[(&str, &str, &str)]) -> Option<String> {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let mut graph = FlatGraph::load(&root.join(format!("dataflows/{name}.yml"))).unwrap();
        super::super::nodes::anchor_paths(&mut graph).unwrap();
        for (node, key, value) in changes {
            graph.set(node, key, value).unwrap();
        }
        leave_out_too_far(&mut graph, offline, &mut Networks::default()).unwrap();
        given(graph.node("player").unwrap(), FUSED_AT_MOST).map(str::to_string)
    }

    #[test]
    fn sweeps_are_left_out_only_where_it_is_certain_that_nobody_takes_them() {
        let three = Some("3".to_string());
        assert_eq!(reported("attfuse", false, &[]), three, "as the model says");
        let one = [("fusion.fusion", "max_collaborators", "1")];
        assert_eq!(reported("attfuse", false, &one), Some("1".into()));
        assert_eq!(reported("late_fusion", false, &one), Some("1".into()));
        for name in [
            "late_fusion",
            "late_fusion_tracked",
            "early_fusion",
            "hybrid_fusion",
            "no_fusion",
        ] {
            assert_eq!(reported(name, false, &[]), None, "{name} takes all, or has two fusions");
        }
        let paper = ("v2x.link", "profile", "paper");
        assert_eq!(reported("attfuse", false, &[paper]), None, "messages come late");
        assert_eq!(reported("attfuse", true, &[paper]), three, "offline none does");
        let noise = ("others.sense.localization", "position_noise_m", "0.2");
        assert_eq!(
            reported("attfuse", false, &[noise]),
            None,
            "who is nearest is a matter of chance"
        );
        assert_eq!(reported("attfuse", false, &[("fusion.bank", "window_ms", "150")]), None);
        assert_eq!(
            reported("attfuse", false, &[("player", "fused_at_most", "null")]),
            Some("null".into())
        );
    }
}

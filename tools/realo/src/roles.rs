//! Roles of settings: what whoever prepares a run knows, and a graph need not say.
//!
//! A stage marks a setting by such a word (`#[setting(role = "model")]`), and nothing else ties the two.

/// The log that is played, a path.
pub const LOG: &str = "log";
/// The ego's name.
pub const EGO: &str = "ego";
/// The agent whose sensors alone are played, in a run over several machines; the graph's own names the ego.
pub const OWN: &str = "own";
/// Who cooperates.
pub const COOP: &str = "coop";
/// The agents that take part.
pub const AGENTS: &str = "agents";
/// The agents that are roadside units.
pub const ROADSIDE: &str = "roadside";
/// Whether there are no delays.
pub const OFFLINE: &str = "offline";
/// Seconds of log time per second.
pub const RATE: &str = "rate";
/// Whether sweeps have points.
pub const POINTS: &str = "points";
/// Where poses come from.
pub const LOCALIZATION: &str = "localization";
/// The map on which sweeps are looked for, a path.
pub const MAP: &str = "map";
/// Whether the log's detections are played.
pub const DETECTIONS: &str = "detections";
/// Whether what the log has precomputed is played.
pub const PRECOMPUTED: &str = "precomputed";
/// What becomes of messages whose stamps are wrong.
pub const STAMPS: &str = "stamps";
/// Channel model of a link.
pub const LINK: &str = "link";
/// Seed of what is drawn.
pub const SEED: &str = "seed";
/// How boxes are scored.
pub const PROTOCOL: &str = "protocol";
/// Model file of a network.
pub const MODEL: &str = "model";
/// Kernels of a network.
pub const ISA: &str = "isa";
/// Number type of a network.
pub const PRECISION: &str = "precision";
/// What computes a network.
pub const DEVICE: &str = "device";
/// Who brings what crosses a link to the ego's frame.
pub const PROJECT: &str = "project";
/// Folder of the results.
pub const OUT: &str = "out";
/// What the results report of the run, a file.
pub const RUN_SETTINGS: &str = "run_settings";
/// Path of the recording.
pub const RECORDING: &str = "recording";

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::registry;

    /// All of the above.
    const ALL: &[&str] = &[
        LOG,
        EGO,
        OWN,
        COOP,
        AGENTS,
        ROADSIDE,
        OFFLINE,
        RATE,
        POINTS,
        DETECTIONS,
        PRECOMPUTED,
        STAMPS,
        LOCALIZATION,
        MAP,
        LINK,
        SEED,
        PROTOCOL,
        MODEL,
        ISA,
        PRECISION,
        DEVICE,
        PROJECT,
        OUT,
        RUN_SETTINGS,
        RECORDING,
    ];

    #[test]
    fn the_roles_of_shipped_stages_are_those_that_are_known_here() {
        let settings = registry().0.iter().flat_map(|entry| entry.settings);
        let used: BTreeSet<&str> = settings.filter_map(|setting| setting.role).collect();
        assert_eq!(used, ALL.iter().copied().collect());
    }
}

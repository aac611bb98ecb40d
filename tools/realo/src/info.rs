//! `realo info`: what a log or a recording holds.

use std::path::PathBuf;

use eyre::Result;
use realo_logs::{Described, Log, truth_classes};
use realo_scoring::Protocol;

use crate::Outcome;

/// Describes a log, or a recording of a run
#[derive(clap::Args)]
pub struct Args {
    /// MCAP files
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Prints a description of each file; one that is truncated or has problems is reported and ends with 3.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut outcome = Outcome::Complete;
    for path in &args.logs {
        let described = realo_logs::describe_any(path)?;
        if args.json {
            println!("{}", serde_json::to_string_pretty(&described)?);
        } else {
            println!("{described}");
            if let Some(dropped) = dropped_classes(&described)? {
                println!("  dropped   {dropped}");
            }
        }
        if described.truncated().is_some() || described.has_problems() {
            outcome = Outcome::Partial;
        }
    }
    Ok(outcome)
}

/// Objects of the ground truth that the log's protocol leaves out, by class; `None` if there are none, or it has problems that
/// must be solved first.
fn dropped_classes(described: &Described) -> Result<Option<String>> {
    let Described::Log(log) = described else {
        return Ok(None);
    };
    let Ok(protocol) = Protocol::load(&log.info.protocol) else {
        return Ok(None);
    };
    if !log.problems.is_empty() {
        return Ok(None);
    }
    let classes = truth_classes(&Log::open(&log.path)?)?;
    let all: u64 = classes.values().sum();
    let dropped = classes.iter().filter(|(class, _)| protocol.class_of(class).is_none());
    let dropped: Vec<String> = dropped
        .map(|(class, n)| format!("`{}` {n}", class.escape_debug()))
        .collect();
    Ok((!dropped.is_empty()).then(|| {
        format!(
            "of {all} boxes of ground truth, classes that protocol `{}` does not score: {}; rename them, or choose another protocol",
            log.info.protocol,
            dropped.join(", ")
        )
    }))
}

#[cfg(test)]
mod tests {
    use realo_logs::MAX_GAP;
    use realo_sync::SyncConfig;

    #[test]
    fn info_warns_of_the_gaps_that_sync_does_not_bridge() {
        assert_eq!(MAX_GAP, i64::from(SyncConfig::default().max_gap_ms) * 1_000_000);
    }
}

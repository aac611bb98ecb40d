//! `realo info`: what a log, a recording or a bag holds.

mod bags;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use eyre::Result;
use realo_cli::Outcome;
use realo_logs::{Described, Description, Log, Stream};
use realo_player::Coop;
use realo_results::scoring::{Collector, Protocol};
use realo_results::{Run, Settings};

use crate::truth_reader::TruthReader;

/// Describes a log, a recording of a run, or a bag of ROS
///
/// Of bags it prints the topics by type, and a first draft of the map file for `realo-lab import bag`.
#[derive(clap::Args)]
pub struct Args {
    /// MCAP files; bags of ROS 1, and folders or files of bags of ROS 2
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// As JSON
    #[arg(long)]
    json: bool,
    /// Write the draft of the map file there, in place of printing it
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,
}

/// Prints a description of each file; one that is truncated or has problems is reported and ends with 3.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut outcome = Outcome::Complete;
    let (bags, logs): (Vec<_>, Vec<_>) = args.logs.iter().partition(|path| realo_bags::recognise(path).is_ok());
    if !bags.is_empty() && bags::describe(&bags, args.json, args.map.as_deref())? {
        outcome = Outcome::Partial;
    }
    for path in logs {
        let mut described = realo_logs::describe_any(path)?;
        let dropped = dropped_classes(&described);
        if let Described::Log(log) = &mut described {
            log.problems.extend(unreadable(log));
            // What is wrong with others is known already, and may keep them from being played.
            if log.problems.is_empty() && log.truncated.is_none() {
                log.problems = faults_of_runs(path)?;
            }
            let all = dropped.iter().filter(|dropped| dropped.is_all);
            log.problems.extend(all.map(|dropped| dropped.words.clone()));
        }
        if described.truncated().is_some() || described.has_problems() {
            outcome = Outcome::Partial;
        }
        match args.json {
            true => println!("{}", serde_json::to_string_pretty(&described)?),
            false => print(&described, &dropped),
        }
    }
    Ok(outcome)
}

/// One line for all agents whose sweeps cannot be read from the first on; `sweeps` of the description has why.
fn unreadable(log: &Description) -> Option<String> {
    let agents = log.sweeps.iter().filter(|(_, sweeps)| sweeps.problem.is_some());
    let agents: Vec<&String> = agents.map(|(agent, _)| agent).collect();
    let topics = agents
        .iter()
        .filter_map(|agent| log.topics.get(&Stream::Points.topic(agent)));
    let sweeps: u64 = topics.map(|topic| topic.channel.messages).sum();
    let first = log.sweeps.get(*agents.first()?)?.problem.as_ref()?;
    let names: Vec<String> = agents.iter().map(|agent| format!("`{agent}`")).collect();
    Some(match agents.len() {
        1 => format!(
            "sweeps of {} cannot be read ({sweeps} of them): {first}",
            names.concat()
        ),
        count => format!(
            "sweeps of {count} agents cannot be read ({sweeps} of {}), of the first because: {first}",
            names.join(", ")
        ),
    })
}

/// A description, with problems at its head, what a protocol drops and the verdict at its end.
fn print(described: &Described, dropped: &[Dropped]) {
    println!("{described}");
    for Dropped { words, .. } in dropped.iter().filter(|dropped| !dropped.is_all) {
        println!("  dropped   {words}");
    }
    match described.problems().len() {
        0 if described.has_problems() || described.truncated().is_some() => {}
        0 => println!("  no problems found"),
        1 => println!("  1 problem found, named at the top"),
        several => println!("  {several} problems found, named at the top"),
    }
}

/// The faults of a log that a run of it would report, for the first ego for which there are any.
fn faults_of_runs(path: &Path) -> Result<Vec<String>> {
    let log = Log::open(path)?;
    // What is wrong with its protocol is reported with the classes.
    let Ok(protocol) = Protocol::load(&log.info().protocol) else {
        return Ok(Vec::new());
    };
    for run in realo_player::plan(&log, "", Coop::All, &[])?.runs {
        let faults = played(path, &run.ego, &protocol).unwrap_or_else(|error| vec![error.to_string()]);
        if !faults.is_empty() {
            return Ok(faults);
        }
    }
    Ok(Vec::new())
}

/// The faults of a log that are found when it is played for an ego: what the player counts, and truth of which nothing is scored.
fn played(path: &Path, ego: &str, protocol: &Protocol) -> Result<Vec<String>> {
    let mut reader = TruthReader::open(path, ego, &[])?;
    let mut collector = Collector::new(protocol.clone());
    while let Some((header, truth)) = reader.next()? {
        collector.add_truth(&header, &truth)?;
    }
    let scored = Run::of_evaluation(Settings::default(), collector.finish(), []);
    let mut faults = reader.losses().1.fault_notes();
    faults.extend(scored.result.unscored());
    Ok(faults)
}

/// Boxes of a log that its protocol leaves out.
struct Dropped {
    words: String,
    /// Whether these are all boxes, so that nothing is scored.
    is_all: bool,
}

/// What the log's protocol leaves out of the ground truth and of recorded detections, by class; nothing if it scores all classes, or
/// the log has problems that must be solved first.
fn dropped_classes(described: &Described) -> Vec<Dropped> {
    let Described::Log(log) = described else {
        return Vec::new();
    };
    let protocol = match Protocol::load(&log.info.protocol) {
        Ok(protocol) => protocol,
        Err(error) => {
            return vec![Dropped {
                words: format!("{error}; correct `protocol` in the log's record, or run it with `--protocol default`"),
                is_all: true,
            }];
        }
    };
    if !log.problems.is_empty() {
        return Vec::new();
    }
    let of = |what: &str, classes: &BTreeMap<String, u64>| {
        let dropped = classes.iter().filter(|(class, _)| protocol.class_of(class).is_none());
        let dropped: Vec<String> = dropped
            .map(|(class, n)| format!("`{}` {n}", class.escape_debug()))
            .collect();
        let all: u64 = classes.values().sum();
        (!dropped.is_empty()).then(|| Dropped {
            words: format!(
                "of {all} {what}, classes that protocol `{}` does not score: {}; rename them, or choose another protocol",
                log.info.protocol,
                dropped.join(", ")
            ),
            is_all: dropped.len() == classes.len(),
        })
    };
    let truth = of("boxes of ground truth", &log.truth_classes);
    let detections = of("recorded detections", &log.detection_classes);
    truth.into_iter().chain(detections).collect()
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use realo_logs::{ChunkGroup, MAX_GAP, McapWriter, Schema, describe};
    use realo_stages::SyncSettings;

    use super::*;

    #[test]
    fn sweeps_of_all_agents_that_cannot_be_read_are_one_line_with_their_count() {
        let dir = tempfile::tempdir().unwrap();
        let said = |agents: &[&str], broken: &[&str]| {
            let path = dir.path().join(format!("{}.mcap", broken.len()));
            let names: Vec<String> = agents
                .iter()
                .map(|name| format!(r#"{{"name":"{name}","kind":"vehicle"}}"#))
                .collect();
            let entries = [
                ("format", "1".to_string()),
                ("program", "x".into()),
                ("source", "x".into()),
                ("agents", format!("[{}]", names.join(","))),
                ("map_frame", "map".into()),
                ("protocol", "default".into()),
                ("key_frames", "all".into()),
            ];
            let metadata: BTreeMap<String, String> = entries.map(|(key, value)| (key.to_string(), value)).into();
            let mut mcap = McapWriter::new(File::create(&path).unwrap(), "x", "realo", &metadata).unwrap();
            for name in broken {
                let topic = Stream::Points.topic(name);
                let channel = mcap.channel(&topic, Schema::PointCloud2, ChunkGroup::of(&Schema::PointCloud2.name()));
                for step in 0..3 {
                    let at = 1_700_000_000_000_000_000 + step * 100_000_000;
                    mcap.write(channel, at, at, |out| out.extend_from_slice(&[7, 0, 0, 0]))
                        .unwrap();
                }
            }
            mcap.finish().unwrap();
            unreadable(&describe(&path).unwrap())
        };
        assert_eq!(said(&["cav1", "rsu1"], &[]), None);
        let one = said(&["cav1", "rsu1"], &["rsu1"]).unwrap();
        assert!(
            one.starts_with("sweeps of `rsu1` cannot be read (3 of them): "),
            "{one}"
        );
        let both = said(&["cav1", "rsu1"], &["cav1", "rsu1"]).unwrap();
        let words = "sweeps of 2 agents cannot be read (6 of `cav1`, `rsu1`), of the first because: ";
        assert!(both.starts_with(words), "{both}");
    }

    #[test]
    fn info_warns_of_the_gaps_that_sync_does_not_bridge() {
        assert_eq!(MAX_GAP, i64::from(SyncSettings::default().max_gap_ms) * 1_000_000);
    }
}

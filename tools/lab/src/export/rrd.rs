//! `realo-lab export rrd`.

use std::path::{Path, PathBuf};

use eyre::{Result, bail};
use realo_cli::{Outcome, Progress};
use realo_exporter::{RrdCounts, RrdRequest, export_rrd};
use realo_logs::shell;

/// The recording in the folder of a run of one log and ego.
const RECORDING: &str = "recording.mcap";

/// rerun: native boxes, poses and points of every agent, by Python's rerun-sdk
#[derive(clap::Args)]
#[command(after_help = "Writes a recording of rerun, which `rerun FILE` opens")]
pub struct RrdArgs {
    /// The folder of a run, of one log and ego (RUN/LOG/EGO) where it has several; or a recording or a log
    run: PathBuf,
    /// The file to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The log that was played: its points are shown too
    #[arg(long, value_name = "LOG")]
    log: Option<PathBuf>,
    /// Python 3 with the package rerun-sdk
    #[arg(long, value_name = "PROGRAM", default_value = "python3")]
    python: PathBuf,
    /// Replace an earlier file
    #[arg(long)]
    force: bool,
}

/// Writes the file and says what is in it.
pub fn main(args: &RrdArgs) -> Result<Outcome> {
    realo_cli::expect_ending(&args.output, &["rrd"])?;
    let request = RrdRequest {
        recording: recording_of(&args.run)?,
        points: args.log.clone(),
        output: args.output.clone(),
        force: args.force,
        python: args.python.clone(),
    };
    let progress = Progress::new("exporting", "messages", None);
    let counts = export_rrd(&request, &mut |counts| {
        progress.set((counts.poses + counts.lists + counts.sweeps) as f64);
    });
    progress.finish();
    let RrdCounts {
        poses,
        lists,
        boxes,
        sweeps,
        unplaced,
        cut,
    } = counts?;
    println!(
        "{}: {poses} poses, {boxes} boxes in {lists} lists, {sweeps} sweeps with points; `rerun {}` opens it",
        args.output.display(),
        args.output.display()
    );
    if sweeps == 0 {
        println!("there are no points: recordings leave them out; --log LOG adds those of the log that was played");
    }
    if unplaced > 0 {
        println!("{unplaced} sweeps were left out: no transform leads from their frame to the agent's body");
    }
    if cut {
        println!(
            "the recording or the log was cut: what is missing there is missing here; `realo info` says where it ends"
        );
    }
    Ok(match unplaced > 0 || cut {
        true => Outcome::Partial,
        false => Outcome::Complete,
    })
}

/// Logs that are in the folder of a path, in words.
fn logs_near(path: &Path) -> String {
    const NAMED: usize = 5;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    let Ok(entries) = std::fs::read_dir(folder) else {
        return format!("; there is no folder `{}` either", folder.display());
    };
    let paths = entries.flatten().map(|entry| entry.path());
    let is_log = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "mcap");
    let mut logs: Vec<String> = paths
        .filter(is_log)
        .map(|path| format!("`{}`", path.display()))
        .collect();
    logs.sort();
    let more = if logs.len() > NAMED { ", …" } else { "" };
    logs.truncate(NAMED);
    match logs.is_empty() {
        true => format!("; `{}` has no logs", folder.display()),
        false => format!("; there are {}{more}", logs.join(", ")),
    }
}

/// The file that is meant by a file, or by the folder of a run.
pub fn recording_of(run: &Path) -> Result<PathBuf> {
    if run.is_file() {
        return Ok(run.into());
    }
    if !run.exists() {
        bail!(
            "{}: no such file or folder; expected a log (`.mcap`), or the folder of a run; correct the path{}",
            run.display(),
            logs_near(run)
        );
    }
    if run.join("metadata.yaml").is_file() {
        let path = run.display();
        bail!(
            "{path}: found the folder of a bag of ROS 2, expected a log or a recording: make a log of it by `realo-lab import bag {} -o my.mcap`",
            shell::word(run)
        );
    }
    let mut found = Vec::new();
    let mut folders = vec![(run.to_path_buf(), 0)];
    while let Some((folder, depth)) = folders.pop() {
        let here = folder.join(RECORDING);
        if here.is_file() {
            found.push(here);
        }
        let below = std::fs::read_dir(&folder).into_iter().flatten().flatten();
        let below = below
            .map(|entry| entry.path())
            .filter(|path| depth < 2 && path.is_dir());
        folders.extend(below.map(|path| (path, depth + 1)));
    }
    found.sort();
    match found.as_slice() {
        [only] => Ok(only.clone()),
        [] => bail!(
            "{}: expected the folder of a run with a {RECORDING}, or a recording, found neither; `realo run` makes one",
            run.display()
        ),
        several => {
            let named: Vec<String> = several
                .iter()
                .filter_map(|path| Some(path.parent()?.display().to_string()))
                .collect();
            bail!(
                "{}: several runs are there, name one of them: {}",
                run.display(),
                named.join(", ")
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_there_and_bags_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let error = |path: &Path| recording_of(path).unwrap_err().to_string();
        let said = error(&dir.path().join("nothere.mcap"));
        assert!(said.contains("nothere.mcap: no such file or folder"), "{said}");
        let said = error(dir.path());
        assert!(said.contains("expected the folder of a run"), "{said}");
        std::fs::write(dir.path().join("metadata.yaml"), "").unwrap();
        let said = error(dir.path());
        assert!(
            said.contains("a bag of ROS 2") && said.contains("realo-lab import bag"),
            "{said}"
        );
    }
}

//! Bags of ROS, and the first draft of a map file.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use eyre::{Report, Result, WrapErr, eyre};
use realo_bags::{Draft, Survey, decoded, open, survey};
use realo_logs::LogError;

/// What is said of bags of which no topic is taken for ground truth.
const WITHOUT_TRUTH: &str = "no truth: no topic looks like ground truth, so a run of the log reports rates, ages, bytes and boxes, and \
                             scores nothing; `truth: TOPIC` of an agent in the map file names one";

/// Prints what bags hold, and a draft of the map file by which they become a log; says whether something of them is missing.
pub fn describe(paths: &[&PathBuf], json: bool, map: Option<&Path>) -> Result<bool> {
    let surveyed = |path: &&PathBuf| read(path).map_err(|error| with_what_is_known(path, &error));
    let surveys: Vec<Survey> = paths.iter().map(surveyed).collect::<Result<_>>()?;
    for survey in &surveys {
        match json {
            true => println!("{}", serde_json::to_string_pretty(survey)?),
            false => println!("{survey}"),
        }
    }
    let draft = Draft::of(&surveys);
    if !json
        && draft
            .as_ref()
            .is_ok_and(|draft| draft.map.agents.values().all(|agent| agent.truth.is_none()))
    {
        println!("{WITHOUT_TRUTH}");
    }
    match (draft, map) {
        (Ok(draft), Some(file)) => {
            let written = File::create_new(file).and_then(|mut file| file.write_all(draft.to_string().as_bytes()));
            written.wrap_err_with(|| {
                format!(
                    "cannot write `{}`; remove it first, or choose another place",
                    file.display()
                )
            })?;
        }
        (Ok(draft), None) if !json => println!("\na first map file for `realo-lab import bag --map`:\n{draft}"),
        (Ok(_), None) => {}
        (Err(reason), Some(_)) => eyre::bail!("no map file was written: {reason}"),
        (Err(reason), None) => eprintln!("realo: no map file can be drafted: {reason}"),
    }
    Ok(surveys.iter().any(|survey| !survey.notes.is_empty()))
}

fn read(path: &Path) -> Result<Survey> {
    Ok(survey(decoded(open(path)?)?.as_ref())?)
}

/// Of a bag that cannot be read: beside the reason what its folder says of it.
fn with_what_is_known(path: &Path, error: &Report) -> Report {
    match realo_logs::describe_any(path) {
        // What it is and what it holds, by its folder; other errors would say the same again.
        Err(LogError::NotMcap { reason, .. }) => eyre!("{error:#}\napart from that, {reason}"),
        _ => eyre!("{error:#}"),
    }
}

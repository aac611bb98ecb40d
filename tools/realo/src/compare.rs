//! `realo compare`: finished runs side by side.

use std::path::{Path, PathBuf};

use eyre::{Result, bail};
use realo_cli::Outcome;
use realo_results::{Run, run_folder};

use crate::tables::Show;

/// Prints finished runs side by side, and what differs between them besides the strategy
#[derive(clap::Args)]
pub struct Args {
    /// Folders that `realo run` wrote, or the `result.json` in them
    #[arg(required = true)]
    runs: Vec<PathBuf>,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    show: Show,
}

/// Prints the table of the runs that can be read, and names the others.
///
/// # Errors
/// Why the first cannot be read, where none can.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut runs: Vec<(String, Run)> = Vec::new();
    let mut broken = Vec::new();
    for (name, folder) in names(&args.runs).into_iter().zip(&args.runs) {
        match realo_results::read_run(folder) {
            Ok(run) => runs.push((name, run)),
            Err(error) => broken.push(error),
        }
    }
    let all = args.runs.len();
    if runs.is_empty()
        && let Some(first) = broken.first()
    {
        broken[1..].iter().for_each(|error| eprintln!("realo: {error}"));
        bail!("{first}");
    }
    let named: Vec<(&str, &Run)> = runs.iter().map(|(name, run)| (name.as_str(), run)).collect();
    args.show.print(&named);
    if broken.is_empty() {
        return Ok(Outcome::Complete);
    }
    broken.iter().for_each(|error| eprintln!("realo: {error}"));
    eprintln!(
        "realo: the table has {} of {all} runs; run the others again, or leave them out",
        runs.len()
    );
    Ok(Outcome::Partial)
}

/// A name for each run: its folder's, with as many of the folders above as it takes to tell them apart.
pub(crate) fn names(runs: &[PathBuf]) -> Vec<String> {
    let folders: Vec<PathBuf> = runs
        .iter()
        .map(|run| {
            let folder = run_folder(run);
            // A folder that says its name keeps it, though it may be a link.
            let whole = match folder.file_name() {
                Some(_) => std::path::absolute(&folder),
                None => folder.canonicalize(),
            };
            whole.unwrap_or(folder)
        })
        .collect();
    let longest = folders.iter().map(|folder| folder.components().count()).max();
    let tails = |parts: usize| folders.iter().map(|folder| tail(folder, parts)).collect::<Vec<_>>();
    // One run may be there twice.
    let distinct = |names: &Vec<String>| {
        let mut all = names.iter().enumerate();
        all.all(|(i, name)| (0..i).all(|other| names[other] != *name || folders[other] == folders[i]))
    };
    (1..=longest.unwrap_or(1))
        .map(tails)
        .find(distinct)
        .unwrap_or_else(|| tails(1))
}

/// The last parts of a path.
fn tail(path: &Path, parts: usize) -> String {
    let all: Vec<_> = path.components().collect();
    let last: PathBuf = all[all.len().saturating_sub(parts)..].iter().collect();
    last.display().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(runs: &[&str]) -> Vec<String> {
        names(&runs.iter().map(PathBuf::from).collect::<Vec<_>>())
    }

    #[test]
    fn runs_are_named_by_their_folders() {
        assert_eq!(named(&["gone/a", "gone/b/result.json"]), ["a", "b"]);
        assert_eq!(named(&["x/gone/late", "y/gone/late"]), ["x/gone/late", "y/gone/late"]);
        assert_eq!(named(&["gone/a", "gone/a"]), ["a", "a"], "the same run twice");
        let twice = ["x/gone/late", "y/gone/late", "x/gone/late"];
        assert_eq!(named(&twice), twice, "and another one of its name");
        let here = std::env::current_dir().expect("a folder");
        let here = here.file_name().expect("its name").to_string_lossy().into_owned();
        for folder in [".", "result.json"] {
            assert_eq!(named(&[folder]), std::slice::from_ref(&here));
        }
    }
}

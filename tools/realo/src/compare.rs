//! `realo compare`: finished runs side by side.

use std::path::PathBuf;

use eyre::Result;

use crate::Outcome;

/// Prints finished runs side by side
#[derive(clap::Args)]
pub struct Args {
    /// Folders that `realo run` wrote
    #[arg(required = true)]
    dirs: Vec<PathBuf>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Prints the table of the runs.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut runs = Vec::new();
    for dir in &args.dirs {
        let name = dir
            .file_name()
            .map_or_else(|| dir.display().to_string(), |name| name.to_string_lossy().into());
        runs.push((name, realo_results::read_run(dir)?));
    }
    let named: Vec<(&str, &realo_results::Run)> = runs.iter().map(|(name, run)| (name.as_str(), run)).collect();
    if args.json {
        println!("{}", realo_report::json(&named));
    } else {
        print!("{}", realo_report::table(&named));
    }
    Ok(Outcome::Complete)
}

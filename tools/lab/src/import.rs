//! `realo-lab import`: other people's data to our logs.

use std::path::PathBuf;

use clap::Subcommand;
use eyre::Result;
use realo_cli::{Force, Outcome, Output, Progress, one_of, report_left_out, unfinished};
use realo_importer::{DairOptions, DairStep, Level, RoadsideStamp};
use realo_logs::Log;

/// Imports a data set
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    source: Source,
}

#[derive(Subcommand)]
enum Source {
    /// DAIR-V2X-C in its original layout, images missing or not
    Dair {
        /// The data set's folder `cooperative-vehicle-infrastructure`
        #[arg(value_name = "FOLDER")]
        dir: PathBuf,
        /// The log to write
        #[arg(short = 'o', long = "output")]
        output: PathBuf,
        #[allow(missing_docs, reason = "clap would print it")]
        #[command(flatten)]
        force: Force,
        /// Whether the roadside stamp is the start or the end of its sweep: the data set does not say
        #[arg(long, value_parser = one_of(RoadsideStamp::ALL), default_value = "start")]
        roadside_stamp: RoadsideStamp,
        /// By what the body frames of the agents are levelled: their recorded poses, a plane through the ground around the
        /// sensor, or not at all
        #[arg(long, value_parser = one_of(Level::ALL), default_value = "pose")]
        level: Level,
        /// Leave out pairs of which a cloud, a label, a calibration or an entry is missing or damaged, and say how many and why
        #[arg(long)]
        skip_incomplete: bool,
    },
    /// A log of realo whose body frames are not level: a copy in which they are
    Log {
        /// The log to read
        log: PathBuf,
        /// The log to write
        #[arg(short = 'o', long = "output")]
        output: PathBuf,
        #[allow(missing_docs, reason = "clap would print it")]
        #[command(flatten)]
        force: Force,
        /// By what: the recorded poses, or, where they have no roll and pitch, a plane through the ground around the sensor
        #[arg(long, value_parser = one_of(Level::ALL), default_value = "pose")]
        level: Level,
    },
}

/// Writes the log and says what was taken and what was left out.
pub fn main(args: &Args) -> Result<Outcome> {
    let mut outcome = Outcome::Complete;
    let output = match &args.source {
        Source::Dair {
            dir,
            output,
            force,
            roadside_stamp,
            level,
            skip_incomplete,
        } => {
            force.check(output, Output::Log)?;
            unfinished::end_with_signals(output);
            let options = DairOptions {
                roadside_stamp: *roadside_stamp,
                level: *level,
                skip_incomplete: *skip_incomplete,
            };
            let progress = Progress::new("checking", "pairs", Some(0.0));
            let mut at = DairStep::Checking;
            let summary = realo_importer::dair_with(dir, output, options, |step, done, all| {
                if std::mem::replace(&mut at, step) != step {
                    progress.rename("importing", "pairs");
                    progress.begin(done as f64, all as f64);
                }
                progress.of(done as f64, all as f64);
            });
            progress.finish();
            let summary = summary?;
            unfinished::done(output);
            println!("{summary}");
            output
        }
        Source::Log {
            log,
            output,
            force,
            level,
        } => {
            force.check(output, Output::Log)?;
            unfinished::end_with_signals(output);
            let progress = Progress::new("levelling", "s of the log", Some(0.0));
            let done = realo_importer::relevel_with(log, output, *level, |done, all| progress.of(done, all));
            progress.finish();
            done?;
            unfinished::done(output);
            let log = &Log::open(log)?;
            report_left_out(log);
            if let Some(cut) = log.truncation() {
                eprintln!("realo-lab: {}: {cut}", log.path().display());
                outcome = Outcome::Partial;
            }
            output
        }
    };
    println!("{}", realo_logs::describe(output)?);
    Ok(outcome)
}

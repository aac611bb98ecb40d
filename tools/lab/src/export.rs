//! `realo-lab export`: our logs in the layouts of others.

mod kind;
mod rrd;

use std::path::Path;

use clap::Subcommand;
use eyre::Result;
use realo_cli::{Outcome, Progress, report_left_out, unfinished};
use realo_exporter::{Exported, Options, check, export, export_recording};
use realo_logs::{Log, McapFile, RECORDING_RECORD, Truncation};

use self::kind::KindArgs;
use self::rrd::RrdArgs;

/// Writes a log in the layout of a data set
///
/// The folder appears when it is complete. What the layout cannot hold is listed at the end, with the command that reads it back.
#[derive(clap::Args)]
#[command(arg_required_else_help = true, args_conflicts_with_subcommands = true)]
pub struct Args {
    /// Name the layouts with what of each is written
    #[arg(long)]
    list: bool,
    #[command(subcommand)]
    layout: Option<Layout>,
}

#[derive(Subcommand)]
enum Layout {
    #[command(flatten)]
    Kind(KindArgs),
    Rrd(RrdArgs),
}

/// Writes the folder and says what was written and what was not.
pub fn main(args: &Args) -> Result<Outcome> {
    if args.list {
        println!("{}", realo_exporter::list());
        println!(
            "{:<10} rerun: poses, native boxes and points of a run or a log\n{:<10} writes one file, which `rerun` opens",
            "rrd", ""
        );
        return Ok(Outcome::Complete);
    }
    match &args.layout {
        None => Ok(Outcome::Complete),
        Some(Layout::Kind(args)) => write(args, &args.options()?),
        Some(Layout::Rrd(args)) => rrd::main(args),
    }
}

fn write(args: &KindArgs, options: &Options) -> Result<Outcome> {
    check(&args.output, args.force)?;
    let path = rrd::recording_of(&args.log)?;
    let progress = Progress::new("exporting", args.exporter.kind().unit, Some(0.0));
    let mut report = |done, all| match done {
        0 => progress.begin(0.0, all as f64),
        done => progress.set(done as f64),
    };
    let file = McapFile::open(&path)?;
    let (exported, cut) = match file.metadata().contains_key(RECORDING_RECORD) {
        true => {
            unfinished::end_with_signals(&args.output);
            let exported = export_recording(args.exporter, &file, &args.output, options, args.force, &mut report);
            (exported, file.truncation().cloned())
        }
        false => {
            let log = &Log::open(&path)?;
            report_left_out(log);
            unfinished::end_with_signals(&args.output);
            let exported = export(args.exporter, log, &args.output, options, args.force, &mut report);
            (exported, log.truncation().cloned())
        }
    };
    progress.finish();
    let exported = exported?;
    unfinished::done(&args.output);
    Ok(said(&path, &exported, cut.as_ref()))
}

fn said(path: &Path, exported: &Exported, cut: Option<&Truncation>) -> Outcome {
    if let Some(cut) = cut {
        eprintln!("realo-lab: {}: {cut}", path.display());
    }
    println!("{exported}");
    match cut {
        Some(_) => Outcome::Partial,
        None => Outcome::Complete,
    }
}

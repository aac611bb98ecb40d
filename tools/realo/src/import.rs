//! `realo import`: other people's data to our logs.

use std::path::PathBuf;

use clap::{Subcommand, ValueEnum};
use eyre::Result;

use crate::Outcome;

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
        /// Folder `cooperative-vehicle-infrastructure`
        dir: PathBuf,
        /// The log to write
        #[arg(short = 'o', long = "output")]
        output: PathBuf,
        /// Whether the roadside stamp is the start or the end of its sweep: the data set does not say
        #[arg(long, value_enum, default_value = "start")]
        roadside_stamp: Stamp,
    },
}

#[derive(Clone, Copy, ValueEnum)]
enum Stamp {
    Start,
    End,
}

/// Writes the log and says what was taken and what was left out.
pub fn main(args: &Args) -> Result<Outcome> {
    let Source::Dair {
        dir,
        output,
        roadside_stamp,
    } = &args.source;
    let stamp = match roadside_stamp {
        Stamp::Start => realo_importer::RoadsideStamp::Start,
        Stamp::End => realo_importer::RoadsideStamp::End,
    };
    let summary = realo_importer::dair(dir, output, stamp)?;
    println!("{summary}");
    println!("{}", realo_logs::describe(output)?);
    Ok(Outcome::Complete)
}

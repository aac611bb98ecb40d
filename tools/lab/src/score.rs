//! `realo-lab score`: what weights reach on the frames that trainings are validated on, to the digit.

mod card;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use eyre::Result;
use realo_cli::find::model as find_model;
use realo_cli::{Outcome, Progress};
use realo_methods::{Kernels, Model};
use realo_nn::model::Precision;
use realo_training::data::{Frames, LoggedData, left_out_once};
use realo_training::{Data, FRAMES_APART, MAX_GAP_MS, Validation, frames, score, validation_frames};

use crate::train::{print_left_out, ways};

/// Instructions in which scores of cards are computed: most machines have them, and all give the same digits.
pub const ISA: &str = "avx2";
/// And the number type.
const PRECISION: &str = "f32";
/// Begins the table.
const HEAD: &str = "| AP | IoU | ";

/// Scores weights on validation frames, as their cards do: the digits are the same on every machine
#[derive(clap::Args)]
pub struct Args {
    /// Model files, or names of shipped ones
    #[arg(required = true)]
    model: Vec<PathBuf>,
    /// Score on frames of these logs, which need ground truth [default: simulator seeds 800 to 811]
    #[arg(long)]
    log: Vec<PathBuf>,
    /// Instructions of the kernels
    #[arg(long, default_value = ISA)]
    isa: String,
    /// Number type of the kernels [default: f32; int8 of a model that is in int8]
    #[arg(long)]
    precision: Option<String>,
    /// Threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Folder of the frames; what is missing is made
    #[arg(long, default_value = "target/realo/frames")]
    cache: PathBuf,
    /// Compare with the table in the card beside each model file, NAME.md; the exit code is 1 where one differs
    #[arg(long, conflicts_with_all = ["log", "isa", "precision"])]
    check: bool,
    /// Put the table into the card beside each model file, NAME.md, in the place of the one that is there; a model without a card gets
    /// one
    #[arg(long, conflicts_with_all = ["log", "isa", "precision", "check"])]
    card: bool,
}

/// Prints a table for each model.
pub fn main(args: &Args) -> Result<Outcome> {
    let files = args.model.iter().map(|name| find_model(name));
    let mut files: Vec<PathBuf> = files.collect::<Result<_>>()?;
    let all = files.len();
    if args.check {
        // Before minutes go into scores that nothing can be compared with.
        files.retain(|file| {
            let card = card::table_of(file);
            card.inspect_err(|error| eprintln!("realo-lab: {error:#}")).is_ok()
        });
    }
    let mut differs = files.len() < all;
    if files.is_empty() {
        return Ok(Outcome::Failed);
    }
    let frames = frames_of(args)?;
    print_left_out(&left_out_once(&*frames, &*frames));
    for file in &files {
        let precision = match &args.precision {
            Some(precision) => precision.clone(),
            None => precision(&Model::read(file)?),
        };
        let progress = Progress::new(format!("scoring {}", file.display()), "", None);
        let kernels = Kernels {
            isa: &args.isa,
            precision: &precision,
            threads: args.threads.unwrap_or(0),
        };
        let score = score(file, kernels, &frames)?;
        progress.finish();
        let table = table(&score);
        if args.check {
            differs |= !card::agrees(file, &table)?;
        } else {
            println!("{}\n\n{table}\n{}", file.display(), ways(&score));
        }
        if args.card {
            println!("{}: written", card::write(file, &table)?.display());
        }
    }
    Ok(if differs { Outcome::Failed } else { Outcome::Complete })
}

/// The number type in which the scores of a model's card are computed.
pub fn precision(model: &Model) -> String {
    match model.precision {
        Precision::Int8 => Precision::Int8.to_string(),
        Precision::Bf16 | Precision::F32 => PRECISION.into(),
    }
}

/// What a card says above its table.
pub fn about(stem: &str, model: &Model) -> String {
    format!(
        "On simulator seeds 800 to 811, order `sorted`, in {} on {ISA}. `realo-lab score {stem} --check` compares every digit.",
        precision(model)
    )
}

/// The frames that are scored.
fn frames_of(args: &Args) -> Result<Arc<dyn Frames>> {
    let cache = args.cache.clone();
    Ok(match args.log.is_empty() {
        true => validation_frames(&Data::Simulated {
            cache,
            seeds: 0..1,
            per_seed: 1,
        })?,
        false => frames(&Data::Logged {
            cache,
            logged: LoggedData {
                logs: args.log.clone(),
                apart: FRAMES_APART,
                max_gap_ms: MAX_GAP_MS,
            },
        })?,
    })
}

/// As [`main`] scores, of one file.
pub fn of_card(file: &Path, frames: &Arc<dyn Frames>) -> Result<Validation> {
    let kernels = Kernels {
        isa: ISA,
        precision: &precision(&Model::read(file)?),
        threads: 0,
    };
    Ok(score(file, kernels, frames)?)
}

/// The scores of classes and ways, as a table in Markdown.
pub fn table(score: &Validation) -> String {
    let ways: Vec<&str> = score
        .classes
        .iter()
        .take(1)
        .flat_map(|class| &class.reached)
        .map(|(way, _)| *way)
        .collect();
    let mut lines = format!(
        "{HEAD}{} |\n|---|---:|{}\n",
        ways.join(" | "),
        "---:|".repeat(ways.len())
    );
    for class in &score.classes {
        let reached: Vec<String> = class.reached.iter().map(|(_, ap)| digits(*ap)).collect();
        lines += &format!("| {} | {} | {} |\n", class.name, class.iou, reached.join(" | "));
    }
    let mean = |way: usize| -> Option<f64> {
        let all: Vec<f64> = score.classes.iter().filter_map(|class| class.reached[way].1).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    };
    let means: Vec<String> = (0..ways.len()).map(|way| digits(mean(way))).collect();
    lines + &format!("| mean | | {} |\n", means.join(" | "))
}

fn digits(ap: Option<f64>) -> String {
    ap.map_or("–".into(), |ap| format!("{ap:.4}"))
}

#[cfg(test)]
mod tests {
    use realo_training::ClassScore;

    use super::*;

    #[test]
    fn a_table_has_a_row_for_each_class_and_the_mean() {
        let class = |name: &str, reached: [Option<f64>; 2]| ClassScore {
            name: name.into(),
            iou: 0.5,
            reached: vec![("alone", reached[0]), ("merged", reached[1])],
        };
        let score = Validation {
            frames: 1,
            classes: vec![
                class("vehicle", [Some(0.5), Some(0.75)]),
                class("truck", [None, Some(0.25)]),
            ],
        };
        let expected = "| AP | IoU | alone | merged |\n|---|---:|---:|---:|\n| vehicle | 0.5 | 0.5000 | 0.7500 |\n\
                        | truck | 0.5 | – | 0.2500 |\n| mean | | 0.5000 | 0.5000 |\n";
        assert_eq!(table(&score), expected);
    }
}

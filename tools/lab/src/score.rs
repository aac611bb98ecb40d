//! `realo-lab score`: what weights reach on the frames that trainings are validated on, to the digit.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use eyre::{Result, WrapErr};
use realo_cli::find::model as find_model;
use realo_cli::{Outcome, Progress};
use realo_methods::Kernels;
use realo_training::data::{Frames, LoggedData, left_out_once};
use realo_training::{Data, FRAMES_APART, MAX_GAP_MS, Validation, frames, score, validation_frames};

use crate::train::{print_left_out, ways};

/// Instructions in which scores of cards are computed: most machines have them, and all give the same digits.
pub const ISA: &str = "avx2";
/// And the number type.
pub const PRECISION: &str = "f32";

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
    /// Number type of the kernels
    #[arg(long, default_value = PRECISION)]
    precision: String,
    /// Threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Folder of the frames; what is missing is made
    #[arg(long, default_value = "target/realo/frames")]
    cache: PathBuf,
    /// Compare with the table in the card beside each model file, NAME.md; the exit code is 1 where one differs
    #[arg(long, conflicts_with_all = ["log", "isa", "precision"])]
    check: bool,
}

/// Prints a table for each model.
pub fn main(args: &Args) -> Result<Outcome> {
    let cache = args.cache.clone();
    let frames = match args.log.is_empty() {
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
    };
    print_left_out(&left_out_once(&*frames, &*frames));
    let mut differs = false;
    for name in &args.model {
        let file = find_model(name)?;
        let progress = Progress::new(format!("scoring {}", file.display()), "", None);
        let kernels = Kernels {
            isa: &args.isa,
            precision: &args.precision,
            threads: args.threads.unwrap_or(0),
        };
        let score = score(&file, kernels, &frames)?;
        progress.finish();
        let table = table(&score);
        if args.check {
            differs |= !agrees(&file, &table)?;
        } else {
            println!("{}\n\n{table}\n{}", file.display(), ways(&score));
        }
    }
    Ok(if differs { Outcome::Failed } else { Outcome::Complete })
}

/// As [`main`] scores, of one file.
pub fn of_card(file: &Path, frames: &Arc<dyn Frames>) -> Result<Validation> {
    let kernels = Kernels {
        isa: ISA,
        precision: PRECISION,
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
        "| AP | IoU | {} |\n|---|---:|{}\n",
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

/// Whether the card beside a model file holds a table.
fn agrees(file: &Path, table: &str) -> Result<bool> {
    let card = file.with_extension("md");
    let text = std::fs::read_to_string(&card).wrap_err_with(|| {
        format!(
            "{}: the card beside the model file, which a recipe writes",
            card.display()
        )
    })?;
    let agrees = text.contains(table);
    match agrees {
        true => println!("{}: the same digits", card.display()),
        false => println!("{}: expected the table of its card, found\n\n{table}", card.display()),
    }
    Ok(agrees)
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

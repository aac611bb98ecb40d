//! All stages of a recipe: says how long they take, makes them, and writes a card for each that ships.

use std::fs;
use std::path::Path;

use eyre::{Result, WrapErr, ensure};
use realo_cli::{Outcome, Progress, signals};
use realo_training::recipe::{How, Made, Planned, Recipe, RecipeNews, install, make, plan};
use realo_training::{Data, validation_frames};

use super::card::Card;
use super::{Args, Watch, ending, scores};

/// What the name of a recipe ends with.
const ENDING: &str = ".recipe.toml";

/// Whether a file is a recipe, by its name.
pub fn is_recipe(file: &Path) -> bool {
    file.to_string_lossy().ends_with(ENDING)
}

/// Makes a recipe, or says what it would take.
pub fn main(args: &Args) -> Result<Outcome> {
    refuse_options(args)?;
    let recipe = Recipe::read(&args.model)?;
    let name = args.model.file_name().unwrap_or_default().to_string_lossy();
    let name = name.trim_end_matches(ENDING);
    let how = How {
        out: args
            .out
            .clone()
            .unwrap_or_else(|| Path::new("target/realo/recipes").join(name)),
        cache: args.cache.clone(),
        minutes: args.minutes,
        checkpoint_minutes: args.checkpoint_minutes,
        threads: args.threads,
        arithmetic: args.arithmetic,
    };
    let progress = Progress::new("timing some steps of each stage", "", None);
    let planned = plan(&recipe, &how)?;
    progress.finish();
    print!("{}", table(&planned));
    if args.plan {
        return Ok(Outcome::Complete);
    }
    let made = match made(&recipe, &how)? {
        Some(made) => made,
        None => {
            let why = signals::first();
            eprintln!("realo-lab: not all stages are made yet: the same command goes on");
            return Ok(why.map_or(Outcome::Partial, |ending| Outcome::Ended(ending.number())));
        }
    };
    let cards = cards(args, &recipe, &made)?;
    if args.install {
        let folder = args.model.parent().unwrap_or(Path::new(""));
        for card in &cards {
            let files = card.files()?;
            install(card.made, &files, folder)?;
            files
                .iter()
                .for_each(|(_, name)| println!("{}", folder.join(name).display()));
        }
    }
    Ok(Outcome::Complete)
}

/// What a recipe says itself is not said on the command line.
fn refuse_options(args: &Args) -> Result<()> {
    let given = [
        ("--from", args.from.is_some()),
        ("--teacher", args.teacher.is_some()),
        ("--steps", args.steps.is_some()),
        ("--log", !args.log.is_empty()),
        ("--apart", args.apart.is_some()),
        ("--max-gap-ms", args.max_gap_ms.is_some()),
        ("--validation-log", !args.validation_log.is_empty()),
        ("--seeds", args.seeds.is_some()),
        ("--per-seed", args.per_seed.is_some()),
        ("--batch", args.batch.is_some()),
        ("--seed", args.seed.is_some()),
        ("--rate", args.rate.is_some()),
        ("--freeze", !args.freeze.is_empty()),
        ("--frozen-norms", args.frozen_norms.is_some()),
        ("--parts", args.parts.is_some()),
        ("--validate-every", args.validate_every.is_some()),
    ];
    let given: Vec<&str> = given.iter().filter(|(_, is)| *is).map(|(name, _)| *name).collect();
    ensure!(
        given.is_empty(),
        "{}: {} is for the stages of the recipe to say: edit them, or train a model file",
        args.model.display(),
        given.join(", ")
    );
    Ok(())
}

fn table(planned: &[Planned]) -> String {
    let mut lines = String::new();
    for stage in planned {
        let left = match stage.done < stage.steps {
            true => format!("{:.2} s a step here, {} left", stage.pace, hours(stage.left())),
            false => "done".into(),
        };
        lines += &format!("{}: {} of {} steps, {left}\n", stage.name, stage.done, stage.steps);
    }
    let left = planned.iter().map(Planned::left).sum::<f64>();
    if left > 0.0 {
        lines += &format!("all: {} on this machine, and validations\n", hours(left));
    }
    lines
}

/// A time in hours and minutes.
pub fn hours(seconds: f64) -> String {
    let minutes = (seconds / 60.0).ceil() as u64;
    match minutes {
        0..60 => format!("{minutes} min"),
        _ => format!("{} h {} min", minutes / 60, minutes % 60),
    }
}

fn made(recipe: &Recipe, how: &How) -> Result<Option<Vec<Made>>> {
    let mut progress: Option<Progress> = None;
    let mut watch = Watch::new("");
    let made = make(recipe, how, &mut |news| {
        match news {
            RecipeNews::There(made) => println!("{}: there already", made.stage.name),
            RecipeNews::Gone { stage, files } => {
                let (files, is) = (files.join("`, `"), if files.len() == 1 { "is" } else { "are" });
                println!("{}: `{files}` {is} gone: made again", stage.name);
            }
            RecipeNews::Begins { stage, number, of } => {
                let what = format!("stage {number} of {of}, {}", stage.name);
                progress = Some(Progress::new(format!("{what}: preparing"), "", None));
                watch = Watch::new(&what);
            }
            RecipeNews::Training(news) => {
                if let Some(progress) = &progress {
                    watch.hear(progress, news);
                }
            }
            RecipeNews::Done(made) => {
                progress = None;
                let weights: Vec<&str> = made.weights.keys().map(String::as_str).collect();
                println!("{}: {} in {}", made.stage.name, weights.join(", "), made.file.display());
            }
        }
        ending()
    })?;
    Ok(made)
}

/// The cards of all stages that ship, each in its stage's folder.
fn cards<'a>(args: &Args, recipe: &Recipe, made: &'a [Made]) -> Result<Vec<Card<'a>>> {
    let frames = validation_frames(&Data::Simulated {
        cache: args.cache.clone(),
        seeds: 0..1,
        per_seed: 1,
    })?;
    let mut cards = Vec::new();
    for one in made.iter().filter(|made| made.stage.card.is_some()) {
        let card = Card::new(recipe, made, one, &frames)?;
        let path = card.path();
        fs::write(&path, card.markdown()).wrap_err_with(|| path.display().to_string())?;
        println!("{}: {}", path.display(), scores(&card.score));
        cards.push(card);
    }
    Ok(cards)
}

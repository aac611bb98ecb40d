//! `realo-lab train`: a detector, or a network that fuses the maps of several agents, on the CPU; or all stages of a recipe.

mod card;
mod recipe;

use std::ops::{ControlFlow, Range};
use std::path::PathBuf;

use eyre::{Result, ensure, eyre};
use realo_cli::find::model as find_model;
use realo_cli::{Outcome, Progress, signals};
use realo_training::data::{LeftOut, LoggedData, PARTNER_REACH};
use realo_training::layers::Arithmetic;
use realo_training::recipe::seeds_of;
use realo_training::{
    Before, ClassScore, Comparison, Data, FRAMES_APART, MAX_GAP_MS, News, PER_SEED, Part, SEEDS, TrainOptions, Trained,
    Validation, train_with,
};

/// Trains a model on frames drawn straight from simulator seeds, or from logs with ground truth; or makes all weights of a recipe
#[derive(clap::Args)]
pub struct Args {
    /// The model file, or the name of a shipped one; or a recipe, `NAME.recipe.toml`, whose stages say all but where and how long
    #[arg(default_value = "lite")]
    model: PathBuf,
    /// Of a recipe: say how long each stage takes, and make nothing
    #[arg(long)]
    plan: bool,
    /// Of a recipe: put weights, curves and cards of finished stages beside it
    #[arg(long, conflicts_with = "plan")]
    install: bool,
    /// Begin with the weights of this model file, or shipped model; missing tensors begin at random, a missing compressor as principal components of the encoder's maps
    #[arg(long, value_name = "MODEL")]
    from: Option<PathBuf>,
    /// Have the map that the heads read be like that which this detector makes of the points of all agents together
    #[arg(long, value_name = "MODEL")]
    teacher: Option<PathBuf>,
    /// Folder of the results: checkpoint, weights, curve (CSV and SVG); of a recipe a folder for each stage
    /// [default: target/realo/training, of a recipe target/realo/recipes/NAME]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Folder of the training frames; what is missing is made
    #[arg(long, default_value = "target/realo/frames")]
    cache: PathBuf,
    /// Go on from the checkpoint in the folder of the results; a recipe always does
    #[arg(long)]
    resume: bool,
    /// Steps in all; the learning rate falls until then [default: 20000, or what fits into --minutes]
    #[arg(long)]
    steps: Option<u64>,
    /// Fit the steps into so many minutes and validate at the end; with --steps, or of a recipe: stop then, to be resumed
    #[arg(long)]
    minutes: Option<f64>,
    /// Frames of logs instead of simulator seeds
    #[arg(long, conflicts_with_all = ["seeds", "per_seed"])]
    log: Vec<PathBuf>,
    /// Seconds from one frame of a log to the next, at least [default: 1]
    #[arg(long)]
    apart: Option<f64>,
    /// Longest gap between an agent's poses in a log that is bridged, ms [default: as `max_gap_ms` of the operator `sync`]
    #[arg(long)]
    max_gap_ms: Option<u32>,
    /// Score on up to 24 frames of these logs [default: of --log, else of simulator seeds 800 to 811]
    #[arg(long)]
    validation_log: Vec<PathBuf>,
    /// Simulator seeds, first..end; 0 to 799 are for training [default: 0..800]
    #[arg(long, value_parser = seeds)]
    seeds: Option<Range<u64>>,
    /// Frames of a seed, at least a second apart [default: 3]
    #[arg(long)]
    per_seed: Option<usize>,
    /// Samples of a step [default: 2]
    #[arg(long)]
    batch: Option<usize>,
    /// Seed of all draws [default: 0]
    #[arg(long)]
    seed: Option<u64>,
    /// Max learning rate [default: 2e-3; 5e-4 for a detector that begins with --from]
    #[arg(long)]
    rate: Option<f64>,
    /// Parts of the network that stay as they are: encoder, compressor, fusion, heads
    #[arg(long, value_name = "PART", value_delimiter = ',')]
    freeze: Vec<Part>,
    /// Batch norms keep the statistics of the weights of --from, which are then the same for parts of the range and for the whole
    /// [default: true for a detector that begins with --from]
    #[arg(long, requires = "from", value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    frozen_norms: Option<bool>,
    /// Probability that a step sees parts of the range, of the first two thirds of the steps: squares turned by any angle, at two
    /// fifths of the cost [default: 0.75]
    #[arg(long)]
    parts: Option<f64>,
    /// Steps from one validation to the next
    #[arg(long)]
    validate_every: Option<u64>,
    /// Minutes from one checkpoint to the next
    #[arg(long, default_value_t = 3.0)]
    checkpoint_minutes: f64,
    /// Threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Numbers of the convolutions' products, bf16 or f32 [default: bf16 where the CPU has instructions for it]
    #[arg(long)]
    arithmetic: Option<Arithmetic>,
}

/// Mean AP that is lost in silence, for it is not shown.
const ROUNDING: f64 = 5e-4;

/// Trains and says where the results are. A signal ends the training after its step, for a later one that resumes.
pub fn main(args: &Args) -> Result<Outcome> {
    // A training ends itself after its step.
    signals::catch(|| ())?;
    if recipe::is_recipe(&args.model) {
        return recipe::main(args);
    }
    ensure!(
        !args.plan && !args.install,
        "--plan and --install are of recipes, as models/lite.recipe.toml"
    );
    let progress = Progress::new("preparing to train", "", None);
    let options = args.options()?;
    let mut watch = Watch::new("training");
    let trained = train_with(&options, |news| {
        watch.hear(&progress, news);
        ending()
    })?;
    progress.finish();
    print!("{}", summary(&trained, args.log.is_empty()));
    Ok(match (trained.complete, signals::first()) {
        (true, _) => Outcome::Complete,
        (false, Some(ending)) => {
            eprintln!("realo-lab: ended by {ending}; --resume goes on from there");
            Outcome::Ended(ending.number())
        }
        (false, None) => Outcome::Partial,
    })
}

/// Whether a signal asked for the end.
fn ending() -> ControlFlow<()> {
    match signals::first() {
        Some(_) => ControlFlow::Break(()),
        None => ControlFlow::Continue(()),
    }
}

/// Shows what a training says.
struct Watch {
    what: String,
    begun: bool,
}

impl Watch {
    fn new(what: &str) -> Self {
        Watch {
            what: what.into(),
            begun: false,
        }
    }

    fn hear(&mut self, progress: &Progress, news: &News) {
        match news {
            News::LeftOut(left_out) => progress.beside(|| print_left_out(left_out)),
            News::Before(before) => progress.beside(|| println!("{}", opening(before))),
            News::Step(far) => {
                if !std::mem::replace(&mut self.begun, true) {
                    signals::begin();
                    progress.rename(self.what.clone(), "steps");
                    progress.begin(far.point.step as f64, far.steps as f64);
                }
                show(progress, far);
            }
        }
    }
}

/// Says what of logs is not learnt from.
pub(crate) fn print_left_out(left_out: &[LeftOut]) {
    for line in left_out {
        eprintln!("realo-lab: {line}");
    }
}

/// The score that a training is compared with, before it begins.
fn opening(before: &Before) -> String {
    let whose = match before.begins {
        true => "before",
        false => "the weights beside the model file, with which this training does not begin (--from begins with them)",
    };
    format!("{whose}, on {}: {}", before.frames, scores(&before.score))
}

/// What a training came to, in lines; the last one says where it made things worse.
fn summary(trained: &Trained, simulated: bool) -> String {
    let (steps, weights) = (trained.steps, trained.weights.display());
    if !trained.complete {
        return format!(
            "{steps} of {} steps: weights so far in {weights}, not validated before the last step; add --resume to go on\n",
            trained.of_steps
        );
    }
    let mut lines = String::new();
    if let Some(Comparison { frames, before, after }) = &trained.comparison {
        lines += &format!("validation on {frames}");
        if !simulated {
            lines += "; --validation-log LOG takes another log, --apart S other times between frames";
        }
        lines += "\n";
        if let Some(before) = before {
            let whose = if before.begins {
                "before: "
            } else {
                "beside the model file: "
            };
            lines += &format!("{whose}{}\n", scores(&before.score));
        }
        lines += &format!("after:  {}\n{}\n", scores(after), ways(after));
    }
    lines += &format!("{steps} steps: weights in {weights}\n");
    let change = trained.comparison.as_ref().and_then(change);
    lines + &change.map_or(String::new(), |change| format!("{change}\n"))
}

/// Whether an AP fell, by more than rounding and so that it is seen.
fn is_worse(was: f64, is: f64) -> bool {
    is + ROUNDING < was && format!("{is:.3}") != format!("{was:.3}")
}

/// How the mean AP changed, with the classes that became worse.
fn change(comparison: &Comparison) -> Option<String> {
    let Before {
        begins, score: before, ..
    } = comparison.before.as_ref()?;
    let (Some(was), Some(is)) = (before.mean(), comparison.after.mean()) else {
        return Some("not compared: there is no object to find on these frames, or no vehicle to see it".into());
    };
    let of_class = |(before, after): (&ClassScore, &ClassScore)| {
        let (was, is) = (before.mean()?, after.mean()?);
        is_worse(was, is).then(|| format!("{} {was:.3} → {is:.3}", after.name))
    };
    let worse: Vec<String> = before
        .classes
        .iter()
        .zip(&comparison.after.classes)
        .filter_map(of_class)
        .collect();
    let worse = worse.join(", ");
    let mean = format!("mean AP {was:.3} → {is:.3}");
    let (than, remedy) = match begins {
        true => (
            "before",
            "Keep the weights of --from, or try a lower --rate, more --steps, more logs",
        ),
        false => (
            "the weights beside the model file",
            "This training began with random numbers: begin with those weights (--from), or train far longer (20000 steps)",
        ),
    };
    Some(match (is_worse(was, is), &*worse) {
        (true, "") => format!("WORSE than {than}: {mean}. {remedy}"),
        (true, _) => format!("WORSE than {than}: {mean} ({worse}). {remedy}"),
        (false, "") => format!("not worse than {than}: {mean}"),
        (false, _) => format!("{mean}, but worse: {worse}. A lower --rate, more --steps or more logs may help"),
    })
}

impl Args {
    fn options(&self) -> Result<TrainOptions> {
        let from = self.from.as_deref().map(find_model).transpose()?;
        let logged = |logs: &[PathBuf]| LoggedData {
            logs: logs.to_vec(),
            apart: self.apart.unwrap_or(FRAMES_APART),
            max_gap_ms: self.max_gap_ms.unwrap_or(MAX_GAP_MS),
        };
        let cache = self.cache.clone();
        let data = match self.log.is_empty() {
            true => Data::Simulated {
                cache,
                seeds: self.seeds.clone().unwrap_or(SEEDS),
                per_seed: self.per_seed.unwrap_or(PER_SEED),
            },
            false => Data::Logged {
                cache,
                logged: logged(&self.log),
            },
        };
        let out = self.out.clone().unwrap_or_else(|| "target/realo/training".into());
        let usual = TrainOptions::new(find_model(&self.model)?, from, out, data)?;
        let mut optimizer = usual.optimizer;
        optimizer.rate = self.rate.unwrap_or(optimizer.rate);
        Ok(TrainOptions {
            teacher: self.teacher.as_deref().map(find_model).transpose()?,
            resume: self.resume,
            steps: self.steps.unwrap_or(usual.steps),
            minutes: self.minutes,
            fit_steps: self.steps.is_none() && self.minutes.is_some(),
            seed: self.seed.unwrap_or(usual.seed),
            batch: self.batch.unwrap_or(usual.batch),
            parts: self.parts.unwrap_or(usual.parts),
            freeze: self.freeze.clone(),
            frozen_norms: self.frozen_norms.unwrap_or(usual.frozen_norms),
            checkpoint_minutes: self.checkpoint_minutes,
            validate_every: self.validate_every,
            validation: (!self.validation_log.is_empty()).then(|| logged(&self.validation_log)),
            optimizer,
            threads: self.threads,
            arithmetic: self.arithmetic,
            ..usual
        })
    }
}

/// Seeds as `first..end`.
pub(crate) fn seeds(text: &str) -> Result<Range<u64>> {
    seeds_of(text).ok_or_else(|| eyre!("expected first..end, as 0..800, found `{text}`"))
}

fn show(progress: &Progress, far: &realo_training::Progress) {
    let point = far.point;
    progress.set((point.step + 1) as f64);
    progress.say(format!(
        "loss {:.3} (scores {:.3}, boxes {:.3}), {:.2} s of a step for data",
        point.loss(),
        point.class,
        point.regression,
        far.waiting,
    ));
    for (steps, validation) in far.validations {
        let (pace, waiting) = (far.seconds_per_step, far.waiting);
        let scores = scores(validation);
        progress.beside(|| println!("step {steps}, {pace:.2} s each, {waiting:.2} of it for data: {scores}"));
    }
}

/// What the ways of a validation are.
pub(crate) fn ways(validation: &Validation) -> String {
    let meaning = |way: &str| match way {
        "alone" => Some("by the ego's points".to_string()),
        "merged" => Some(format!(
            "by the points of all agents within {PARTNER_REACH} m in one cloud"
        )),
        "by sender" => Some("fused, maps of points that senders brought to the ego's frame".into()),
        "by receiver" => Some("fused, maps that the receiver brought to its frame".into()),
        _ => None,
    };
    let all = validation.classes.first().map(|class| class.reached.iter());
    let said = all
        .into_iter()
        .flatten()
        .map(|(way, _)| meaning(way).map_or_else(|| way.to_string(), |meaning| format!("{way}: {meaning}")));
    format!("({})", said.collect::<Vec<_>>().join("; "))
}

pub(crate) fn scores(validation: &Validation) -> String {
    let percent = |ap: Option<f64>| ap.map_or("none".into(), |ap| format!("{:.3}", ap));
    let class = validation.classes.iter().map(|class| {
        let reached = class.reached.iter().map(|(way, ap)| format!("{way} {}", percent(*ap)));
        let reached = reached.collect::<Vec<_>>().join(", ");
        format!("{} AP@{} {reached}", class.name, class.iou)
    });
    class.collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use clap::Parser;

    use super::*;

    fn score(vehicle: f64, truck: f64) -> Validation {
        let class = |(name, ap): (&str, f64)| ClassScore {
            name: name.into(),
            iou: 0.5,
            reached: vec![("alone", Some(ap)), ("merged", None)],
        };
        Validation {
            frames: 4,
            classes: [("vehicle", vehicle), ("truck", truck)].map(class).into(),
        }
    }

    fn trained(before: Option<Validation>, after: Validation) -> Trained {
        Trained {
            steps: 100,
            of_steps: 100,
            complete: true,
            comparison: Some(Comparison {
                frames: "4 frames".into(),
                before: before.map(|score| Before {
                    frames: "4 frames".into(),
                    begins: true,
                    score,
                }),
                after,
            }),
            weights: PathBuf::from("lite.safetensors"),
        }
    }

    #[derive(clap::Parser)]
    struct Cli {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn good_weights_are_tuned_with_their_own_norms_and_a_lower_rate() {
        let options = |words: &[&str]| {
            let cli = Cli::try_parse_from([&["train"][..], words].concat()).unwrap();
            let options = cli.args.options().unwrap();
            (options.frozen_norms, options.optimizer.rate)
        };
        assert_eq!(options(&[]), (false, 2e-3));
        assert_eq!(options(&["lite", "--from", "lite"]), (true, 5e-4));
        let asked = ["lite", "--from", "lite", "--frozen-norms=false", "--rate", "1e-3"];
        assert_eq!(options(&asked), (false, 1e-3));
        assert_eq!(options(&["lite", "--from", "lite", "--frozen-norms"]), (true, 5e-4));
        // The fusion begins with random numbers.
        assert_eq!(options(&["lite-v2xvit", "--from", "lite"]), (false, 2e-3));
    }

    #[test]
    fn validation_logs_have_their_own_frames_beside_a_training_on_the_simulator() {
        let options = |words: &[&str]| {
            let cli = Cli::try_parse_from([&["train"][..], words].concat()).unwrap();
            cli.args.options().unwrap()
        };
        assert_eq!(options(&[]).validation, None);
        let asked = ["--validation-log", "a.mcap", "--max-gap-ms", "400", "--apart", "0.5"];
        let found = options(&asked);
        assert!(matches!(found.data, Data::Simulated { .. }));
        let expected = LoggedData {
            logs: vec!["a.mcap".into()],
            apart: 0.5,
            max_gap_ms: 400,
        };
        assert_eq!(found.validation, Some(expected));
    }

    #[test]
    fn what_became_worse_is_the_last_line() {
        let last = |before, after| {
            let said = summary(&trained(Some(before), after), false);
            assert!(said.contains("before: ") && said.contains("after:  "), "{said}");
            said.lines().last().unwrap().to_string()
        };
        let worse = last(score(0.9, 0.8), score(0.5, 0.9));
        assert!(
            worse.starts_with("WORSE than before: mean AP 0.850 → 0.700 (vehicle 0.900 → 0.500)"),
            "{worse}"
        );
        assert!(
            worse.contains("--rate") && worse.contains("--steps") && worse.contains("more logs"),
            "{worse}"
        );
        let mixed = last(score(0.2, 0.8), score(0.9, 0.7));
        assert!(
            mixed.starts_with("mean AP 0.500 → 0.800, but worse: truck 0.800 → 0.700"),
            "{mixed}"
        );
        let better = last(score(0.2, 0.7), score(0.9, 0.7));
        assert_eq!(better, "not worse than before: mean AP 0.450 → 0.800");
    }

    #[test]
    fn what_is_worse_than_the_weights_that_were_there_says_how_to_begin_with_them() {
        let mut trained = trained(Some(score(0.995, 0.995)), score(0.7, 0.77));
        let before = trained.comparison.as_mut().and_then(|found| found.before.as_mut());
        before.expect("a score").begins = false;
        let said = summary(&trained, true);
        let last = said.lines().last().unwrap();
        assert!(
            last.starts_with("WORSE than the weights beside the model file: mean AP 0.995 → 0.735")
                && last.contains("--from"),
            "{last}"
        );
        let before = trained.comparison.and_then(|found| found.before).expect("a score");
        let line = opening(&before);
        assert!(
            line.contains("on 4 frames: vehicle AP@0.5 alone 0.995") && line.contains("--from"),
            "{line}"
        );
    }

    #[test]
    fn without_a_beginning_or_an_end_nothing_is_compared() {
        let said = summary(&trained(None, score(0.9, 0.8)), true);
        assert!(
            said.ends_with("100 steps: weights in lite.safetensors\n") && !said.contains("before"),
            "{said}"
        );
        let cut = Trained {
            steps: 40,
            complete: false,
            comparison: None,
            ..trained(None, score(0.9, 0.8))
        };
        let said = summary(&cut, true);
        assert!(
            said.starts_with("40 of 100 steps") && said.contains("not validated"),
            "{said}"
        );
    }
}

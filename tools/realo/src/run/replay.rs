//! Runs in virtual time.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

use eyre::{Report, Result, WrapErr, eyre};
use rayon::prelude::*;
use realo_cli::{Progress, signals};
use realo_graph::FlatGraph;
use realo_host::{ComputeProfile, Outline, Shared, Stages, Tap, virtual_time};
use realo_operator::Books;
use realo_results::RunProgress;
use realo_schemas::{Nanos, to_seconds};

use super::Mode;
use super::batch::Unfinished;
use super::prepare::RunPlan;
use super::view::{Scene, Showing, View};
use crate::registry;

/// After a signal, runs have so long to come to their next event. A run inside a call is not waited for then, and ends with
/// this process.
const TO_NEXT_EVENT: Duration = Duration::from_millis(1000);
/// After a signal, runs that write their results have so long to end.
const TO_CONCLUDE: Duration = Duration::from_millis(2500);
/// How often a signal is looked for.
const LOOK: Duration = Duration::from_millis(50);

/// What a run says while it goes on.
enum Said {
    /// The run of this number begins.
    Begun(usize),
    /// Of the run of this number so many seconds of its log more are played.
    Played(usize, f64),
    /// The run of this number is about to write its results.
    Concluding(usize),
    /// The run of this number has ended.
    Ended(usize, Result<()>),
}

/// Runs all plans, several at a time unless calls are measured; they do not know of each other. Gives how each ended. `view` shows one at a time.
///
/// # Errors
/// A system without threads.
pub fn all(plans: &[&RunPlan], view: Option<&View>) -> Result<Vec<Result<()>>> {
    let seconds = plans.iter().map(|plan| plan.seconds).sum();
    let progress = Progress::new(format!("replaying {}", named(plans)), "s of logs", Some(seconds));
    let (sender, said) = channel();
    let replays: Result<Vec<Replay>> = plans.iter().map(|plan| Replay::of(plan, view)).collect();
    let replays = replays?;
    // Calls that are measured have the machine to themselves.
    start(replays, plans.iter().any(|plan| plan.compute.measured), sender)?;
    let mut ended: Vec<Option<Result<()>>> = plans.iter().map(|_| None).collect();
    let mut is_concluding = vec![false; plans.len()];
    let mut egos = Egos {
        plans,
        all: &progress,
        bars: BTreeMap::new(),
    };
    while ended.iter().any(Option::is_none) {
        let said = said.recv_timeout(LOOK);
        if let Ok(said) = &said {
            egos.hear(said);
        }
        match said {
            Ok(Said::Begun(_)) => {}
            Ok(Said::Played(_, seconds)) => progress.add(seconds),
            Ok(Said::Concluding(number)) => is_concluding[number] = true,
            Ok(Said::Ended(number, how)) => ended[number] = Some(how),
            Err(RecvTimeoutError::Disconnected) => break,
            Err(RecvTimeoutError::Timeout) => {}
        }
        let mut open = ended.iter().zip(&is_concluding).filter(|(ended, _)| ended.is_none());
        let patience = match open.any(|(_, is_concluding)| *is_concluding) {
            true => TO_CONCLUDE,
            false => TO_NEXT_EVENT,
        };
        if signals::came_again() || signals::since().is_some_and(|since| since > patience) {
            break;
        }
    }
    drop(egos);
    progress.finish();
    let left = |plan: &RunPlan, is_concluding: bool| -> Result<()> {
        // Partial results must not be taken for a run. A run that still writes them writes last what makes them one.
        if !is_concluding {
            realo_results::claim(&plan.out)?;
        }
        match signals::first() {
            Some(_) => Err(Unfinished::of(&plan.name).into()),
            None => Err(panicked(&plan.name)),
        }
    };
    let named = ended.into_iter().zip(is_concluding).zip(plans);
    Ok(named
        .map(|((ended, is_concluding), plan)| ended.unwrap_or_else(|| left(plan, is_concluding)))
        .collect())
}

/// Plays, one by one or several at a time, on threads of their own: who waits for what they say can leave a call that takes long.
fn start(replays: Vec<Replay>, one_by_one: bool, sender: Sender<Said>) -> Result<()> {
    let playing = std::thread::Builder::new().spawn(move || match one_by_one {
        true => (0..)
            .zip(replays)
            .for_each(|(number, replay)| replay.play(number, &sender)),
        false => replays
            .into_par_iter()
            .enumerate()
            .for_each_with(sender, |sender, (number, replay)| replay.play(number, sender)),
    });
    playing.map(drop).map_err(signals::no_thread)
}

/// A line for each ego whose run goes on, below the one of all where there are several.
struct Egos<'a> {
    plans: &'a [&'a RunPlan],
    all: &'a Progress,
    /// By number of the run.
    bars: BTreeMap<usize, Progress>,
}

impl Egos<'_> {
    fn hear(&mut self, said: &Said) {
        let is_alone = self.plans.len() == 1;
        match said {
            Said::Begun(number) if !is_alone => {
                let plan = self.plans[*number];
                let bar = self.all.below(plan.name.clone(), "s of the log", plan.seconds);
                self.bars.extend(bar.map(|bar| (*number, bar)));
            }
            Said::Played(number, seconds) => {
                let bar = self.bars.get(number);
                if let Some(bar) = bar {
                    bar.add(*seconds);
                }
                if let (Some(live), Some(bar)) = (
                    RunProgress::of(&self.plans[*number].out),
                    bar.or(is_alone.then_some(self.all)),
                ) {
                    bar.say(live.short());
                }
            }
            Said::Ended(number, _) => _ = self.bars.remove(number),
            Said::Begun(_) | Said::Concluding(_) => {}
        }
    }
}

/// A run of its own, in its folder, with calls in common with other runs.
///
/// # Errors
/// Why it failed.
pub fn one(plan: &RunPlan, shared: Option<(&Shared, &Outline)>) -> Result<()> {
    let play = || -> Result<()> {
        realo_results::claim(&plan.out)?;
        plan.write_settings()?;
        let eyes = shared.map_or(Eyes::None, |(shared, outline)| Eyes::Shared(shared, outline));
        watched(&plan.graph, &plan.compute, eyes, |_| {}).map(drop)
    };
    let ended = catch_unwind(AssertUnwindSafe(play)).unwrap_or_else(|_| Err(panicked(&plan.name)));
    if ended.is_err() {
        // Partial results must not be taken for a run; the first error is the one that matters.
        let _ = realo_results::claim(&plan.out);
    }
    ended
}

/// The outline of a run, for sharing.
///
/// # Errors
/// A graph that virtual time cannot run.
pub fn outline(plan: &RunPlan, shared: &Shared) -> Result<Outline> {
    let stages = Stages::of(&plan.graph, &registry()).map_err(|error| eyre!(error))?;
    Ok(shared.outline(&stages, &plan.compute))
}

/// The error of a run in which the code of a stage panicked.
fn panicked(name: &str) -> Report {
    eyre!("{name}: a stage panicked; its message is above")
}

/// The run, or how many of which graph.
fn named(plans: &[&RunPlan]) -> String {
    match plans {
        [one] => one.name.clone(),
        _ => {
            let graph = plans.first().and_then(|plan| plan.name.split(',').next());
            format!("{} runs of {}", plans.len(), graph.unwrap_or_default())
        }
    }
}

/// What one run needs.
struct Replay {
    name: String,
    graph: FlatGraph,
    compute: ComputeProfile,
    seconds: f64,
    scene: Option<Scene>,
}

impl Replay {
    fn of(plan: &RunPlan, view: Option<&View>) -> Result<Self> {
        Ok(Replay {
            name: plan.name.clone(),
            graph: plan.graph.clone(),
            compute: plan.compute.clone(),
            seconds: plan.seconds,
            scene: view.map(|view| view.scene(plan, Mode::Virtual)).transpose()?,
        })
    }

    /// Runs it, and says how it ended.
    fn play(self, number: usize, said: &Sender<Said>) {
        let name = self.name.clone();
        let ended = catch_unwind(AssertUnwindSafe(|| self.run(number, said)));
        let ended = ended.unwrap_or_else(|_| Err(panicked(&name)));
        // After a signal nobody may listen any more.
        let _ = said.send(Said::Ended(number, ended));
    }

    fn run(self, number: usize, said: &Sender<Said>) -> Result<()> {
        let unfinished = || Report::from(Unfinished::of(&self.name));
        if signals::first().is_some() {
            return Err(unfinished());
        }
        // After a signal nobody may listen any more.
        let _ = said.send(Said::Begun(number));
        let mut far = Far::new(number, self.seconds, said);
        let showing = self.scene.map(Scene::show).transpose()?.flatten();
        let eyes = match showing.as_ref().and_then(Showing::tap) {
            Some(tap) => Eyes::Tap(tap),
            None => Eyes::None,
        };
        let ended = watched(&self.graph, &self.compute, eyes, |progress| match progress {
            virtual_time::Progress::At(now) => far.is(now),
            virtual_time::Progress::Concludes => {
                // After a signal nobody may listen any more.
                let _ = said.send(Said::Concluding(number));
            }
        });
        far.ended();
        match ended {
            // What else fails then fails because of it.
            Err(_) if signals::first().is_some() => Err(unfinished()),
            ended => ended.map(drop).wrap_err_with(|| self.name.clone()),
        }
    }
}

/// How far one of several runs is.
struct Far<'a> {
    said: &'a Sender<Said>,
    number: usize,
    /// Length of its log.
    seconds: f64,
    begin: Option<Nanos>,
    done: f64,
}

impl<'a> Far<'a> {
    /// Seconds of a log from one report to the next.
    const STEP: f64 = 0.1;

    fn new(number: usize, seconds: f64, said: &'a Sender<Said>) -> Self {
        Far {
            said,
            number,
            seconds,
            begin: None,
            done: 0.0,
        }
    }

    fn is(&mut self, now: Nanos) {
        // Sources are asked for their first messages before all times.
        if now == Nanos::MIN {
            return;
        }
        let begin = *self.begin.get_or_insert(now);
        let done = to_seconds(now.saturating_sub(begin)).min(self.seconds);
        if done >= self.done + Self::STEP {
            self.say(done - self.done);
            self.done = done;
        }
    }

    fn ended(self) {
        self.say(self.seconds - self.done);
    }

    fn say(&self, seconds: f64) {
        // After a signal nobody may listen any more.
        let _ = self.said.send(Said::Played(self.number, seconds));
    }
}

/// Runs a graph in virtual time; `observer` sees every message that a stage sends.
///
/// # Errors
/// A graph that virtual time cannot run; the node that failed.
pub fn replay(graph: &FlatGraph, compute: &ComputeProfile, observer: Option<virtual_time::Observer>) -> Result<Books> {
    watched(graph, compute, observer.map_or(Eyes::None, Eyes::Observer), |_| {})
}

/// Who looks at a run, or shares its calls.
enum Eyes<'a> {
    None,
    Observer(virtual_time::Observer<'a>),
    Tap(&'a Tap),
    Shared(&'a Shared, &'a Outline),
}

fn watched(
    graph: &FlatGraph,
    compute: &ComputeProfile,
    eyes: Eyes,
    watch: impl FnMut(virtual_time::Progress),
) -> Result<Books> {
    let stages = Stages::of(graph, &registry()).map_err(|error| eyre!(error))?;
    if let Some(stranger) = compute.stranger(|id| graph.node(id).is_some()) {
        let known: Vec<&str> = graph.nodes.iter().map(|node| node.id.as_str()).collect();
        return Err(eyre!(
            "the compute profile names `{stranger}`, which is not a stage of {}; there are: {}",
            graph.file.display(),
            known.join(", ")
        ));
    }
    Ok(match eyes {
        Eyes::None => virtual_time::run_watched(&stages, compute, None, watch)?,
        Eyes::Observer(observer) => virtual_time::run_watched(&stages, compute, Some(observer), watch)?,
        Eyes::Tap(tap) => virtual_time::run_tapped(&stages, compute, tap, watch)?,
        Eyes::Shared(shared, outline) => virtual_time::run_shared(&stages, compute, (shared, outline), watch)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_begins_with_the_first_time_of_a_log() {
        let (sender, said) = channel();
        let mut far = Far::new(0, 3.0, &sender);
        let begin = 1_767_225_600_000_000_000;
        for now in [Nanos::MIN, begin, begin + 40_000_000, begin + 1_500_000_000] {
            far.is(now);
        }
        far.ended();
        let played: Vec<f64> = said
            .try_iter()
            .filter_map(|said| match said {
                Said::Played(0, seconds) => Some(seconds),
                _ => None,
            })
            .collect();
        assert_eq!(played, [1.5, 1.5]);
    }
}

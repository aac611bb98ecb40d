//! Runs a whole graph as a discrete-event simulation in one process.
//!
//! Every stage has one server for each agent; the order of events is total and does not depend on threads, so a run
//! gives the same bits each time. Time is the log's; computing takes what the [`ComputeProfile`] says. A plug-in runs as a
//! child process and answers one call at a time, so it changes nothing in that order.

use std::cell::RefCell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use realo_engine::{Engine, EngineError, Leaving, Servers, Step, Task, Wired};
use realo_operator::{Books, Built, Counts, Outputs, Role};
use realo_schemas::{Message, Nanos};
use rustix::time::{ClockId, clock_gettime};

use crate::shared::{Recorder, Serving, mark_of};
use crate::stages::Tapped;
use crate::{BuildError, ComputeProfile, Outline, Shared, Stages, Tap};

/// Why a run in virtual time failed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A stage could not be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// A stage could not go on.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// [`end_all`].
    #[error("ended before the end of the log")]
    Ended,
    /// A call that another run made does not fit.
    #[error(
        "node `{node}`: it was not called as in the run that it shares its calls with; this is a fault of realo: run again without \
         sharing"
    )]
    Diverged {
        /// Its id.
        node: String,
    },
    /// A stage needs the world outside.
    #[error(
        "node `{node}`: {name} exists in realtime only: run the graph with --mode realtime, or put a link in its place"
    )]
    Outside {
        /// Its id.
        node: String,
        /// What it is.
        name: &'static str,
    },
}

/// Frames that [`pace`] plays before it measures.
const UNMEASURED: usize = 2;

/// Whether runs are to end.
static ENDED: AtomicBool = AtomicBool::new(false);

/// Ends all runs of this process with their next event: they fail with [`RunError::Ended`], but where sinks already write what
/// the whole run came to. Plug-ins are not waited for any
/// longer, and are killed.
pub fn end_all() {
    ENDED.store(true, Ordering::Relaxed);
}

/// Whether [`end_all`] was called.
pub(crate) fn is_ending() -> bool {
    ENDED.load(Ordering::Relaxed)
}

/// Sees every message that a stage sends, with the stage's id and the output's name.
pub type Observer<'a> = Box<dyn FnMut(&str, &str, &Message) + 'a>;

/// What a run reports to whoever watches it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// The time of the next event, which never falls.
    At(Nanos),
    /// The first sink is about to write what the whole run came to: from now on [`end_all`] does not end the run.
    Concludes,
}

/// Runs a graph to its end and returns the books of all stages.
///
/// # Errors
/// [`RunError`] names the stage that could not be built or go on.
pub fn run(stages: &Stages, compute: &ComputeProfile, observer: Option<Observer>) -> Result<Books, RunError> {
    simulate(stages, compute, observer, None, |_| {})
}

/// As [`run`]; calls `watch` before each event, and before the results are written.
///
/// # Errors
/// As [`run`].
pub fn run_watched(
    stages: &Stages,
    compute: &ComputeProfile,
    observer: Option<Observer>,
    watch: impl FnMut(Progress),
) -> Result<Books, RunError> {
    simulate(stages, compute, observer, None, watch)
}

/// As [`run_watched`]; a tap sees what it wants.
///
/// # Errors
/// As [`run`].
pub fn run_tapped(
    stages: &Stages,
    compute: &ComputeProfile,
    tap: &Tap,
    watch: impl FnMut(Progress),
) -> Result<Books, RunError> {
    let mut stages = stages.clone();
    let tapped = stages.let_see(tap);
    let simulation = Simulation::begin(&stages, compute, None, None)?;
    play(
        Simulation {
            tap: Some((tap, &tapped)),
            ..simulation
        },
        None,
        watch,
    )
}

/// As [`run_watched`], with calls in common with other runs; gives the same to the bit. Where calls are measured none is in
/// common.
///
/// # Errors
/// As [`run`].
pub fn run_shared(
    stages: &Stages,
    compute: &ComputeProfile,
    shared: (&Shared, &Outline),
    watch: impl FnMut(Progress),
) -> Result<Books, RunError> {
    simulate(stages, compute, None, Some(shared), watch)
}

/// As [`run`], but a call takes in virtual time what it takes on this machine, on which the calls are made one by one. What
/// is sent stays the same as long as no stage is late; when it is sent is not repeatable.
///
/// # Errors
/// As [`run`].
pub fn measure(stages: &Stages, observer: Option<Observer>) -> Result<Books, RunError> {
    simulate(stages, &ComputeProfile::as_measured(), observer, None, |_| {})
}

/// What the calls of a graph took on this machine over some frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pace {
    /// Frames that were played.
    pub frames: usize,
    /// Log time that they span, ns.
    pub span: Nanos,
    /// What the calls of each stage took together, ns, by id; one call was made at a time.
    pub took: Vec<(String, Nanos)>,
    /// Time of all cores that this process took meanwhile, without plug-ins, ns.
    pub computed: Nanos,
}

/// Plays up to so many frames in virtual time, in which computing takes none, and measures what their calls take on this
/// machine. The first frames, in which many a stage prepares, are played and not measured. `is_frame` knows the message of a
/// source that begins a frame, by stage and message.
///
/// Plays fewer frames where the log has fewer. Measures no longer than `patience`, and prepares no longer than that either.
/// Returns `None` where too few frames came.
///
/// # Errors
/// As [`run`].
pub fn pace(
    stages: &Stages,
    frames: usize,
    patience: Duration,
    is_frame: impl Fn(&str, &Message) -> bool,
) -> Result<Option<Pace>, RunError> {
    let stamps: RefCell<Vec<Nanos>> = RefCell::default();
    let observer: Observer = Box::new(|stage, _, message| {
        if is_frame(stage, message) {
            stamps.borrow_mut().push(message.header.stamp);
        }
    });
    let compute = ComputeProfile::default();
    let mut simulation = Simulation::begin(stages, &compute, Some(observer), None)?;
    let started = Instant::now();
    let (mut known, mut begun, mut found) = (0, None, None);
    while let Some(now) = simulation.due()? {
        simulation.step(now, &mut |_| {})?;
        let count = stamps.borrow().len();
        let waited = started.elapsed();
        if count == known {
            // No frame comes, or none any more.
            if (count == 0 && waited > patience) || waited > 2 * patience {
                break;
            }
            continue;
        }
        known = count;
        // On a slow machine fewer frames prepare.
        if begun.is_none() && count <= UNMEASURED && waited <= patience {
            continue;
        }
        let (first, since, computed) = *begun.get_or_insert_with(|| {
            simulation.took.fill(0);
            (count - 1, Instant::now(), computed())
        });
        let played = count - first - 1;
        if played == 0 {
            continue;
        }
        let stamps = stamps.borrow();
        found = Some(Pace {
            frames: played,
            span: stamps[count - 1] - stamps[first],
            took: simulation.took_by_stage(),
            computed: self::computed() - computed,
        });
        if played >= frames || since.elapsed() > patience {
            break;
        }
    }
    Ok(found)
}

/// Time of all cores that the threads of this process have taken, ns; its child processes are not part of it.
fn computed() -> Nanos {
    let taken = clock_gettime(ClockId::ProcessCPUTime);
    taken.tv_sec * 1_000_000_000 + taken.tv_nsec
}

fn simulate(
    stages: &Stages,
    compute: &ComputeProfile,
    observer: Option<Observer>,
    shared: Option<(&Shared, &Outline)>,
    watch: impl FnMut(Progress),
) -> Result<Books, RunError> {
    match Simulation::begin(stages, compute, observer, shared) {
        Ok(simulation) => play(simulation, shared, watch),
        Err(error) => {
            if let Some((shared, outline)) = shared {
                shared.end(outline, Vec::new(), false);
            }
            Err(error)
        }
    }
}

/// Plays a run to its end.
fn play(
    mut simulation: Simulation,
    shared: Option<(&Shared, &Outline)>,
    mut watch: impl FnMut(Progress),
) -> Result<Books, RunError> {
    let mut play = || -> Result<(), RunError> {
        while let Some(now) = simulation.due()? {
            watch(Progress::At(now));
            simulation.step(now, &mut watch)?;
        }
        Ok(())
    };
    let played = play();
    if let Some((shared, outline)) = shared {
        shared.end(outline, std::mem::take(&mut simulation.serving), played.is_ok());
    }
    played.map(|()| simulation.engine.books())
}

struct Simulation<'a> {
    engine: Engine,
    /// A stage whose calls another run made is not built.
    built: Vec<Option<Built>>,
    serving: Vec<Serving>,
    shared: Option<&'a Shared>,
    compute: &'a ComputeProfile,
    observer: Option<Observer<'a>>,
    /// A tap, and the numbers of the outputs that it wants.
    tap: Option<(&'a Tap, &'a Tapped)>,
    /// Time of the last event.
    now: Nanos,
    /// What the calls of each stage took on this machine, ns.
    took: Vec<Nanos>,
    /// A sink knows that all is over: what the others write has to come as well.
    concludes: bool,
}

impl<'a> Simulation<'a> {
    /// Builds the stages, and asks sources for their first messages.
    fn begin(
        stages: &Stages,
        compute: &'a ComputeProfile,
        observer: Option<Observer<'a>>,
        shared: Option<(&'a Shared, &Outline)>,
    ) -> Result<Self, RunError> {
        let mut wiring = stages.wiring.clone();
        let is_outside =
            |(at, stage): &(usize, &Wired)| stage.registration.role == Role::Gateway || stages.is_live(*at);
        if let Some((_, stage)) = wiring.stages.iter().enumerate().find(is_outside) {
            return Err(RunError::Outside {
                node: stage.id.to_string(),
                name: stage.registration.name,
            });
        }
        if observer.is_some() {
            wiring.stages.iter_mut().for_each(|stage| stage.leaves.fill(true));
        }
        if is_ending() {
            return Err(RunError::Ended);
        }
        let serving: Vec<Serving> = match shared {
            Some((shared, outline)) => shared.begin(&wiring, outline),
            None => wiring.stages.iter().map(|_| Serving::Compute).collect(),
        };
        let computes = |stage: usize| !matches!(serving[stage], Serving::Repeat(..));
        let built = stages.build_where(computes)?;
        let mut simulation = Simulation {
            engine: Engine::new(&wiring, Servers::PerStream),
            built,
            serving,
            shared: shared.map(|(shared, _)| shared),
            compute,
            observer,
            tap: None,
            now: Nanos::MIN,
            took: vec![0; wiring.stages.len()],
            concludes: false,
        };
        for stage in 0..wiring.stages.len() {
            simulation.pull(stage, Nanos::MIN)?;
        }
        Ok(simulation)
    }

    /// The time of the next event, which never falls; `None` at the end.
    fn due(&mut self) -> Result<Option<Nanos>, RunError> {
        let Some(due) = self.engine.next_due() else {
            return Ok(None);
        };
        if is_ending() && !self.concludes {
            return Err(RunError::Ended);
        }
        self.now = self.now.max(due);
        Ok(Some(self.now))
    }

    fn took_by_stage(&self) -> Vec<(String, Nanos)> {
        let stages = self.took.iter().enumerate();
        stages
            .map(|(stage, took)| (self.engine.id(stage).to_string(), *took))
            .collect()
    }

    fn step(&mut self, now: Nanos, watch: &mut dyn FnMut(Progress)) -> Result<(), RunError> {
        match self.engine.step(now)? {
            Some(Step::Released(stage)) => self.pull(stage, now)?,
            Some(Step::Call(task)) => self.call(task, now, watch)?,
            None => {}
        }
        for line in self.engine.take_complaints() {
            eprintln!("realo: {line}");
        }
        // The sinks of this graph know it.
        let fates = self.engine.take_fates();
        if let Some((tap, _)) = self.tap {
            tap.see_fates(&fates);
        }
        for Leaving { stage, port, message } in self.engine.take_leaving() {
            if let Some((tap, tapped)) = self.tap
                && let Some(output) = tapped.get(&(stage, port))
            {
                tap.see(*output, &message);
            }
            if let Some(observer) = &mut self.observer {
                let output = self.engine.registration(stage).outputs[port.0].name;
                observer(self.engine.id(stage), output, &message);
            }
        }
        Ok(())
    }

    fn call(
        &mut self,
        Task { ticket, call, fates }: Task,
        now: Nanos,
        watch: &mut dyn FnMut(Progress),
    ) -> Result<(), RunError> {
        let registration = self.engine.registration(ticket.stage);
        if !self.concludes && ticket.is_end() && registration.role == Role::Sink {
            self.concludes = true;
            watch(Progress::Concludes);
        }
        let mark = self.shared.map_or(0, |_| mark_of(ticket.cause, ticket.start, &call));
        let begun = Instant::now();
        let called = match (&mut self.serving[ticket.stage], &mut self.built[ticket.stage]) {
            (Serving::Repeat(recording, taken), _) => {
                *taken += 1;
                recording.call(*taken - 1, mark)
            }
            (_, Some(built)) => Some(call.make(built, registration, Outputs::at(ticket.start), &fates)),
            (_, None) => None,
        };
        let Some(called) = called else {
            let node = self.engine.id(ticket.stage).to_string();
            return Err(RunError::Diverged { node });
        };
        self.record(ticket.stage, |recorder, shared, stage| {
            recorder.call(shared, stage, mark, &called)
        });
        let measured = Nanos::try_from(begun.elapsed().as_nanos()).unwrap_or(Nanos::MAX);
        self.took[ticket.stage] = self.took[ticket.stage].saturating_add(measured);
        let trigger = called.trigger(ticket.cause, registration);
        let took = match self.compute.measured {
            _ if ticket.is_end() => 0,
            true => measured,
            false => self.compute.of(self.engine.id(ticket.stage), &trigger),
        };
        let done = ticket.start + took;
        self.engine.complete(&ticket, called, done, took)?;
        self.engine.free(&ticket, done, now);
        Ok(())
    }

    /// Records for other runs, where they want it; a stage that cannot be recorded computes in them as well.
    fn record(&mut self, stage: usize, keep: impl FnOnce(&mut Recorder, &Shared, &str) -> bool) {
        let (Serving::Record(recorder), Some(shared)) = (&mut self.serving[stage], self.shared) else {
            return;
        };
        if !keep(recorder, shared, self.engine.id(stage))
            && let Serving::Record(recorder) = std::mem::replace(&mut self.serving[stage], Serving::Compute)
        {
            recorder.drop(shared);
        }
    }

    /// Schedules the next message of a source, or ends it.
    fn pull(&mut self, stage: usize, now: Nanos) -> Result<(), EngineError> {
        let (next, counts) = match (&mut self.serving[stage], &mut self.built[stage]) {
            (Serving::Repeat(recording, taken), _) if self.engine.registration(stage).role == Role::Source => {
                *taken += 1;
                (recording.released(*taken - 1), recording.counts())
            }
            (_, Some(Built::Source(source))) => {
                let next = source.next().map_err(|error| EngineError::Failed {
                    node: self.engine.id(stage).to_string(),
                    reason: error.to_string(),
                })?;
                let counts = if next.is_none() {
                    source.counts()
                } else {
                    Counts::default()
                };
                (next, counts)
            }
            _ => return Ok(()),
        };
        self.record(stage, |recorder, shared, stage| match &next {
            Some(released) => recorder.release(shared, stage, released),
            None => {
                recorder.count(counts.clone());
                true
            }
        });
        match next {
            Some((time, port, message)) => self.engine.schedule(stage, time.max(now), port, message),
            None => self.engine.close_source(stage, counts, now),
        }
        Ok(())
    }
}

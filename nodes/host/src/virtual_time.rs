//! Runs a whole graph as a discrete-event simulation in one process.
//!
//! Every stage has one server for each agent; the order of events is total and does not depend on threads, so a run
//! gives the same bits each time. Time is the log's; computing takes what the [`ComputeProfile`] says. A plug-in runs as a
//! child process and answers one call at a time, so it changes nothing in that order.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use realo_engine::{Engine, EngineError, Leaving, Servers, Step, Task};
use realo_operator::{Books, Built, Outputs, Role};
use realo_schemas::{Message, Nanos};

use crate::{BuildError, ComputeProfile, Stages};

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

/// Whether runs are to end.
static ENDED: AtomicBool = AtomicBool::new(false);

/// Ends all runs of this process with their next event: they fail with [`RunError::Ended`]. Plug-ins are not waited for any
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

/// Runs a graph to its end and returns the books of all stages.
///
/// # Errors
/// [`RunError`] names the stage that could not be built or go on.
pub fn run(stages: &Stages, compute: &ComputeProfile, observer: Option<Observer>) -> Result<Books, RunError> {
    simulate(stages, Some(compute), observer, |_| {})
}

/// As [`run`]; calls `far` with the time of each event, which never falls.
///
/// # Errors
/// As [`run`].
pub fn run_watched(
    stages: &Stages,
    compute: &ComputeProfile,
    observer: Option<Observer>,
    far: impl FnMut(Nanos),
) -> Result<Books, RunError> {
    simulate(stages, Some(compute), observer, far)
}

/// As [`run`], but a call takes in virtual time what it takes on this machine, on which the calls are made one by one. What
/// is sent stays the same as long as no stage is late; when it is sent is not repeatable.
///
/// # Errors
/// As [`run`].
pub fn measure(stages: &Stages, observer: Option<Observer>) -> Result<Books, RunError> {
    simulate(stages, None, observer, |_| {})
}

fn simulate(
    stages: &Stages,
    compute: Option<&ComputeProfile>,
    observer: Option<Observer>,
    mut far: impl FnMut(Nanos),
) -> Result<Books, RunError> {
    let mut wiring = stages.wiring.clone();
    if let Some(stage) = wiring
        .stages
        .iter()
        .find(|stage| stage.registration.role == Role::Gateway)
    {
        return Err(RunError::Outside {
            node: stage.id.to_string(),
            name: stage.registration.name,
        });
    }
    for stage in &mut wiring.stages {
        stage.leaves.fill(observer.is_some());
    }
    if is_ending() {
        return Err(RunError::Ended);
    }
    let mut simulation = Simulation {
        engine: Engine::new(&wiring, Servers::PerStream),
        built: stages.build()?,
        compute,
        observer,
    };
    for stage in 0..wiring.stages.len() {
        simulation.pull(stage, Nanos::MIN)?;
    }
    let mut now = Nanos::MIN;
    while let Some(due) = simulation.engine.next_due() {
        if is_ending() {
            return Err(RunError::Ended);
        }
        now = now.max(due);
        far(now);
        simulation.step(now)?;
    }
    Ok(simulation.engine.books())
}

struct Simulation<'a> {
    engine: Engine,
    built: Vec<Built>,
    /// `None`: as measured.
    compute: Option<&'a ComputeProfile>,
    observer: Option<Observer<'a>>,
}

impl Simulation<'_> {
    fn step(&mut self, now: Nanos) -> Result<(), EngineError> {
        match self.engine.step(now)? {
            Some(Step::Released(stage)) => self.pull(stage, now)?,
            Some(Step::Call(task)) => self.call(task, now)?,
            None => {}
        }
        for line in self.engine.take_complaints() {
            eprintln!("realo: {line}");
        }
        // The sinks of this graph have been told.
        self.engine.take_fates();
        for Leaving { stage, port, message } in self.engine.take_leaving() {
            if let Some(observer) = &mut self.observer {
                let output = self.engine.registration(stage).outputs[port.0].name;
                observer(self.engine.id(stage), output, &message);
            }
        }
        Ok(())
    }

    fn call(&mut self, Task { ticket, call, fates }: Task, now: Nanos) -> Result<(), EngineError> {
        let registration = self.engine.registration(ticket.stage);
        let begun = Instant::now();
        let called = call.make(
            &mut self.built[ticket.stage],
            registration,
            Outputs::at(ticket.start),
            &fates,
        );
        let trigger = called.trigger(ticket.cause, registration);
        let took = match self.compute {
            _ if ticket.is_end() => 0,
            Some(profile) => profile.of(self.engine.id(ticket.stage), &trigger),
            None => Nanos::try_from(begun.elapsed().as_nanos()).unwrap_or(Nanos::MAX),
        };
        let done = ticket.start + took;
        self.engine.complete(&ticket, called, done, took)?;
        self.engine.free(&ticket, done, now);
        Ok(())
    }

    /// Schedules the next message of a source, or ends it.
    fn pull(&mut self, stage: usize, now: Nanos) -> Result<(), EngineError> {
        let Built::Source(source) = &mut self.built[stage] else {
            return Ok(());
        };
        let next = source.next().map_err(|error| EngineError::Failed {
            node: self.engine.id(stage).to_string(),
            reason: error.to_string(),
        })?;
        match next {
            Some((time, port, message)) => self.engine.schedule(stage, time.max(now), port, message),
            None => self.engine.close_source(stage, source.counts(), now),
        }
        Ok(())
    }
}

//! Releases a source's messages by the wall clock.

use std::collections::BTreeSet;
use std::time::Duration;

use realo_clock::wall_now;
use realo_operator::{AnySource, Error, PortId};
use realo_schemas::{Clock, Message, Nanos};

use super::HostError;
use super::host::Shared;
use super::tether::is_ending;

/// Time in which hellos open dora's routes before the first message. dora sends the first messages of an output a
/// longer way, and on a busy machine the nodes of a graph need seconds to find each other.
const LEAD: Nanos = 3_000_000_000;
/// Between two hellos.
const HELLO: Nanos = 50_000_000;
/// How often a waiting source looks whether it is to stop.
const LOOK: Nanos = 50_000_000;

/// Runs a source to its end; what fails ends the process.
pub(super) fn run(shared: &Shared, stage: usize, source: Box<dyn AnySource>) {
    if let Err(error) = play(shared, stage, source) {
        shared.fail(error);
    }
}

fn play(shared: &Shared, stage: usize, mut source: Box<dyn AnySource>) -> Result<(), HostError> {
    let mut opened = source.is_live();
    if opened {
        open_live(shared)?;
    }
    let mut sent = BTreeSet::new();
    loop {
        let next = source.next().map_err(|error: Error| {
            let id = shared.lock().engine.id(stage).clone();
            HostError::Stage(format!("node `{id}` failed: {error}"))
        })?;
        let Some((time, port, message)) = next else { break };
        if is_ending() {
            end_live(source.as_mut());
            break;
        }
        if !opened {
            open_routes(shared)?;
            opened = true;
            if is_ending() {
                break;
            }
            let clock = source.clock(time).unwrap_or_else(|| Clock {
                wall_origin: wall_now(),
                log_origin: time,
                rate: source.rate(),
            });
            shared.lock().engine.set_clock(clock);
        }
        let clock = shared.lock().engine.clock();
        if !wait_until(shared, clock.map_or(0, |clock| clock.wall_at(time))) {
            if is_ending() {
                end_live(source.as_mut());
                break;
            }
            return Ok(());
        }
        release(shared, stage, port, message, time, sent.insert(port))?;
    }
    let mut state = shared.lock();
    let now = state.log_now();
    state.engine.close_source(stage, source.counts(), now);
    shared.follow(&mut state, now);
    shared.wake();
    Ok(())
}

/// What comes from outside does not wait for the graph.
fn open_live(shared: &Shared) -> Result<(), HostError> {
    open_routes(shared)?;
    shared.lock().engine.set_clock(Clock::live(wall_now()));
    Ok(())
}

/// Lets a source of the world outside end in order, so that it counts what it has; what it still brings comes too late.
fn end_live(source: &mut dyn AnySource) {
    if source.is_live() {
        while let Ok(Some(_)) = source.next() {}
    }
}

/// Sends a message; of a port's first one this is said, so that who reads the log knows from when on the run plays.
fn release(
    shared: &Shared,
    stage: usize,
    port: PortId,
    message: Message,
    time: Nanos,
    is_first: bool,
) -> Result<(), HostError> {
    let mut state = shared.lock();
    let now = state.log_now();
    state.engine.release(stage, port, message, time, now);
    shared.post(&mut state);
    shared.follow(&mut state, now);
    let first = is_first.then(|| {
        let output = state.engine.registration(stage).outputs[port.0].name;
        format!(
            "node `{}`: the first message of `{output}` was sent",
            state.engine.id(stage)
        )
    });
    drop(state);
    shared.send_posted()?;
    if let Some(first) = first {
        eprintln!("{first}");
    }
    Ok(())
}

fn open_routes(shared: &Shared) -> Result<(), HostError> {
    let begun = wall_now();
    for n in 0..LEAD / HELLO {
        shared.send_hello()?;
        if !wait_until(shared, begun + (n + 1) * HELLO) {
            break;
        }
    }
    Ok(())
}

/// Waits for a wall time; `false` if the process is over before, or to end.
fn wait_until(shared: &Shared, wall: Nanos) -> bool {
    loop {
        let left = wall - wall_now();
        if left <= 0 {
            return true;
        }
        if is_ending() || shared.is_over() {
            return false;
        }
        std::thread::sleep(Duration::from_nanos(left.min(LOOK) as u64));
    }
}

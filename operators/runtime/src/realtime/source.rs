use realo_schemas::{Clock, Nanos};

use crate::stage::Stage;
use crate::{AnySource, Books};

use super::inbox::{Heard, Inbox};
use super::{DoraLink, HostError, marks, wall_now};

/// Time in which hellos open dora's routes before the first message. dora sends the first messages of an output a
/// longer way, and on a busy machine the nodes of a graph need seconds to find each other.
const LEAD: Nanos = 3_000_000_000;
/// Between two hellos.
const HELLO: Nanos = 50_000_000;
/// How often a waiting source looks whether it is to stop.
const LOOK: Nanos = 50_000_000;

/// Releases a source's messages by the wall clock.
pub(super) fn run(mut source: Box<dyn AnySource>, mut link: DoraLink, mut inbox: Inbox) -> Result<(), HostError> {
    let mut stage = Stage::new(link.id.as_str().into(), link.registration);
    let mut clock: Option<Clock> = None;
    let failed = |id: &str, error: crate::Error| HostError::Stage {
        id: id.into(),
        reason: error.to_string(),
    };
    while let Some((time, port, mut message)) = source.next().map_err(|error| failed(&link.id, error))? {
        let clock = match clock {
            Some(clock) => clock,
            None => {
                open_routes(&mut link, &mut inbox)?;
                *clock.insert(Clock {
                    wall_origin: wall_now(),
                    log_origin: time,
                    rate: source.rate(),
                })
            }
        };
        wait_until(clock.wall_at(time), &link.id, &mut inbox)?;
        let now = clock.log_at(wall_now());
        stage.books.compute.record(((now - time) as f64 / clock.rate) as Nanos);
        message.header.clock = Some(clock);
        // A source that could not keep up says so: what it releases late is ready late.
        message.header.ready = message.header.ready.max(now);
        let done = now.max(time);
        stage.stamp(port, &mut message, time, done, done);
        link.send(port, &message)?;
    }
    stage.books.counters = source.counters();
    let mut books = Books::default();
    books.nodes.insert(link.id.clone(), stage.books.clone());
    marks::send_end(&mut link, &stage.hops, &books, clock)
}

fn open_routes(link: &mut DoraLink, inbox: &mut Inbox) -> Result<(), HostError> {
    let begun = wall_now();
    for n in 0..LEAD / HELLO {
        marks::send_hello(link)?;
        wait_until(begun + (n + 1) * HELLO, &link.id, inbox)?;
    }
    Ok(())
}

fn wait_until(wall: Nanos, id: &str, inbox: &mut Inbox) -> Result<(), HostError> {
    loop {
        let now = wall_now();
        match inbox.wait(wall.min(now + LOOK)) {
            Some(Heard::Stopped) => return Err(HostError::Stopped { id: id.into() }),
            Some(Heard::Trouble(trouble)) => eprintln!("realo: {id}: dora: {trouble}"),
            Some(_) => {}
            None if wall_now() >= wall => return Ok(()),
            None => {}
        }
    }
}

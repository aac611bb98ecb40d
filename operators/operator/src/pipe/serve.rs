//! The program's side.

use std::io::{Read, Write};

use super::memory::Memory;
use super::words::{Call, Reply, Reported};
use super::{FrameError, frame, hello};
use crate::{AnyOperator, Built, KnownMap, Outputs, PortId, Registration};

/// Answers a driver's calls to an operator until the driver closes the pipe or has called the end.
///
/// `maps`: what is known of the BEV maps of its ports. `shares`: whether the host reads shared memory, and this program too.
///
/// # Errors
/// A pipe that fails, a call that is none, an input that the operator does not have.
pub fn serve(
    registration: &'static Registration,
    built: Built,
    maps: &[(&str, KnownMap)],
    mut calls: impl Read,
    mut replies: impl Write,
    shares: bool,
) -> Result<(), String> {
    let Built::Operator(mut operator) = built else {
        return Err(format!(
            "`{}` is no operator: pipes drive operators only",
            registration.name
        ));
    };
    let pipe = |error: FrameError| error.to_string();
    let memory = Memory::default();
    frame::write_first(&mut replies, &hello::write(registration, maps, shares)?).map_err(pipe)?;
    while let Some(bytes) = frame::read(&mut calls, &memory).map_err(pipe)? {
        let (call, now) = Call::from_bytes(bytes)?;
        let ends = call == Call::End;
        let reply = answer(registration, operator.as_mut(), call, now)?;
        frame::write(&mut replies, &reply.to_parts()?, &memory, shares).map_err(pipe)?;
        if ends {
            // The driver closes the pipe once it has read the last reply.
            frame::read(&mut calls, &memory).map_err(pipe)?;
            break;
        }
    }
    Ok(())
}

fn answer(
    registration: &'static Registration,
    operator: &mut dyn AnyOperator,
    call: Call,
    now: i64,
) -> Result<Reply, String> {
    let mut out = Outputs::at(now);
    let done = match call {
        Call::Input { port, message } => {
            let (id, _) = registration
                .input(&port)
                .ok_or_else(|| format!("a call for input `{port}`, which `{}` does not have", registration.name))?;
            operator.on_input(id, *message, &mut out)
        }
        Call::Wake => operator.on_wake(now, &mut out),
        Call::End => operator.on_end(&mut out),
    };
    let error = done.err().map(|error| match error.to_string() {
        empty if empty.is_empty() => "an error without words".into(),
        error => error,
    });
    let name = |PortId(port)| match registration.outputs.get(port) {
        Some(port) => Ok(port.name.to_string()),
        None => Err(format!(
            "`{}` sent on output number {port}, which it does not have",
            registration.name
        )),
    };
    let made = out.into_made();
    let sent = made.sent.into_iter().map(|(port, message)| Ok((name(port)?, message)));
    Ok(Reply {
        error,
        sent: sent.collect::<Result<_, String>>()?,
        wakes: made.wakes.into_iter().collect(),
        counts: made
            .counts
            .counters
            .into_iter()
            .map(|(name, n)| (name.into_owned(), n))
            .collect(),
        reported: Reported {
            fates: made.fates,
            traffic: made.traffic,
            losses: made
                .counts
                .losses
                .into_iter()
                .map(|(name, loss)| (name.into_owned(), loss))
                .collect(),
            explained: made.explained,
        },
    })
}

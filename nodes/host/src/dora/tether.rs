//! What ties a process to the `realo run` that had dora start it.
//!
//! `realo run` holds the writing end of a pipe that all its processes inherit to read from. A byte in it asks sources to end
//! their streams, so that the run ends in good order. Once nobody can write any more, `realo run` is gone, however it
//! died, and so are its processes, with all plug-ins that they started; a second byte says the same.

use std::fs::{self, File, OpenOptions};
use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::ioctl_fionread;
use rustix::process::{Signal, getpgrp, getpid, kill_current_process_group};

/// Names the pipe: its number, and what the system says of it.
pub const TETHER_VARIABLE: &str = "REALO_TETHER";

/// How often a process that is to end looks for the second byte.
const AGAIN: Timespec = Timespec {
    tv_sec: 0,
    tv_nsec: 100_000_000,
};

/// Whether sources are to end their streams.
static ENDING: AtomicBool = AtomicBool::new(false);

/// Whether `realo run` has asked for the run's end.
pub(crate) fn is_ending() -> bool {
    ENDING.load(Ordering::Relaxed)
}

/// What [`TETHER_VARIABLE`] says of a pipe that a process inherits under a number.
pub fn tether_of(number: i32) -> std::io::Result<String> {
    let link = fs::read_link(format!("/proc/self/fd/{number}"))?;
    Ok(format!("{number} {}", link.display()))
}

/// Follows the pipe, if this process was given one.
pub(super) fn follow() {
    let Some(pipe) = std::env::var(TETHER_VARIABLE).ok().and_then(|said| inherited(&said)) else {
        return;
    };
    // Where no thread can be had, `realo run` ends the process itself.
    let _ = std::thread::Builder::new()
        .name("realo-tether".into())
        .spawn(move || watch(&pipe));
}

/// The pipe, unless its number is something else here.
fn inherited(said: &str) -> Option<File> {
    let number = said.split(' ').next()?.parse::<i32>().ok()?;
    if tether_of(number).ok()? != said {
        return None;
    }
    let path = PathBuf::from(format!("/proc/self/fd/{number}"));
    let not_blocking = rustix::fs::OFlags::NONBLOCK.bits() as i32;
    OpenOptions::new().read(true).custom_flags(not_blocking).open(path).ok()
}

fn watch(pipe: &File) {
    let (mut wanted, mut patience) = (PollFlags::IN, None);
    loop {
        let mut polled = [PollFd::new(pipe, wanted)];
        match poll(&mut polled, patience.as_ref()) {
            Ok(_) => {}
            Err(rustix::io::Errno::INTR) => continue,
            Err(_) => return,
        }
        let seen = polled[0].revents();
        if seen.contains(PollFlags::IN) {
            ENDING.store(true, Ordering::Relaxed);
            // The byte stays for the other processes.
            (wanted, patience) = (PollFlags::empty(), Some(AGAIN));
        }
        if ioctl_fionread(pipe).is_ok_and(|bytes| bytes > 1) {
            end_all();
        }
        if seen.intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL) {
            end_all();
        }
    }
}

/// Ends this process, and its plug-ins where dora made it the leader of a group.
fn end_all() -> ! {
    if getpgrp() == getpid() {
        let _ = kill_current_process_group(Signal::KILL);
    }
    std::process::exit(1);
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd;

    use super::*;

    #[test]
    fn a_pipe_is_known_by_more_than_its_number() {
        let (reader, writer) = std::io::pipe().unwrap();
        let said = tether_of(reader.as_raw_fd()).unwrap();
        assert!(inherited(&said).is_some());
        assert!(inherited(&format!("{} pipe:[1]", reader.as_raw_fd())).is_none());
        assert!(inherited("junk").is_none() && tether_of(-1).is_err());
        drop(writer);
    }
}

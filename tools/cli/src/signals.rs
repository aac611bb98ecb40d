//! Signals that end a command.

use std::fmt;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::time::{Duration, Instant};

use eyre::{Report, Result, WrapErr, eyre};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use crate::program;
use crate::unfinished;

/// What helps where no thread can be had.
pub const MORE_PROCESSES: &str = "raise the limit of processes and threads (`ulimit -u`; a service: TasksMax=; docker: \
                                  --pids-limit), or end other programs of this user";

/// The first signal; 0: none yet.
static FIRST: AtomicI32 = AtomicI32::new(0);
/// Whether another one came.
static AGAIN: AtomicBool = AtomicBool::new(false);
/// Whether what a signal ends can end in good order.
static BEGUN: AtomicBool = AtomicBool::new(false);
/// When the first one came.
static CAME: OnceLock<Instant> = OnceLock::new();
/// After the second signal, the program ends in so long, whatever it does.
const AT_LAST: Duration = Duration::from_secs(2);

/// The signal that ends a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ending(i32);

impl Ending {
    /// The signal of a number.
    pub fn of(signal: i32) -> Self {
        Ending(signal)
    }

    /// Its number.
    pub fn number(self) -> u8 {
        u8::try_from(self.0).unwrap_or(0)
    }
}

impl fmt::Display for Ending {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self.0 {
            SIGINT => "Ctrl-C",
            SIGHUP => "SIGHUP",
            _ => "SIGTERM",
        })
    }
}

/// From now on a signal ends the program with an exit code of its own, and, after [`begin`], in good order: `end_all` ends
/// what goes on.
///
/// # Errors
/// A system that refuses.
pub fn catch(end_all: fn()) -> Result<()> {
    let mut signals = wanted()?;
    let caught = std::thread::Builder::new().spawn(move || {
        for signal in signals.forever() {
            match FIRST.compare_exchange(0, signal, Ordering::Relaxed, Ordering::Relaxed) {
                Ok(_) => end(signal, end_all),
                Err(first) => {
                    AGAIN.store(true, Ordering::Relaxed);
                    std::thread::sleep(AT_LAST);
                    std::process::exit(128 + first);
                }
            }
        }
    });
    caught.map(drop).map_err(no_thread)
}

/// The signals that end a command.
///
/// # Errors
/// A system that refuses.
pub fn wanted() -> Result<Signals> {
    let mut wanted = vec![SIGINT, SIGTERM];
    // `nohup` has it ignored: the run goes on when its terminal closes.
    if !is_ignored(SIGHUP) {
        wanted.push(SIGHUP);
    }
    Signals::new(wanted).wrap_err("cannot catch signals")
}

/// A system that has no thread left.
pub fn no_thread(error: std::io::Error) -> Report {
    eyre!("no thread can be started ({error}): {}", MORE_PROCESSES)
}

/// Ends what goes on. Plug-ins end with this process in any case.
fn end(signal: i32, end_all: fn()) {
    let _ = CAME.set(Instant::now());
    if !BEGUN.load(Ordering::SeqCst) {
        // The demo log may be on its way.
        unfinished::remove();
        eprintln!(
            "{}: ended by {} before anything was run",
            program::name(),
            Ending(signal)
        );
        std::process::exit(128 + signal);
    }
    end_all();
}

/// From now on there are folders to put in order.
pub fn begin() {
    BEGUN.store(true, Ordering::SeqCst);
}

/// The signal that ends the run, if one came.
pub fn first() -> Option<Ending> {
    let first = FIRST.load(Ordering::Relaxed);
    (first != 0).then_some(Ending(first))
}

/// How long ago the signal that ends the run came.
pub fn since() -> Option<Duration> {
    CAME.get().map(Instant::elapsed)
}

/// Whether somebody will not wait any longer.
pub fn came_again() -> bool {
    AGAIN.load(Ordering::Relaxed)
}

fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask & (1 << (signal - 1)) != 0)
}

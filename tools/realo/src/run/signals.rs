//! Signals that end a run.

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::time::Duration;

use eyre::{Result, WrapErr};
use realo_host::virtual_time;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

/// The first signal; 0: none yet.
static FIRST: AtomicI32 = AtomicI32::new(0);
/// Whether another one came.
static AGAIN: AtomicBool = AtomicBool::new(false);
/// Whether what a signal ends can end in good order.
static BEGUN: AtomicBool = AtomicBool::new(false);
/// Whether runs in virtual time go on.
static IN_VIRTUAL: AtomicBool = AtomicBool::new(false);
/// After the second signal, the program ends in so long, whatever it does.
const AT_LAST: Duration = Duration::from_secs(2);
/// After the first signal, a run in virtual time has so long to come to its next event.
const TO_NEXT_EVENT: Duration = Duration::from_millis(2500);

/// The signal that ends a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ending(i32);

impl Ending {
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

/// From now on a signal ends the program with an exit code of its own, and, after [`begin`], in good order.
///
/// # Errors
/// A system that refuses.
pub fn catch() -> Result<()> {
    let mut wanted = vec![SIGINT, SIGTERM];
    // `nohup` has it ignored: the run goes on when its terminal closes.
    if !is_ignored(SIGHUP) {
        wanted.push(SIGHUP);
    }
    let mut signals = Signals::new(wanted).wrap_err("cannot catch signals")?;
    std::thread::spawn(move || {
        for signal in signals.forever() {
            match FIRST.compare_exchange(0, signal, Ordering::Relaxed, Ordering::Relaxed) {
                Ok(_) => end(signal),
                Err(first) => {
                    AGAIN.store(true, Ordering::Relaxed);
                    std::thread::sleep(AT_LAST);
                    std::process::exit(128 + first);
                }
            }
        }
    });
    Ok(())
}

/// Ends what goes on. Plug-ins end with this process in any case.
fn end(signal: i32) {
    if !BEGUN.load(Ordering::SeqCst) {
        eprintln!("realo: ended by {} before anything was run", Ending(signal));
        std::process::exit(128 + signal);
    }
    virtual_time::end_all();
    std::thread::spawn(move || {
        std::thread::sleep(TO_NEXT_EVENT);
        if IN_VIRTUAL.load(Ordering::SeqCst) {
            eprintln!(
                "realo: ended by {} in the middle of a call: no results of this run; the next run there puts earlier ones back",
                Ending(signal)
            );
            std::process::exit(128 + signal);
        }
    });
}

/// From now on there are folders to put in order.
pub fn begin() {
    BEGUN.store(true, Ordering::SeqCst);
}

/// Calculates in virtual time; a signal does not wait for a call that takes long.
pub fn in_virtual<T>(calculate: impl FnOnce() -> T) -> T {
    IN_VIRTUAL.store(true, Ordering::SeqCst);
    let calculated = calculate();
    IN_VIRTUAL.store(false, Ordering::SeqCst);
    calculated
}

/// The signal that ends the run, if one came.
pub fn first() -> Option<Ending> {
    let first = FIRST.load(Ordering::Relaxed);
    (first != 0).then_some(Ending(first))
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

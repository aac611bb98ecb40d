//! What other programs take of the machine while a test runs, so that a busy machine is not taken for a fault.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Above this share of all cores that other programs take, timing decides nothing.
const BUSY: f64 = 0.15;
/// Time between two looks at all processes.
const LOOK: Duration = Duration::from_millis(250);
/// Ticks of `/proc` a second, the same on every Linux.
const TICKS: f64 = 100.0;

/// What runs in real time take of the machine at once, in quarters of it.
static TAKEN: Mutex<usize> = Mutex::new(0);
static FREED: Condvar = Condvar::new();
const QUARTERS: usize = 4;

/// A part of the machine, until it is dropped: tests that hold one together have enough of two cores.
pub struct Share {
    quarters: usize,
}

/// For runs that mostly wait: links, clocks, recorded detections.
pub fn quarter() -> Share {
    take(1)
}

/// For runs that compute now and then, or whose messages must not come late.
pub fn half() -> Share {
    take(2)
}

/// For runs that compute in real time, beside one that mostly waits.
pub fn three_quarters() -> Share {
    take(3)
}

/// For runs that measure what the machine does: beside nothing of ours.
pub fn whole() -> Share {
    take(QUARTERS)
}

fn take(quarters: usize) -> Share {
    let full = |taken: &mut usize| *taken + quarters > QUARTERS;
    let taken = FREED.wait_while(locked(), full);
    *taken.unwrap_or_else(|poisoned| poisoned.into_inner()) += quarters;
    Share { quarters }
}

fn locked() -> MutexGuard<'static, usize> {
    TAKEN.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

impl Drop for Share {
    fn drop(&mut self) {
        *locked() -= self.quarters;
        FREED.notify_all();
    }
}

/// Runs a test that needs the machine's time. Where it fails while other programs take much of the machine, nothing is
/// decided, and it says so; otherwise its failure is one.
pub fn decided(test: impl FnOnce()) {
    let meter = Meter::start();
    let Err(panic) = catch_unwind(AssertUnwindSafe(test)) else {
        return;
    };
    let others = meter.others();
    if others <= BUSY {
        resume_unwind(panic);
    }
    let words = panic.downcast_ref::<String>().map(String::as_str);
    let words = words
        .or_else(|| panic.downcast_ref::<&str>().copied())
        .unwrap_or("it failed");
    let words = words.lines().next().unwrap_or_default();
    skipped::undecided(&format!(
        "the machine was too busy, other programs took {:.0} % of it: {words}",
        100.0 * others
    ));
}

/// Watches the machine from its start on.
struct Meter {
    stop: Arc<AtomicBool>,
    watch: Option<JoinHandle<f64>>,
}

impl Meter {
    /// Begins to watch.
    fn start() -> Meter {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let watch = std::thread::spawn(move || watch(&stopped));
        Meter {
            stop,
            watch: Some(watch),
        }
    }

    /// The share of all cores that programs other than this one and its children took, 0 to 1.
    fn others(mut self) -> f64 {
        self.stop.store(true, Ordering::Relaxed);
        let watch = self.watch.take().expect("it is taken once");
        watch.join().expect("the watch only reads")
    }
}

impl Drop for Meter {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

fn watch(stop: &AtomicBool) -> f64 {
    let me = std::process::id();
    let cores = std::thread::available_parallelism().map_or(1, usize::from) as f64;
    let (mut last, mut ours) = (processes(), BTreeSet::from([me]));
    let (mut ticks, mut stolen, begun) = (0, steal(), Instant::now());
    while !stop.load(Ordering::Relaxed) {
        std::thread::sleep(LOOK);
        let now = processes();
        // Who was ours stays ours, whoever adopts it later.
        while let Some(more) = now
            .iter()
            .find(|(pid, process)| !ours.contains(pid) && ours.contains(&process.parent))
        {
            ours.insert(*more.0);
        }
        for (pid, process) in now.iter().filter(|(pid, _)| !ours.contains(pid)) {
            let before = last.get(pid).map_or(0, |process| process.ticks);
            ticks += process.ticks.saturating_sub(before);
        }
        last = now;
    }
    stolen = steal().saturating_sub(stolen);
    (ticks + stolen) as f64 / TICKS / cores / begun.elapsed().as_secs_f64()
}

struct Process {
    parent: u32,
    ticks: u64,
}

/// All processes, with the time that each has had.
fn processes() -> BTreeMap<u32, Process> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let known = entries.filter_map(|entry| {
        let pid: u32 = entry.file_name().to_str()?.parse().ok()?;
        let stat = fs::read_to_string(entry.path().join("stat")).ok()?;
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        let number = |at: usize| fields.get(at)?.parse::<u64>().ok();
        let process = Process {
            parent: number(1)? as u32,
            ticks: number(11)? + number(12)?,
        };
        Some((pid, process))
    });
    known.collect()
}

/// Ticks that the host of this virtual machine gave to others.
fn steal() -> u64 {
    let stat = fs::read_to_string("/proc/stat").unwrap_or_default();
    let all = stat.lines().next().unwrap_or_default();
    all.split_whitespace()
        .nth(8)
        .and_then(|ticks| ticks.parse().ok())
        .unwrap_or(0)
}

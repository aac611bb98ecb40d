//! Runs items on several threads.

use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::mpsc::channel;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// An item that is to run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Task {
    /// Its number in the plan.
    pub item: usize,
    /// Tasks before it in the list, by their places, that have to end first, because it shares what they computed.
    pub after: BTreeSet<usize>,
}

/// How a task ended.
#[derive(Debug)]
pub struct Ended<E> {
    /// Its place in the list.
    pub task: usize,
    /// How long it took.
    pub took: Duration,
    /// Why it failed, if it did.
    pub result: Result<(), E>,
}

struct State {
    waiting: BTreeSet<usize>,
    ended: BTreeSet<usize>,
}

/// Runs all tasks, up to `jobs` at a time, each as early in the list as what it waits for allows. One that fails does not keep
/// the others from running. No task starts once `stop` says so. `ended` hears of each in the order in which they end.
pub fn execute<E: Send>(
    tasks: &[Task],
    jobs: usize,
    stop: impl Fn() -> bool + Sync,
    work: impl Fn(&Task) -> Result<(), E> + Sync,
    mut ended: impl FnMut(Ended<E>),
) {
    let state = Mutex::new(State {
        waiting: (0..tasks.len()).collect(),
        ended: BTreeSet::new(),
    });
    let changed = Condvar::new();
    // The sets are whole whenever the lock is free.
    let open = || state.lock().unwrap_or_else(PoisonError::into_inner);
    let next = || {
        let mut state = open();
        loop {
            if stop() || state.waiting.is_empty() {
                return None;
            }
            let is_ready = |task: &&usize| tasks[**task].after.iter().all(|before| state.ended.contains(before));
            if let Some(task) = state.waiting.iter().find(is_ready).copied() {
                state.waiting.remove(&task);
                return Some(task);
            }
            state = changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    };
    let (sender, said) = channel();
    std::thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, tasks.len().max(1)) {
            let (sender, next, open, work, changed) = (sender.clone(), &next, &open, &work, &changed);
            scope.spawn(move || {
                while let Some(task) = next() {
                    let begun = Instant::now();
                    // A panic must not leave others waiting for this task.
                    let result = catch_unwind(AssertUnwindSafe(|| work(&tasks[task])));
                    open().ended.insert(task);
                    changed.notify_all();
                    let result = result.unwrap_or_else(|panic| resume_unwind(panic));
                    let took = begun.elapsed();
                    // Whoever listens does so until the last thread ends.
                    let _ = sender.send(Ended { task, took, result });
                }
                changed.notify_all();
            });
        }
        drop(sender);
        said.iter().for_each(&mut ended);
    });
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    fn tasks(after: &[&[usize]]) -> Vec<Task> {
        let task = |(item, after): (usize, &&[usize])| Task {
            item,
            after: after.iter().copied().collect(),
        };
        after.iter().enumerate().map(task).collect()
    }

    #[test]
    fn a_task_waits_for_what_it_shares_and_failures_keep_nobody() {
        let tasks = tasks(&[&[], &[0], &[0], &[1, 2], &[]]);
        for jobs in [1, 2, 8] {
            let order = Mutex::new(Vec::new());
            let mut failed = Vec::new();
            let work = |task: &Task| {
                order.lock().unwrap().push(task.item);
                if task.item == 1 { Err("full") } else { Ok(()) }
            };
            let ended = |ended: Ended<&'static str>| failed.extend(ended.result.err().map(|error| (ended.task, error)));
            execute(&tasks, jobs, || false, work, ended);
            let order = order.into_inner().unwrap();
            let at = |item: usize| order.iter().position(|other| *other == item).unwrap();
            assert_eq!((order.len(), failed), (5, vec![(1, "full")]), "{jobs} jobs");
            assert!(
                at(0) < at(1) && at(0) < at(2) && at(1) < at(3) && at(2) < at(3),
                "{order:?}"
            );
        }
    }

    #[test]
    fn nothing_starts_after_a_stop() {
        let tasks = tasks(&[&[], &[], &[]]);
        let ran = AtomicUsize::new(0);
        let work = |_: &Task| -> Result<(), ()> {
            ran.fetch_add(1, Ordering::Relaxed);
            Ok(())
        };
        let mut heard = 0;
        execute(&tasks, 1, || ran.load(Ordering::Relaxed) == 2, work, |_| heard += 1);
        assert_eq!((ran.into_inner(), heard), (2, 2));
    }
}

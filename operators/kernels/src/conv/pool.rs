//! Threads that compute the shares of a layer.
#![allow(unsafe_code)]

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::aligned::Aligned;

/// How long a thread looks for work, or for the others' end, before it sleeps: layers follow each other within
/// microseconds, but other processes share the cores.
const PATIENCE: Duration = Duration::from_micros(20);

/// The calling thread and `threads - 1` more that live as long as the pool.
pub struct Pool {
    shared: Arc<Shared>,
    workers: Vec<JoinHandle<()>>,
    /// Each thread's, kept from call to call.
    rooms: Vec<Aligned<f32>>,
}

type Work = &'static (dyn Fn(usize) + Sync);

struct Shared {
    state: Mutex<State>,
    begin: Condvar,
    end: Condvar,
    /// Copies of the state's numbers, to look at without the lock.
    round: AtomicUsize,
    pending: AtomicUsize,
}

struct State {
    /// Counts calls.
    round: usize,
    work: Option<Work>,
    /// Workers that have not finished the round.
    pending: usize,
    panic: Option<Box<dyn Any + Send>>,
    stop: bool,
}

impl Pool {
    /// At least one thread, the caller's.
    pub fn new(threads: usize) -> Self {
        let shared = Arc::new(Shared {
            state: Mutex::new(State {
                round: 0,
                work: None,
                pending: 0,
                panic: None,
                stop: false,
            }),
            begin: Condvar::new(),
            end: Condvar::new(),
            round: AtomicUsize::new(0),
            pending: AtomicUsize::new(0),
        });
        let worker = |index: usize| {
            let shared = Arc::clone(&shared);
            std::thread::spawn(move || shared.serve(index))
        };
        let workers = (1..threads.max(1)).map(worker).collect();
        Pool {
            shared,
            workers,
            rooms: Vec::new(),
        }
    }

    pub fn threads(&self) -> usize {
        self.workers.len() + 1
    }

    /// Gives each thread one item; returns when all are done.
    ///
    /// # Panics
    /// If there are more items than threads, or as `work` does.
    pub fn each<T: Send>(&mut self, items: Vec<T>, work: impl Fn(T) + Sync) {
        assert!(items.len() <= self.threads(), "an item for each thread at most");
        let items: Vec<Mutex<Option<T>>> = items.into_iter().map(|item| Mutex::new(Some(item))).collect();
        self.run(&|index| {
            let item = items
                .get(index)
                .and_then(|item| item.lock().unwrap_or_else(PoisonError::into_inner).take());
            if let Some(item) = item {
                work(item);
            }
        });
    }

    /// As [`Pool::each`], with so many numbers for each thread's own use; they hold anything.
    pub fn each_in_room<T: Send>(&mut self, items: Vec<T>, numbers: usize, work: impl Fn(T, &mut [f32]) + Sync) {
        let mut rooms = std::mem::take(&mut self.rooms);
        rooms.resize_with(self.threads(), || Aligned::zeros(0));
        for room in rooms.iter_mut().filter(|room| room.len() < numbers) {
            *room = Aligned::zeros(numbers);
        }
        let items = items.into_iter().zip(rooms.iter_mut());
        self.each(items.collect(), |(item, room): (T, &mut Aligned<f32>)| {
            work(item, &mut room[..numbers])
        });
        self.rooms = rooms;
    }

    fn run(&mut self, work: &(dyn Fn(usize) + Sync)) {
        if self.workers.is_empty() {
            return work(0);
        }
        // SAFETY: workers use the reference only between `open` and the end of `wait`, and this function neither returns
        // nor unwinds in between: the caller's own share is run under `catch_unwind`.
        let lasting = unsafe { std::mem::transmute::<&(dyn Fn(usize) + Sync), Work>(work) };
        self.shared.open(lasting, self.workers.len());
        let own = catch_unwind(AssertUnwindSafe(|| work(0)));
        let theirs = self.shared.wait();
        if let Some(panic) = own.err().or(theirs) {
            resume_unwind(panic);
        }
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.shared.lock().stop = true;
        self.shared.round.fetch_add(1, Ordering::Release);
        self.shared.begin.notify_all();
        for worker in self.workers.drain(..) {
            // A worker catches the panics of its work and has none of its own.
            let _ = worker.join();
        }
    }
}

impl Shared {
    /// A panic elsewhere leaves no state half changed.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn open(&self, work: Work, workers: usize) {
        let mut state = self.lock();
        state.work = Some(work);
        state.pending = workers;
        state.round += 1;
        self.pending.store(workers, Ordering::Release);
        self.round.store(state.round, Ordering::Release);
        drop(state);
        self.begin.notify_all();
    }

    fn wait(&self) -> Option<Box<dyn Any + Send>> {
        look(|| self.pending.load(Ordering::Acquire) == 0);
        let mut state = self.lock();
        while state.pending > 0 {
            state = self.end.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.work = None;
        state.panic.take()
    }

    fn serve(&self, index: usize) {
        let mut seen = 0;
        loop {
            look(|| self.round.load(Ordering::Acquire) != seen);
            let mut state = self.lock();
            while state.round == seen && !state.stop {
                state = self.begin.wait(state).unwrap_or_else(PoisonError::into_inner);
            }
            if state.stop {
                return;
            }
            seen = state.round;
            let work = state.work;
            drop(state);
            let outcome = catch_unwind(AssertUnwindSafe(|| work.iter().for_each(|work| work(index))));
            let mut state = self.lock();
            state.panic = state.panic.take().or(outcome.err());
            state.pending -= 1;
            self.pending.store(state.pending, Ordering::Release);
            if state.pending == 0 {
                self.end.notify_one();
            }
        }
    }
}

/// Looks for a moment whether something has happened.
fn look(happened: impl Fn() -> bool) {
    let start = Instant::now();
    while !happened() && start.elapsed() < PATIENCE {
        std::hint::spin_loop();
    }
}

/// Locks what workers share. A panic elsewhere leaves no state half changed.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_thread_gets_its_item_in_every_round() {
        for threads in [0, 1, 2, 5] {
            let mut pool = Pool::new(threads);
            let mut sums = vec![0usize; pool.threads()];
            for round in 0..200 {
                let items: Vec<&mut usize> = sums.iter_mut().collect();
                pool.each(items, |sum| *sum += round);
            }
            assert_eq!(sums, vec![199 * 100; threads.max(1)]);
            pool.each(vec![&mut sums[0]], |sum| *sum = 1);
            assert_eq!(sums[0], 1);
        }
    }

    #[test]
    fn every_thread_has_a_room_of_its_own_that_grows() {
        let mut pool = Pool::new(3);
        for numbers in [5, 2, 9] {
            let mut sums = [0.0f32; 3];
            let items = sums.iter_mut().zip([1.0f32, 2.0, 3.0]).collect();
            pool.each_in_room(items, numbers, |(sum, value): (&mut f32, f32), room| {
                room.fill(value);
                *sum = room.iter().sum();
            });
            assert_eq!(sums, [1.0, 2.0, 3.0].map(|value| value * numbers as f32));
        }
    }

    #[test]
    fn sleeping_workers_wake() {
        let mut pool = Pool::new(3);
        for _ in 0..5 {
            std::thread::sleep(10 * PATIENCE);
            let count = AtomicUsize::new(0);
            pool.each(vec![1, 2, 3], |value| {
                count.fetch_add(value, Ordering::Relaxed);
            });
            assert_eq!(count.into_inner(), 6);
        }
    }

    #[test]
    fn a_panic_reaches_the_caller_after_all_have_ended() {
        let mut pool = Pool::new(3);
        for bad in 0..3 {
            let ended = AtomicUsize::new(0);
            let outcome = catch_unwind(AssertUnwindSafe(|| {
                pool.each(vec![0, 1, 2], |item| {
                    if item == bad {
                        panic!("item {item}");
                    }
                    ended.fetch_add(1, Ordering::Relaxed);
                });
            }));
            let message = outcome.unwrap_err();
            assert_eq!(message.downcast_ref::<String>().unwrap(), &format!("item {bad}"));
            assert_eq!(ended.into_inner(), 2);
        }
        pool.each(vec![(), (), ()], |()| ());
    }
}

//! Messages on their way out, in the order in which they were numbered.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard};

/// A queue of messages in the order of their numbers, and the sender that takes them out.
///
/// Threads number messages under one lock and send them after it, so that nobody waits for dora. Without the outbox one
/// thread could overtake another in between, and receivers would hold dora to account for it.
#[derive(Debug)]
pub(super) struct Outbox<T, S> {
    queue: Mutex<VecDeque<T>>,
    sender: Mutex<S>,
}

impl<T, S> Outbox<T, S> {
    pub fn new(sender: S) -> Self {
        Outbox {
            queue: Mutex::default(),
            sender: Mutex::new(sender),
        }
    }

    /// Puts things in; to be called under the lock that numbers them.
    pub fn post(&self, things: impl IntoIterator<Item = T>) {
        self.queue().extend(things);
    }

    /// Sends what is there, whoever posted it. Afterwards everything that this thread had posted has left, or another thread has failed
    /// to send it.
    ///
    /// # Errors
    /// The first error of `send`.
    pub fn send_all<E>(&self, mut send: impl FnMut(&mut S, T) -> Result<(), E>) -> Result<(), E> {
        let mut sender = self.sender();
        while let Some(thing) = self.take() {
            send(&mut sender, thing)?;
        }
        Ok(())
    }

    /// The sender, once nobody else sends.
    pub fn sender(&self) -> MutexGuard<'_, S> {
        self.sender.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    fn take(&self) -> Option<T> {
        self.queue().pop_front()
    }

    fn queue(&self) -> MutexGuard<'_, VecDeque<T>> {
        self.queue.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_send_in_the_order_of_the_numbers_and_nothing_stays_behind() {
        let (outbox, numbers) = (Outbox::new(Vec::new()), Mutex::new(0u32));
        let work = |n: u32| {
            for _ in 0..200 {
                let mut number = numbers.lock().unwrap();
                let mine = [*number, *number + 1];
                *number += 2;
                outbox.post(mine);
                drop(number);
                if n.is_multiple_of(2) {
                    std::thread::yield_now();
                }
                outbox
                    .send_all(|sent, number| {
                        sent.push(number);
                        Ok::<(), ()>(())
                    })
                    .unwrap();
                assert!(mine.iter().all(|number| outbox.sender().contains(number)));
            }
        };
        std::thread::scope(|scope| {
            for n in 0..4 {
                scope.spawn(move || work(n));
            }
        });
        assert_eq!(*outbox.sender(), (0..1600).collect::<Vec<_>>());
    }

    #[test]
    fn who_fails_to_send_leaves_the_rest() {
        let outbox = Outbox::new(());
        outbox.post([1, 2, 3]);
        let failed = outbox.send_all(|(), n| if n == 2 { Err(n) } else { Ok(()) });
        assert_eq!((failed, outbox.take()), (Err(2), Some(3)));
    }
}

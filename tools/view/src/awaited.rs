//! What threads change and clients wait for.

use std::sync::{Condvar, Mutex, MutexGuard};
use std::time::Duration;

/// A state of which clients hear when it changes.
#[derive(Default)]
pub struct Awaited<S> {
    state: Mutex<S>,
    changed: Condvar,
}

impl<S> Awaited<S> {
    /// The state, for this thread alone. Whoever changes it calls [`Awaited::wake`].
    pub fn lock(&self) -> MutexGuard<'_, S> {
        self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// Lets clients look again.
    pub fn wake(&self) {
        self.changed.notify_all();
    }

    /// What a client gets of the state. Where that is nothing yet, it looks once more when the state has changed, or after so long.
    pub fn next<N>(&self, patience: Duration, is_nothing: impl Fn(&N) -> bool, mut get: impl FnMut(&S) -> N) -> N {
        let state = self.lock();
        let found = get(&state);
        if !is_nothing(&found) {
            return found;
        }
        let waited = self.changed.wait_timeout(state, patience);
        get(&waited.unwrap_or_else(|poisoned| poisoned.into_inner()).0)
    }
}

//! Waiting for the end of a program that has to tidy up.
#![allow(unsafe_code)]

/// Signals that end a program, kept back until they are waited for.
pub struct Interrupts(libc::sigset_t);

impl Interrupts {
    /// Keeps SIGINT and SIGTERM back, in this thread and in those that it starts from now on.
    pub fn hold() -> Interrupts {
        // SAFETY: the set is filled by the first call; the pointers lead to it, and to nothing where that is allowed.
        unsafe {
            let mut set = std::mem::zeroed();
            libc::sigemptyset(&mut set);
            libc::sigaddset(&mut set, libc::SIGINT);
            libc::sigaddset(&mut set, libc::SIGTERM);
            libc::pthread_sigmask(libc::SIG_BLOCK, &set, std::ptr::null_mut());
            Interrupts(set)
        }
    }

    /// Waits for one of them.
    pub fn wait(&self) {
        let mut signal = 0;
        // SAFETY: both pointers lead to what they say.
        unsafe { libc::sigwait(&self.0, &mut signal) };
    }
}

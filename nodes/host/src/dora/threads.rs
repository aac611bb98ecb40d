//! Threads of a process that is in touch with other machines.

use realo_operator::Role;

use crate::Stages;

/// Threads of each of Zenoh's runtimes, of which it has one or two for all sessions of a process. Zenoh closes a connection whose
/// peer is gone by a call that blocks for up to 10 s (`SO_LINGER`), and dora's messages would wait, and be lost, behind it: so
/// many connections may close at a time.
const WORKERS: usize = 16;
/// Where Zenoh looks for them.
const VARIABLE: &str = "ZENOH_RUNTIME";

/// Lets a gateway's connections close without dora waiting for it.
pub(super) fn let_connections_close(stages: &Stages) {
    let mut all = stages.wiring.stages.iter();
    if all.any(|stage| stage.registration.role == Role::Gateway) && std::env::var_os(VARIABLE).is_none() {
        let runtimes = ["acc", "tx", "rx", "net"].map(|name| format!("{name}: (worker_threads: {WORKERS})"));
        #[allow(unsafe_code)]
        // SAFETY: called before this process starts a thread that could read its environment.
        unsafe {
            std::env::set_var(VARIABLE, format!("({})", runtimes.join(", ")));
        }
    }
}

use std::sync::LazyLock;
use std::time::Instant;

use realo_schemas::Nanos;

/// Time that the process has run, ns; never goes back.
pub fn running_time() -> Nanos {
    static BEGUN: LazyLock<Instant> = LazyLock::new(Instant::now);
    BEGUN.elapsed().as_nanos() as Nanos
}

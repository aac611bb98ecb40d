//! What time it is on this machine, and how sure the machine is of it.
//!
//! Drivers and gateways read clocks; operators get the time from their driver.

mod line;

use std::sync::LazyLock;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use realo_schemas::Nanos;

pub use line::wall_now;

/// Time since the process asked first, ns, on a clock that never steps.
pub fn steady() -> Nanos {
    static BEGUN: LazyLock<Instant> = LazyLock::new(Instant::now);
    BEGUN.elapsed().as_nanos() as Nanos
}

/// Time on the machine's wall clock, ns since 1970; it steps where the clock is set.
pub fn wall() -> Nanos {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0, |since| since.as_nanos() as Nanos)
}

/// What the wall clock is off by at most as the kernel says, ns; `None` where nothing synchronises it.
///
/// What synchronises it (chrony and ntpd by GNSS or NTP, phc2sys by PTP) keeps that number.
#[cfg(target_os = "linux")]
pub fn wall_error() -> Option<Nanos> {
    #[allow(unsafe_code)]
    // SAFETY: a `timex` is numbers alone, of which all may be 0, and 0 for `modes` has the kernel change nothing but the structure.
    let (state, clock) = unsafe {
        let mut clock: libc::timex = std::mem::zeroed();
        (libc::adjtimex(&mut clock), clock)
    };
    let is_synchronised = state >= 0 && state != libc::TIME_ERROR && clock.status & libc::STA_UNSYNC == 0;
    // µs.
    is_synchronised.then(|| (clock.maxerror as Nanos).saturating_mul(1000))
}

/// Other systems say nothing.
#[cfg(not(target_os = "linux"))]
pub fn wall_error() -> Option<Nanos> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_says_what_its_clock_is_off_by_or_nothing() {
        let said = wall_error();
        // The kernel counts up to 16 s and says then that nothing synchronises the clock.
        assert!(
            said.is_none_or(|error| (0..16_000_000_000).contains(&error)),
            "{said:?}"
        );
        assert!(wall() > 0 && steady() <= steady());
    }
}

//! The wall clock of a process, which never steps.

use std::sync::LazyLock;

use realo_schemas::Nanos;

use crate::{steady, wall};

/// Readings of both clocks of which the closest two count: between others the thread stood still.
const READINGS: usize = 8;

/// Wall time, ns since the epoch, as the machine had it when it was asked for first, and as it has gone on since by the steady clock.
///
/// Where the machine's wall clock is set meanwhile, this one goes on as before: to follow it would stall what waits for a time,
/// hold up what came before the step, and lay what operators know on another line than what they hear next.
pub fn wall_now() -> Nanos {
    static BEGUN: LazyLock<Nanos> = LazyLock::new(|| begun_at(steady, wall));
    *BEGUN + steady()
}

/// What the wall clock shows at the time 0 of the steady one.
fn begun_at(steady: impl Fn() -> Nanos, wall: impl Fn() -> Nanos) -> Nanos {
    let readings = (0..READINGS).map(|_| {
        let (before, at, after) = (steady(), wall(), steady());
        (after - before, at - before.midpoint(after))
    });
    readings.min().map_or(0, |(_, begun)| begun)
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[test]
    fn wall_time_is_that_of_the_machine_and_goes_on_with_the_steady_clock() {
        let off = || (wall_now() - wall()).abs();
        // A reading may be held up, not all of them.
        assert!((0..100).any(|_| off() < 1_000_000));
        let between = wall_now() - steady();
        assert!((0..100).any(|_| (wall_now() - steady() - between).abs() < 100_000));
    }

    #[test]
    fn a_reading_that_was_held_up_does_not_count() {
        let (time, count) = (Cell::new(1_000), Cell::new(0));
        let steady = || {
            time.set(time.get() + 30);
            time.get()
        };
        // The thread stands still between the two clocks, but once.
        let wall = || {
            count.set(count.get() + 1);
            let stands = if count.get() == 5 { 0 } else { 7_000_000 };
            let read = time.get() + 15 + 500_000_000;
            time.set(time.get() + stands);
            read
        };
        assert_eq!(begun_at(steady, wall), 500_000_000);
    }
}

use realo_schemas::Nanos;
use serde::{Deserialize, Serialize};

use crate::{Epoch, epoch_of};

/// A step of a clock is at least so large, ns. Smaller ones are left to the estimate of the offset.
const STEP: Nanos = 200_000_000;
/// So many stamps and so much time confirm a step back, which a delay looks like at first.
const CONFIRM: (u32, Nanos) = (8, 700_000_000);
/// For so long after a clock was first seen, or stepped, quicker messages make its shift more exact, ns.
const REFINED: Nanos = 5_000_000_000;
/// So many equal stamps are a clock that stands still.
const STILL: u32 = 5;

/// Something that is wrong with stamps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum StampFault {
    /// The stamp of the message before.
    Repeated,
    /// Five times the same stamp: the clock stands still.
    StandsStill,
    /// A stamp before that of the message before.
    Backwards,
    /// A stamp that a message of its arrival cannot have: 0.2 s or more too early. The next one shows whether the clock stepped.
    Ahead,
    /// The clock stepped by 0.2 s or more; counted once a step.
    Jump,
    /// The clock counts from boot.
    Boot,
    /// The clock is 37 s ahead: TAI.
    Tai,
    /// The clock is 18 s ahead: GPS time.
    Gps,
    /// The clock is some 1,024 weeks off.
    Weeks,
    /// The clock is off by more than two seconds, for no known reason.
    Unknown,
}

impl StampFault {
    /// All of them.
    pub const ALL: [StampFault; 10] = [
        StampFault::Repeated,
        StampFault::StandsStill,
        StampFault::Backwards,
        StampFault::Ahead,
        StampFault::Jump,
        StampFault::Boot,
        StampFault::Tai,
        StampFault::Gps,
        StampFault::Weeks,
        StampFault::Unknown,
    ];

    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            StampFault::Repeated => "stamp_repeated",
            StampFault::StandsStill => "stamp_stands_still",
            StampFault::Backwards => "stamp_backwards",
            StampFault::Ahead => "stamp_ahead",
            StampFault::Jump => "stamp_jump",
            StampFault::Boot => "stamp_from_boot",
            StampFault::Tai => "stamp_tai",
            StampFault::Gps => "stamp_gps",
            StampFault::Weeks => "stamp_weeks",
            StampFault::Unknown => "stamp_offset",
        }
    }

    fn of(epoch: Epoch) -> Option<Self> {
        match epoch {
            Epoch::Same => None,
            Epoch::Tai => Some(StampFault::Tai),
            Epoch::Gps => Some(StampFault::Gps),
            Epoch::Boot => Some(StampFault::Boot),
            Epoch::Weeks(_) => Some(StampFault::Weeks),
            Epoch::Unknown => Some(StampFault::Unknown),
        }
    }
}

/// How often each fault was seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StampFaults([u64; StampFault::ALL.len()]);

impl StampFaults {
    fn note(&mut self, fault: StampFault) {
        let count = &mut self.0[fault as usize];
        *count = count.saturating_add(1);
    }

    /// How often a fault was seen.
    pub fn count(&self, fault: StampFault) -> u64 {
        self.0[fault as usize]
    }

    /// The faults that were seen, and how often.
    pub fn seen(&self) -> impl Iterator<Item = (StampFault, u64)> {
        StampFault::ALL.into_iter().zip(self.0).filter(|(_, count)| *count > 0)
    }
}

/// What becomes of messages whose stamps are wrong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Handling {
    /// They are left out.
    Drop,
    /// They get the stamp that the clock would give without its step or wrong epoch. Repeated and earlier stamps are left out,
    /// because nothing says which time is theirs.
    #[default]
    Rebase,
    /// They keep their stamps.
    Trust,
}

/// How a setting says what becomes of messages whose stamps are wrong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StampRule {
    /// Those that are seconds off are left out, all others are taken as they are.
    #[default]
    DropFar,
    /// All of them are left out: [`Handling::Drop`].
    Drop,
    /// They get other stamps: [`Handling::Rebase`].
    Rebase,
    /// All are taken as they are: [`Handling::Trust`].
    Trust,
}

impl StampRule {
    /// What a watch does with the messages that come to it.
    pub fn handling(self) -> Handling {
        match self {
            StampRule::Drop => Handling::Drop,
            StampRule::Rebase => Handling::Rebase,
            StampRule::DropFar | StampRule::Trust => Handling::Trust,
        }
    }
}

/// What a stamp is taken for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Watched {
    /// The stamp to go on with; `None` for a message to leave out.
    pub stamp: Option<Nanos>,
    /// What is wrong with it.
    pub fault: Option<StampFault>,
    /// Whether the clock is another one from here on: what was known of its offset does not hold.
    pub is_new_clock: bool,
}

impl Watched {
    /// Whether the stamp is what its clock says at that moment, even if the clock is wrong.
    pub fn is_of_the_clock(&self) -> bool {
        !matches!(
            self.fault,
            Some(StampFault::Repeated | StampFault::StandsStill | StampFault::Backwards | StampFault::Ahead)
        )
    }
}

/// Watches the stamps of one sensor.
///
/// A message may be delayed by anything but never comes early. So a clock that steps forward shows at once, by two messages that
/// would be too early; a step back is confirmed by eight messages over 0.7 s, and until then their stamps run backwards or are
/// late. A delay that stays 0.2 s longer looks like a step back.
#[derive(Clone, Debug)]
pub struct StampWatch {
    handling: Handling,
    faults: StampFaults,
    clock: Option<ClockSeen>,
    last_step: Nanos,
}

/// Whether a clock stepped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    None,
    /// By one message that is too early.
    Perhaps,
    /// It did: the least arrival minus stamp since.
    To(Nanos),
}

/// A clock as it was seen so far.
#[derive(Clone, Debug)]
struct ClockSeen {
    epoch: Epoch,
    /// What is added to its stamps to have them right, ns.
    shift: Nanos,
    /// Until which arrival quicker messages make the shift smaller; `None` where it is known exactly.
    refined: Option<Nanos>,
    /// The newest stamp with the shift.
    shifted: Nanos,
    /// Least arrival minus stamp, ns.
    least: Nanos,
    last: Nanos,
    equal: u32,
    /// Arrival minus stamp of the last message, if it came too early.
    ahead: Option<Nanos>,
    /// Since which arrival messages have seemed later than they were, how many, and the least arrival minus stamp of them.
    behind: Option<(Nanos, u32, Nanos)>,
}

impl StampWatch {
    /// A watch that has seen nothing.
    pub fn new(handling: Handling) -> Self {
        StampWatch {
            handling,
            faults: StampFaults::default(),
            clock: None,
            last_step: 0,
        }
    }

    /// What was wrong so far.
    pub fn faults(&self) -> StampFaults {
        self.faults
    }

    /// What the clock counts.
    pub fn epoch(&self) -> Option<Epoch> {
        self.clock.as_ref().map(|clock| clock.epoch)
    }

    /// What is added to the clock's stamps to have them right, ns; 0 before its first message.
    pub fn shift(&self) -> Nanos {
        self.clock.as_ref().map_or(0, |clock| clock.shift)
    }

    /// By how much the clock stepped last, ns; 0 where it never did.
    pub fn last_step(&self) -> Nanos {
        self.last_step
    }

    /// Looks at a message's stamp; `arrival`: when it came, by the reference clock.
    pub fn take(&mut self, stamp: Nanos, arrival: Nanos) -> Watched {
        let delay = arrival.saturating_sub(stamp);
        let Some(clock) = &mut self.clock else {
            self.clock = Some(ClockSeen::first(stamp, arrival));
            return self.judged(stamp, None, true);
        };
        let step = if stamp == clock.last {
            Step::None
        } else {
            clock.step(delay, arrival)
        };
        if let Step::To(least) = step {
            let shift = clock.shift.saturating_add(least.saturating_sub(clock.least));
            self.last_step = clock.least.saturating_sub(least);
            let epoch = epoch_of(stamp, arrival);
            // A step into another known epoch is that exactly; any other is as large as it looks.
            let enters = epoch != clock.epoch && epoch != Epoch::Same;
            let exact = epoch.shift().filter(|_| enters);
            let shifted = clock.shifted;
            self.clock = Some(ClockSeen {
                shift: exact.unwrap_or(shift),
                refined: exact.is_none().then(|| arrival.saturating_add(REFINED)),
                shifted,
                epoch,
                least,
                ..ClockSeen::first(stamp, arrival)
            });
            self.faults.note(StampFault::Jump);
            return self.judged(stamp, Some(StampFault::Jump), true);
        }
        let fault = if step == Step::Perhaps {
            Some(StampFault::Ahead)
        } else {
            clock.order(stamp)
        };
        if fault.is_none() {
            clock.refine(stamp, delay, arrival);
        }
        if let Some(fault) = fault {
            self.faults.note(fault);
            let stamp = (self.handling == Handling::Trust).then_some(stamp);
            return Watched {
                stamp,
                fault: Some(fault),
                is_new_clock: false,
            };
        }
        self.judged(stamp, None, false)
    }

    /// A stamp that is in order, by what is known of its clock.
    fn judged(&mut self, stamp: Nanos, jump: Option<StampFault>, is_new_clock: bool) -> Watched {
        let (epoch, shift) = self.clock.as_mut().map_or((Epoch::Same, 0), |clock| {
            clock.shifted = stamp.saturating_add(clock.shift);
            (clock.epoch, clock.shift)
        });
        let fault = StampFault::of(epoch);
        if let Some(fault) = fault {
            self.faults.note(fault);
        }
        let fault = jump.or(fault);
        let is_off = fault.is_some() || shift != 0;
        let stamp = match self.handling {
            Handling::Trust => Some(stamp),
            Handling::Rebase => Some(stamp.saturating_add(shift)),
            Handling::Drop => (!is_off).then_some(stamp),
        };
        Watched {
            stamp,
            fault,
            is_new_clock,
        }
    }
}

impl ClockSeen {
    fn first(stamp: Nanos, arrival: Nanos) -> Self {
        let (epoch, delay) = (epoch_of(stamp, arrival), arrival.saturating_sub(stamp));
        ClockSeen {
            epoch,
            // Without a known epoch the quickest message of the first ones is taken for one that came at once.
            shift: epoch.shift().unwrap_or(delay),
            refined: epoch.shift().is_none().then(|| arrival.saturating_add(REFINED)),
            shifted: Nanos::MIN,
            least: delay,
            last: stamp,
            equal: 0,
            ahead: None,
            behind: None,
        }
    }

    /// Takes the delay of a message in order: a quicker one shows more exactly where the clock is. Shifted stamps rise all the same.
    fn refine(&mut self, stamp: Nanos, delay: Nanos, arrival: Nanos) {
        let less = delay.saturating_sub(self.least);
        if less >= 0 {
            return;
        }
        if self.refined.is_some_and(|until| arrival <= until) {
            let shift = self.shift.saturating_add(less);
            if stamp.saturating_add(shift) <= self.shifted {
                return;
            }
            self.shift = shift;
        }
        self.least = delay;
    }

    /// Whether a message shows a step of the clock.
    fn step(&mut self, delay: Nanos, arrival: Nanos) -> Step {
        if delay < self.least.saturating_sub(STEP) {
            return match self.ahead.replace(delay) {
                // The quicker of the two is nearer to what the clock shows.
                Some(before) => Step::To(delay.min(before)),
                None => Step::Perhaps,
            };
        }
        self.ahead = None;
        if delay <= self.least.saturating_add(STEP) {
            self.behind = None;
            return Step::None;
        }
        let (since, count, least) = self.behind.unwrap_or((arrival, 0, delay));
        let (count, least) = (count.saturating_add(1), least.min(delay));
        self.behind = Some((since, count, least));
        if count >= CONFIRM.0 && arrival.saturating_sub(since) >= CONFIRM.1 {
            Step::To(least)
        } else {
            Step::None
        }
    }

    /// Whether a stamp comes after the last one.
    fn order(&mut self, stamp: Nanos) -> Option<StampFault> {
        if stamp == self.last {
            self.equal = self.equal.saturating_add(1);
            let still = self.equal + 1 >= STILL;
            return Some(if still {
                StampFault::StandsStill
            } else {
                StampFault::Repeated
            });
        }
        self.equal = 0;
        if stamp < self.last {
            return Some(StampFault::Backwards);
        }
        self.last = stamp;
        None
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: Nanos = 1_000_000;
    const NOW: Nanos = 1_790_000_000_000 * MS;

    /// Messages every 100 ms, 20 ms on their way, whose stamps are off by `off` ms; what the watch says of each.
    fn watched(handling: Handling, off: impl Fn(i64) -> i64, count: i64) -> (StampWatch, Vec<Watched>) {
        let mut watch = StampWatch::new(handling);
        let found = (0..count)
            .map(|number| {
                let measured = NOW + number * 100 * MS;
                watch.take(measured + off(number) * MS, measured + 20 * MS)
            })
            .collect();
        (watch, found)
    }

    /// How far the stamps that go on are off, ms; with the messages' numbers.
    fn errors(found: &[Watched]) -> Vec<(i64, i64)> {
        let stamps = found.iter().enumerate();
        stamps
            .filter_map(|(number, watched)| Some((number as i64, watched.stamp? - NOW - number as i64 * 100 * MS)))
            .map(|(number, error)| (number, error / MS))
            .collect()
    }

    #[test]
    fn a_clock_that_is_right_stays_as_it_is() {
        for handling in [Handling::Drop, Handling::Rebase, Handling::Trust] {
            let (watch, found) = watched(handling, |number| number % 3 * 7, 50);
            assert_eq!(watch.faults().seen().count(), 0);
            assert!(
                found
                    .iter()
                    .all(|watched| watched.stamp.is_some() && watched.fault.is_none())
            );
        }
    }

    #[test]
    fn epochs_are_named_and_taken_back() {
        let weeks = 1_024 * 7 * 86_400_000;
        for (off, fault, slack) in [
            (37_000, StampFault::Tai, 0),
            (18_000, StampFault::Gps, 0),
            (-weeks, StampFault::Weeks, 0),
            (3 - NOW / MS, StampFault::Boot, 20),
            (-7_200_000, StampFault::Unknown, 20),
        ] {
            let (watch, found) = watched(Handling::Rebase, |_| off, 30);
            assert_eq!(watch.faults().seen().collect::<Vec<_>>(), [(fault, 30)], "{off}");
            let errors = errors(&found);
            assert_eq!(errors.len(), 30);
            assert!(
                errors.iter().all(|(_, error)| (0..=slack).contains(error)),
                "{off}: {errors:?}"
            );
            assert!(
                watched(Handling::Drop, |_| off, 30)
                    .1
                    .iter()
                    .all(|watched| watched.stamp.is_none())
            );
            let trusted = watched(Handling::Trust, |_| off, 30).1;
            assert!(
                trusted
                    .iter()
                    .all(|watched| watched.stamp.is_some() && watched.fault == Some(fault))
            );
        }
    }

    #[test]
    fn steps_are_taken_back_once_they_are_sure() {
        for step in [1_000, 250, -1_000, -400, 37_000] {
            let (watch, found) = watched(Handling::Rebase, |number| if number < 20 { 0 } else { step }, 60);
            assert_eq!(watch.faults().count(StampFault::Jump), 1, "{step}");
            assert_eq!(found.iter().filter(|watched| watched.is_new_clock).count(), 2);
            let sure = if step > 0 { 22 } else { 20 + 8 };
            let errors = errors(&found);
            let after = errors.iter().filter(|(number, _)| *number >= sure || *number < 20);
            assert!(after.clone().all(|(_, error)| *error == 0), "{step}: {errors:?}");
            assert!(after.count() >= 50, "{step}: {errors:?}");
        }
    }

    #[test]
    fn one_stamp_ahead_is_left_out_alone() {
        let (watch, found) = watched(Handling::Rebase, |number| if number == 20 { 5_000 } else { 0 }, 40);
        assert_eq!(watch.faults().seen().collect::<Vec<_>>(), [(StampFault::Ahead, 1)]);
        assert_eq!(errors(&found).len(), 39);
    }

    #[test]
    fn stamps_that_repeat_run_backwards_or_stand_still_are_named() {
        // Every tenth message has the stamp of the one before.
        let (watch, found) = watched(Handling::Rebase, |number| if number % 10 == 5 { -100 } else { 0 }, 100);
        assert_eq!(watch.faults().seen().collect::<Vec<_>>(), [(StampFault::Repeated, 10)]);
        assert_eq!(errors(&found).len(), 90);
        let (watch, _) = watched(Handling::Drop, |number| if number % 10 == 5 { -150 } else { 0 }, 100);
        assert_eq!(watch.faults().seen().collect::<Vec<_>>(), [(StampFault::Backwards, 10)]);
        let still = |number: i64| if number < 20 { 0 } else { -100 * (number - 19) };
        let (watch, found) = watched(Handling::Rebase, still, 60);
        assert_eq!(watch.faults().count(StampFault::StandsStill), 37);
        assert_eq!(watch.faults().count(StampFault::Repeated), 3);
        assert_eq!(watch.faults().count(StampFault::Jump), 0);
        assert_eq!(errors(&found).len(), 20);
    }

    proptest! {
        #[test]
        fn no_stamps_panic_and_rebased_ones_rise(numbers in prop::collection::vec((any::<i64>(), any::<i64>()), 1..200)) {
            for handling in [Handling::Drop, Handling::Rebase, Handling::Trust] {
                let mut watch = StampWatch::new(handling);
                for (stamp, arrival) in &numbers {
                    watch.take(*stamp, *arrival);
                }
            }
        }

        /// Whatever the clock's epoch and the jitter of arrivals: one fault, and stamps that rise.
        #[test]
        fn jitter_is_no_fault(off in -3_600_000_000..3_600_000_000i64, jitter in prop::collection::vec(0..150i64, 100)) {
            let mut watch = StampWatch::new(Handling::Rebase);
            let mut last = Nanos::MIN;
            for (number, jitter) in jitter.iter().enumerate() {
                let measured = NOW + number as i64 * 100 * MS;
                let watched = watch.take(measured + off * MS, measured + jitter * MS);
                prop_assert!(watched.stamp.is_some_and(|stamp| stamp > last));
                last = watched.stamp.unwrap_or(last);
            }
            prop_assert!(watch.faults().seen().count() <= 1);
            prop_assert_eq!(watch.faults().count(StampFault::Jump), 0);
        }
    }
}

//! How something turned about the vertical, as two sensors see it.

use realo_schemas::{Nanos, to_seconds};

/// A yaw rate of an IMU.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct YawRate {
    /// By the IMU's clock.
    pub stamp: Nanos,
    /// About the vertical, rad/s.
    pub rate: f64,
}

/// A heading by registration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heading {
    /// By the scanner's clock.
    pub stamp: Nanos,
    /// In any frame that stays, rad; it may wrap around.
    pub yaw: f64,
}

/// The angle that rates add up to, by trapezoids.
pub(crate) struct Angle<'a> {
    rates: &'a [YawRate],
    sums: Vec<f64>,
    longest: Nanos,
}

impl<'a> Angle<'a> {
    /// Of rates with rising stamps; where two are more than `longest` ns apart nothing is known between them.
    pub fn new(rates: &'a [YawRate], longest: Nanos) -> Self {
        let mut sum = 0.0;
        let mut sums = Vec::with_capacity(rates.len());
        for (number, rate) in rates.iter().enumerate() {
            if number > 0 {
                let last = &rates[number - 1];
                sum += 0.5 * (last.rate + rate.rate) * to_seconds(rate.stamp - last.stamp);
            }
            sums.push(sum);
        }
        Angle { rates, sums, longest }
    }

    /// Angle (rad, from the first rate) and rate (rad/s) at a stamp, where they are known.
    pub fn at(&self, stamp: Nanos) -> Option<(f64, f64)> {
        let after = self.rates.partition_point(|rate| rate.stamp <= stamp);
        let (last, next) = (self.rates.get(after.checked_sub(1)?)?, self.rates.get(after)?);
        if next.stamp - last.stamp > self.longest {
            return None;
        }
        let seconds = to_seconds(stamp - last.stamp);
        let share = seconds / to_seconds(next.stamp - last.stamp);
        let rate = last.rate + (next.rate - last.rate) * share;
        Some((self.sums[after - 1] + 0.5 * (last.rate + rate) * seconds, rate))
    }
}

//! How a vehicle's body leans and sways.

use crate::random::Stream;

/// A vehicle on its springs; the figures are modelling choices: usual cars dive by 1 to 1.5° at 3 m/s², and roll by as
/// much in bends of 3 m/s².
#[derive(Clone, Debug)]
pub(super) struct Sway {
    /// Frequency in Hz and phase of each wave, two of pitch, two of roll.
    waves: [[f64; 2]; 4],
}

impl Sway {
    /// Slope for an acceleration of 1 m/s², along and across.
    const DIVE: f64 = 0.006;
    const ROLL: f64 = 0.007;
    /// Slopes of the waves at speed: the body on its springs, and the wheels' shaking.
    const WAVES: [f64; 2] = [0.0016, 0.000_6];

    pub(super) fn new(draws: &mut Stream) -> Self {
        let mut wave = |low, high| [draws.between(low, high), draws.between(0.0, std::f64::consts::TAU)];
        Sway {
            waves: [wave(1.0, 1.6), wave(9.0, 13.0), wave(1.2, 1.9), wave(9.0, 13.0)],
        }
    }

    /// Slopes along and across, nose and left side up; accelerations ahead and to the left.
    pub(super) fn at(&self, t: f64, speed: f64, ahead: f64, left: f64) -> (f64, f64) {
        let rough = (speed * 0.1).clamp(0.0, 1.0);
        let wave = |k: usize| {
            let [frequency, phase] = self.waves[k];
            rough * Self::WAVES[k % 2] * libm::sin(std::f64::consts::TAU * frequency * t + phase)
        };
        // Braking lifts the rear; in a bend to the left the body leans to the right, so that its left side rises.
        let pitch = Self::DIVE * ahead.clamp(-6.0, 4.0) + wave(0) + wave(1);
        let roll = Self::ROLL * left.clamp(-5.0, 5.0) + wave(2) + wave(3);
        (pitch, roll)
    }
}

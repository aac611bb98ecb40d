//! The uniform and normal numbers that numpy's `RandomState` makes of the Mersenne Twister MT19937 (Matsumoto and Nishimura
//! 1998): what the reference's noise is drawn from.

use rand_mt::Mt;

/// A generator with its place in the sequence.
#[derive(Clone, Debug)]
pub struct Mersenne {
    words: Mt,
    /// The second of the normal numbers that were made last.
    second: Option<f64>,
}

impl Mersenne {
    /// The generator of a seed, as `numpy.random.seed` sets it.
    pub fn new(seed: u32) -> Self {
        Mersenne {
            words: Mt::new(seed),
            second: None,
        }
    }

    /// The next number in [0, 1), of 53 bits.
    pub fn uniform(&mut self) -> f64 {
        let [high, low] = [5, 6].map(|dropped| f64::from(self.words.next_u32() >> dropped));
        (high * f64::from(1 << 26) + low) / (1u64 << 53) as f64
    }

    /// The next number of N(0, 1), by the polar method (Marsaglia), which makes two at a time.
    pub fn normal(&mut self) -> f64 {
        if let Some(second) = self.second.take() {
            return second;
        }
        loop {
            let [x, y] = [self.uniform(), self.uniform()].map(|part| 2.0 * part - 1.0);
            let square = x * x + y * y;
            if square < 1.0 && square != 0.0 {
                let factor = (-2.0 * libm::log(square) / square).sqrt();
                self.second = Some(factor * x);
                return factor * y;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `numpy.random.seed(0)`, then `numpy.random.normal(size=5)` or `numpy.random.rand(3)`.
    #[test]
    fn numbers_are_those_of_numpy() {
        let mut generator = Mersenne::new(0);
        let normal: Vec<f64> = (0..5).map(|_| generator.normal()).collect();
        let expected = [
            1.764052345967664,
            0.4001572083672233,
            0.9787379841057392,
            2.240893199201458,
            1.8675579901499675,
        ];
        assert!(
            normal.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-15),
            "{normal:?}"
        );
        let mut generator = Mersenne::new(0);
        let uniform: Vec<f64> = (0..3).map(|_| generator.uniform()).collect();
        assert_eq!(uniform, [0.5488135039273248, 0.7151893663724195, 0.6027633760716439]);
    }
}

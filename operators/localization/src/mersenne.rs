//! The Mersenne Twister MT19937 (Matsumoto and Nishimura 1998), with the uniform and normal numbers that numpy's
//! `RandomState` makes of it: what the reference's noise is drawn from.

const WORDS: usize = 624;
const MIDDLE: usize = 397;

/// A generator with its place in the sequence.
#[derive(Clone, Debug)]
pub struct Mersenne {
    words: [u32; WORDS],
    /// Word that is given next; all have been if there is no such word.
    next: usize,
    /// The second of the normal numbers that were made last.
    spare: Option<f64>,
}

impl Mersenne {
    /// The generator of a seed, as `numpy.random.seed` sets it.
    pub fn new(seed: u32) -> Self {
        let mut words = [seed; WORDS];
        for index in 1..WORDS {
            let last = words[index - 1];
            words[index] = (last ^ (last >> 30))
                .wrapping_mul(1_812_433_253)
                .wrapping_add(index as u32);
        }
        Mersenne {
            words,
            next: WORDS,
            spare: None,
        }
    }

    /// The next 32 bits.
    pub fn word(&mut self) -> u32 {
        if self.next == WORDS {
            self.twist();
        }
        let mut word = self.words[self.next];
        self.next += 1;
        word ^= word >> 11;
        word ^= (word << 7) & 0x9d2c_5680;
        word ^= (word << 15) & 0xefc6_0000;
        word ^ (word >> 18)
    }

    fn twist(&mut self) {
        for index in 0..WORDS {
            let [this, next, far] = [0, 1, MIDDLE].map(|ahead| self.words[(index + ahead) % WORDS]);
            let both = (this & 0x8000_0000) | (next & 0x7fff_ffff);
            let mask = if both & 1 == 1 { 0x9908_b0df } else { 0 };
            self.words[index] = far ^ (both >> 1) ^ mask;
        }
        self.next = 0;
    }

    /// The next number in [0, 1), of 53 bits.
    pub fn uniform(&mut self) -> f64 {
        let [high, low] = [self.word() >> 5, self.word() >> 6].map(f64::from);
        (high * f64::from(1 << 26) + low) / (1u64 << 53) as f64
    }

    /// The next number of N(0, 1), by the polar method (Marsaglia), which makes two at a time.
    pub fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        loop {
            let [x, y] = [self.uniform(), self.uniform()].map(|part| 2.0 * part - 1.0);
            let square = x * x + y * y;
            if square < 1.0 && square != 0.0 {
                let factor = (-2.0 * libm::log(square) / square).sqrt();
                self.spare = Some(factor * x);
                return factor * y;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Those of `std::mt19937` (C++ standard, [rand.predef]: the 10,000th word of the default seed).
    #[test]
    fn words_are_those_of_the_definition() {
        let mut generator = Mersenne::new(5489);
        let first: Vec<u32> = (0..3).map(|_| generator.word()).collect();
        assert_eq!(first, [3_499_211_612, 581_869_302, 3_890_346_734]);
        let word = (3..10_000).map(|_| generator.word()).last();
        assert_eq!(word, Some(4_123_659_995));
    }

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

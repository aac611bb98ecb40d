//! Seeded damage to bytes: the same cases on every machine.

/// Cases of a fuzz test: `REALO_FUZZ_CASES`, or as many as a normal run has time for.
pub fn cases(usual: u64) -> u64 {
    std::env::var("REALO_FUZZ_CASES").map_or(usual, |text| {
        text.parse()
            .unwrap_or_else(|_| panic!("REALO_FUZZ_CASES: expected a number, found `{text}`"))
    })
}

/// Draws by splitmix64.
pub struct Draw(u64);

impl Draw {
    /// The draws of a seed.
    pub fn new(seed: u64) -> Self {
        Draw(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15))
    }

    /// Any number.
    pub fn number(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number in [0, n), 0 of none.
    pub fn below(&mut self, n: usize) -> usize {
        (self.number() % n.max(1) as u64) as usize
    }

    /// Whether one of so many cases has come.
    pub fn chance(&mut self, one_in: usize) -> bool {
        self.below(one_in) == 0
    }

    /// One of several.
    pub fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }

    /// A number that lengths and counts go wrong at: near `usual`, near a power of two, or any.
    pub fn length(&mut self, usual: u64) -> u64 {
        let near = |draw: &mut Draw, value: u64| value.wrapping_add(draw.below(5) as u64).wrapping_sub(2);
        match self.below(6) {
            0 | 1 => near(self, usual),
            2 | 3 => {
                let power = 1u64 << self.below(64);
                near(self, power)
            }
            4 => near(self, 0),
            _ => self.number(),
        }
    }

    /// Damages bytes in one to four places: bits, numbers of 1 to 8 bytes, pieces cut out, doubled or moved, the end.
    pub fn damage(&mut self, bytes: &mut Vec<u8>) {
        for _ in 0..=self.below(4) {
            self.damage_once(bytes);
        }
    }

    fn damage_once(&mut self, bytes: &mut Vec<u8>) {
        if bytes.is_empty() {
            bytes.push(self.number() as u8);
            return;
        }
        let at = self.below(bytes.len());
        match self.below(8) {
            0 => bytes[at] ^= 1 << self.below(8),
            1..=3 => {
                let width = self.pick(&[1, 2, 4, 8]).min(bytes.len() - at);
                let mut old = [0; 8];
                old[..width].copy_from_slice(&bytes[at..at + width]);
                let new = self.length(u64::from_le_bytes(old)).to_le_bytes();
                bytes[at..at + width].copy_from_slice(&new[..width]);
            }
            4 => bytes.truncate(at),
            5 => {
                let end = (at + 1 + self.below(64)).min(bytes.len());
                bytes.drain(at..end);
            }
            6 => {
                let end = (at + 1 + self.below(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                let to = self.below(bytes.len() + 1);
                bytes.splice(to..to, piece);
            }
            _ => {
                let fresh: Vec<u8> = (0..=self.below(16)).map(|_| self.number() as u8).collect();
                bytes.splice(at..at, fresh);
            }
        }
    }
}

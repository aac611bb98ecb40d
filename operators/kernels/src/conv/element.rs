/// Number type of a map.
pub trait Element: Copy + Default + Send + Sync + 'static {
    /// Numbers in a unit of 4 bytes.
    const PER_UNIT: usize;

    /// The nearest number of this type.
    fn from_f32(value: f32) -> Self;

    /// The number in single precision.
    fn to_f32(self) -> f32;

    /// The number that a weight is a multiple of, from the largest of its output's.
    fn weight_step(_max: f32) -> f32 {
        1.0
    }

    /// A weight, in steps.
    fn weight(steps: f32) -> Self {
        Self::from_f32(steps)
    }
}

impl Element for f32 {
    const PER_UNIT: usize = 1;

    #[inline]
    fn from_f32(value: f32) -> Self {
        value
    }

    #[inline]
    fn to_f32(self) -> f32 {
        self
    }
}

/// The upper half of an f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(transparent)]
pub struct Bf16(pub u16);

impl Element for Bf16 {
    const PER_UNIT: usize = 2;

    /// Rounds to nearest, ties to even; NaN stays NaN.
    #[inline]
    fn from_f32(value: f32) -> Self {
        let bits = value.to_bits();
        let rounded = bits.wrapping_add(0x7fff + (bits >> 16 & 1)) >> 16;
        let quiet = bits >> 16 | 0x40;
        Bf16(if value.is_nan() { quiet } else { rounded } as u16)
    }

    #[inline]
    fn to_f32(self) -> f32 {
        f32::from_bits(u32::from(self.0) << 16)
    }
}

/// A multiple of a map's step, 0 to 255; as a weight, one of its output's step within [`MOST_WEIGHT`], as a signed byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(transparent)]
pub struct U8(pub u8);

/// Largest weight in steps: two products with it, added, fit 16 bits, which AVX2 needs.
const MOST_WEIGHT: f32 = 64.0;

impl Element for U8 {
    const PER_UNIT: usize = 4;

    /// Rounds to nearest, ties to even; NaN becomes 0.
    #[inline]
    fn from_f32(value: f32) -> Self {
        U8(value.round_ties_even() as u8)
    }

    #[inline]
    fn to_f32(self) -> f32 {
        f32::from(self.0)
    }

    fn weight_step(max: f32) -> f32 {
        if max > 0.0 { max / MOST_WEIGHT } else { 1.0 }
    }

    fn weight(steps: f32) -> Self {
        U8(steps.round_ties_even().clamp(-MOST_WEIGHT, MOST_WEIGHT) as i8 as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bf16_rounds_to_nearest_even() {
        let round = |value: f32| Bf16::from_f32(value).to_f32();
        let step = 2f32.powi(-7);
        let cases = [
            (1.0, 1.0),
            (-0.0, -0.0),
            (1.0 + 0.4 * step, 1.0),
            (1.0 + 0.5 * step, 1.0),
            (1.0 + 0.6 * step, 1.0 + step),
            (1.0 + 1.5 * step, 1.0 + 2.0 * step),
            (-3.0 - 0.9 * step, -3.0),
            (f32::MAX, f32::INFINITY),
            (f32::NEG_INFINITY, f32::NEG_INFINITY),
        ];
        for (value, expected) in cases {
            assert_eq!(round(value).to_bits(), expected.to_bits(), "{value}");
        }
        for bits in [0x7f80_0001, 0x7fff_ffff, 0xffff_ffff] {
            assert!(round(f32::from_bits(bits)).is_nan());
        }
    }
}

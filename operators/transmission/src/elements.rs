//! Numbers of a feature map as elements that cross: in half precision, or as 8-bit codes.
//!
//! All loops are plain arithmetic without a fused multiply-add: every processor gives the same bits.

use half::f16;
use half::slice::HalfFloatSliceExt;
use realo_schemas::DType;

use crate::error::{DecodeError, EncodeError};

/// Largest number of half precision.
const GREATEST: f32 = 65_504.0;
/// Steps between the smallest and the largest code.
const STEPS: f32 = 255.0;
/// Added to a number below 2²², it leaves the nearest whole one in the low bits.
const ROUND: f32 = 12_582_912.0;
/// Numbers that are converted at once.
const BLOCK: usize = 1024;

/// Whether all elements of such a type, as they lie in a message, are finite.
pub(crate) fn are_finite(bytes: &[u8], dtype: DType) -> bool {
    let all16 = |exponent: u16| all::<2>(bytes, |b| u16::from_le_bytes(b) & exponent != exponent);
    match dtype {
        DType::F32 => all::<4>(bytes, |b| u32::from_le_bytes(b) & 0x7f80_0000 != 0x7f80_0000),
        DType::F16 => all16(0x7c00),
        DType::Bf16 => all16(0x7f80),
        DType::U8 => true,
    }
}

/// Without a branch between elements, so that the loop becomes vectors.
fn all<const N: usize>(bytes: &[u8], holds: impl Fn([u8; N]) -> bool) -> bool {
    let mut blocks = bytes.as_chunks::<N>().0.chunks(BLOCK);
    blocks.all(|block| block.iter().fold(true, |all, element| all & holds(*element)))
}

/// Writes numbers in half precision; says how many were beyond its range. All are finite.
pub(crate) fn to_f16(numbers: &[f32], out: &mut Vec<u8>) -> u64 {
    out.resize(2 * numbers.len(), 0);
    let (mut bounded, mut halves) = ([0.0f32; BLOCK], [f16::ZERO; BLOCK]);
    let mut beyond = 0;
    for (numbers, bytes) in numbers.chunks(BLOCK).zip(out.chunks_mut(2 * BLOCK)) {
        let mut count = 0u32;
        for (bounded, number) in bounded.iter_mut().zip(numbers) {
            *bounded = number.clamp(-GREATEST, GREATEST);
            count += u32::from(*bounded != *number);
        }
        beyond += u64::from(count);
        let halves = &mut halves[..numbers.len()];
        halves.convert_from_f32_slice(&bounded[..numbers.len()]);
        for (bytes, half) in bytes.as_chunks_mut::<2>().0.iter_mut().zip(halves) {
            *bytes = half.to_le_bytes();
        }
    }
    beyond
}

/// Reads numbers of half precision.
///
/// # Errors
/// [`DecodeError::Value`] of one that is not finite.
pub(crate) fn from_f16(bytes: &[u8]) -> Result<Vec<f32>, DecodeError> {
    if !are_finite(bytes, DType::F16) {
        return Err(not_finite());
    }
    let mut numbers = vec![0.0; bytes.len() / 2];
    let mut halves = [f16::ZERO; BLOCK];
    for (bytes, numbers) in bytes.chunks(2 * BLOCK).zip(numbers.chunks_mut(BLOCK)) {
        for (half, bytes) in halves.iter_mut().zip(bytes.as_chunks::<2>().0) {
            *half = f16::from_le_bytes(*bytes);
        }
        halves[..numbers.len()].convert_to_f32_slice(numbers);
    }
    Ok(numbers)
}

/// What a code of each channel means: the number `smallest + code × step`.
///
/// A channel's codes go from its smallest number in the map to its largest. Behind a ReLU the smallest one is 0 almost
/// everywhere, and with it the code 0 is exactly 0; codes of both signs about 0 would leave half of them unused. A map
/// without a ReLU has numbers of both signs, and the same rule.
#[derive(Debug, Default)]
pub(crate) struct Scales {
    pub min: Vec<f32>,
    pub step: Vec<f32>,
    /// One over the step.
    rate: Vec<f32>,
}

impl Scales {
    /// Takes the ranges of all channels.
    ///
    /// # Errors
    /// [`EncodeError::Range`] of a channel whose range is not finite. All numbers are.
    fn measure(&mut self, numbers: &[f32], channels: usize) -> Result<(), EncodeError> {
        let Scales { min, step, rate } = self;
        min.clear();
        min.extend_from_slice(&numbers[..channels]);
        // The largest for now.
        step.clone_from(min);
        for cell in numbers.chunks_exact(channels) {
            for ((min, most), number) in min.iter_mut().zip(step.iter_mut()).zip(cell) {
                *min = if *number < *min { *number } else { *min };
                *most = if *number > *most { *number } else { *most };
            }
        }
        for (channel, (min, most)) in min.iter().zip(step.iter_mut()).enumerate() {
            let range = *most - *min;
            if !range.is_finite() {
                let (min, most) = (*min, *most);
                return Err(EncodeError::Range { channel, min, most });
            }
            // One over a lesser step would not be finite.
            *most = (range / STEPS).max(f32::MIN_POSITIVE);
        }
        rate.clear();
        rate.extend(step.iter().map(|step| 1.0 / step));
        Ok(())
    }

    /// Writes numbers as codes, `[cells, channels]`; all are finite, and there is a cell.
    ///
    /// # Errors
    /// Those of [`Scales::measure`].
    pub fn quantise(&mut self, numbers: &[f32], channels: usize, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        self.measure(numbers, channels)?;
        out.resize(numbers.len(), 0);
        let cells = numbers.chunks_exact(channels).zip(out.chunks_exact_mut(channels));
        for (cell, codes) in cells {
            let scales = self.min.iter().zip(&self.rate);
            for ((code, number), (min, rate)) in codes.iter_mut().zip(cell).zip(scales) {
                *code = ((number - min) * rate + ROUND).to_bits() as u8;
            }
        }
        Ok(())
    }

    /// Reads codes.
    pub fn dequantise(&self, codes: &[u8]) -> Vec<f32> {
        let mut numbers = Vec::with_capacity(codes.len());
        for codes in codes.chunks_exact(self.min.len()) {
            let scales = self.min.iter().zip(&self.step);
            numbers.extend(
                codes
                    .iter()
                    .zip(scales)
                    .map(|(code, (min, step))| min + f32::from(*code) * step),
            );
        }
        numbers
    }

    /// Takes what a peer says the scales are.
    ///
    /// # Errors
    /// [`DecodeError::Value`] of a channel with numbers that are not finite, or a step that is not above 0.
    pub fn take(&mut self, min: Vec<f32>, step: Vec<f32>) -> Result<(), DecodeError> {
        for (channel, (min, step)) in min.iter().zip(&step).enumerate() {
            if !(min.is_finite() && *step > 0.0 && (min + STEPS * step).is_finite()) {
                return Err(DecodeError::Value {
                    field: "scale of a channel",
                    expected: "a min number and a step above 0 whose codes are finite numbers",
                    found: format!("min {min}, step {step} in channel {channel}"),
                });
            }
        }
        (self.min, self.step) = (min, step);
        Ok(())
    }
}

/// Elements with one that no network makes.
pub(crate) fn not_finite() -> DecodeError {
    DecodeError::Value {
        field: "elements",
        expected: "finite numbers",
        found: "one that is not".into(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn through_codes(numbers: &[f32], channels: usize) -> (Scales, Vec<f32>) {
        let (mut scales, mut codes) = (Scales::default(), Vec::new());
        scales.quantise(numbers, channels, &mut codes).unwrap();
        let found = scales.dequantise(&codes);
        (scales, found)
    }

    fn through_f16(numbers: &[f32]) -> (u64, Vec<f32>) {
        let mut bytes = Vec::new();
        let beyond = to_f16(numbers, &mut bytes);
        (beyond, from_f16(&bytes).unwrap())
    }

    #[test]
    fn zeros_and_constant_channels_are_exact() {
        // A channel behind a ReLU, an empty one, one of a single number, one of both signs.
        let numbers = [0.0, 0.0, 7.25, -1.0, 3.0, 0.0, 7.25, 1.0, 0.7, 0.0, 7.25, 0.0];
        let (scales, found) = through_codes(&numbers, 4);
        for (k, (found, number)) in found.iter().zip(&numbers).enumerate() {
            let bound = if k % 4 == 3 || k == 8 {
                scales.step[k % 4] * 0.501
            } else {
                0.0
            };
            assert!((found - number).abs() <= bound, "{k}: {found} for {number}");
        }
    }

    #[test]
    fn the_max_and_min_numbers_have_a_defined_result() {
        let tiny = [f32::from_bits(1), 0.0, -f32::MIN_POSITIVE];
        let (_, found) = through_codes(&tiny, 1);
        assert!(
            found
                .iter()
                .zip(&tiny)
                .all(|(found, number)| (found - number).abs() <= f32::MIN_POSITIVE)
        );
        let mut scales = Scales::default();
        let error = scales.quantise(&[0.0, f32::MAX, 1.0, -f32::MAX], 2, &mut Vec::new());
        let (channel, min, most) = (1, -f32::MAX, f32::MAX);
        assert_eq!(error, Err(EncodeError::Range { channel, min, most }));
        let (beyond, found) = through_f16(&[65_504.0, 65_505.0, -1e30, 3.0e-8, -2e-8]);
        assert_eq!((beyond, &found[..3]), (2, &[65_504.0, 65_504.0, -65_504.0][..]));
        assert_eq!(found[3..], [2f32.powi(-24), -0.0], "below the min of half precision");
    }

    #[test]
    fn halves_round_to_the_even_one() {
        // 1 + 2⁻¹¹ lies midway between 1 and the next, 1 + 3 × 2⁻¹¹ between the next two.
        let (_, found) = through_f16(&[1.0 + 2f32.powi(-11), 1.0 + 3.0 * 2f32.powi(-11), 0.1]);
        assert_eq!(found, [1.0, 1.0 + 4.0 * 2f32.powi(-11), 0.099_975_586]);
    }

    #[test]
    fn what_is_not_finite_is_seen_in_every_type() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let numbers: Vec<f32> = (0..3000).map(|k| if k == 2999 { bad } else { 1e30 }).collect();
            let bytes: Vec<u8> = numbers.iter().flat_map(|v| v.to_le_bytes()).collect();
            assert!(!are_finite(&bytes, DType::F32) && are_finite(&bytes[..8000], DType::F32));
            let halves: Vec<u8> = numbers
                .iter()
                .flat_map(|v| f16::from_f32(v / 1e28).to_le_bytes())
                .collect();
            assert!(!are_finite(&halves, DType::F16) && from_f16(&halves).is_err());
            assert!(are_finite(&halves[..4000], DType::F16) && are_finite(&bytes, DType::U8));
            let bf16: Vec<u8> = bytes.chunks_exact(4).flat_map(|b| [b[2], b[3]]).collect();
            assert!(!are_finite(&bf16, DType::Bf16) && are_finite(&bf16[..4000], DType::Bf16));
        }
    }

    proptest! {
        #[test]
        fn codes_are_off_by_half_a_step_of_their_channel(
            channels in 1usize..40,
            cells in 1usize..60,
            scale in -20f32..20.0,
            seed in any::<u64>(),
        ) {
            let number = |i: usize| {
                let drawn = (i as u64 + 1).wrapping_mul(seed | 1).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
                (drawn as f32 / (1u64 << 24) as f32 - 0.3) * 10f32.powf(scale)
            };
            let numbers: Vec<f32> = (0..channels * cells).map(number).collect();
            let (scales, found) = through_codes(&numbers, channels);
            for (i, (found, number)) in found.iter().zip(&numbers).enumerate() {
                let (min, step) = (scales.min[i % channels], scales.step[i % channels]);
                // Half a step, and the rounding of f32 in a sum of numbers of this size.
                let bound = 0.5001 * step + 1e-6 * (min.abs() + 255.0 * step);
                prop_assert!((found - number).abs() <= bound, "{found} for {number}, step {step}");
            }
        }

        #[test]
        fn halves_are_off_by_a_2048th(numbers in prop::collection::vec(-65_504f32..65_504.0, 1..3000), power in -30i32..0) {
            let numbers: Vec<f32> = numbers.iter().map(|number| number * 2f32.powi(power)).collect();
            let (beyond, found) = through_f16(&numbers);
            prop_assert_eq!(beyond, 0);
            for (found, number) in found.iter().zip(&numbers) {
                let bound = (number.abs() * 2f32.powi(-11)).max(2f32.powi(-25));
                prop_assert!((found - number).abs() <= bound, "{found} for {number}");
                prop_assert_eq!(*found, f16::from_f32_const(*number).to_f32_const(), "as without instructions for it");
            }
        }
    }
}

//! Focal loss with sigmoid and exponent 2, eight logits at a time.
//!
//! With y = -x for a score x that should be 1 and y = x for one that should be 0, and s the sigmoid of y, the loss is
//! s² · ln(1 + eʸ), and its derivative by y is s² · (2 (1 - s) ln(1 + eʸ) + s).

use realo_kernels::simd::dispatch;

/// Logits that are computed together.
const LANES: usize = 8;
/// Logits for which weights are laid out at a time, as far as an anchor's classes allow.
const BLOCK: usize = 4096;

/// The weighted focal loss of `[anchors, classes]` logits; `gradient` is overwritten with its derivative.
///
/// `labels`: per anchor 1 + its class, 0 for none, less than 0 if it does not count. `weights`: of scores that should be
/// 1, and 0.
pub(super) fn focal(logits: &[f32], labels: &[i8], weights: [f32; 2], gradient: &mut [f32]) -> f64 {
    if labels.is_empty() {
        return 0.0;
    }
    let classes = logits.len() / labels.len();
    let anchors = (BLOCK / classes.max(1)).max(1);
    let mut signed = vec![0.0; anchors * classes];
    let mut sum = 0.0;
    for (block, labels) in labels.chunks(anchors).enumerate() {
        let signed = &mut signed[..labels.len() * classes];
        sign(labels, classes, weights, signed);
        let at = block * anchors * classes..block * anchors * classes + signed.len();
        sum += block_loss(&logits[at.clone()], signed, &mut gradient[at]);
    }
    sum
}

/// Each logit's weight, negative where the score should be 1.
fn sign(labels: &[i8], classes: usize, [one, zero]: [f32; 2], signed: &mut [f32]) {
    signed.fill(zero);
    for (anchor, label) in labels.iter().enumerate().filter(|(_, label)| **label != 0) {
        let anchor = &mut signed[anchor * classes..(anchor + 1) * classes];
        match usize::try_from(*label) {
            Ok(class) => anchor[class - 1] = -one,
            Err(_) => anchor.fill(0.0),
        }
    }
}

dispatch! {
    /// Sum of the weighted losses of logits.
    fn block_loss(logits: &[f32], signed: &[f32], gradient: &mut [f32]) -> f64 {
        let (logits, rest) = logits.as_chunks::<LANES>();
        let (signed, signed_rest) = signed.as_chunks::<LANES>();
        let (gradient, gradient_rest) = gradient.as_chunks_mut::<LANES>();
        let mut sums = [0.0; LANES];
        for ((logits, signed), gradient) in logits.iter().zip(signed).zip(gradient) {
            for lane in 0..LANES {
                let (loss, slope) = one(logits[lane], signed[lane]);
                sums[lane] += loss;
                gradient[lane] = slope;
            }
        }
        let mut sum = sums.iter().map(|sum| f64::from(*sum)).sum::<f64>();
        for ((logit, signed), gradient) in rest.iter().zip(signed_rest).zip(gradient_rest) {
            let (loss, slope) = one(*logit, *signed);
            sum += f64::from(loss);
            *gradient = slope;
        }
        sum
    }
}

/// The weighted loss of a logit and its derivative.
#[inline(always)]
fn one(logit: f32, signed: f32) -> (f32, f32) {
    let weight = signed.abs();
    let y = if signed < 0.0 { -logit } else { logit };
    let e = exp_of_negative(-y.abs());
    let inverse = 1.0 / (1.0 + e);
    let (s, complement) = if y >= 0.0 {
        (inverse, e * inverse)
    } else {
        (e * inverse, inverse)
    };
    let softplus = (if y > 0.0 { y } else { 0.0 }) + ln_1p(e);
    let square = s * s * weight;
    let (loss, slope) = (square * softplus, square * (2.0 * complement * softplus + s));
    // An ignored anchor gives nothing, even where its logit is not finite.
    let counts = weight > 0.0;
    let slope = if signed < 0.0 { -slope } else { slope };
    (if counts { loss } else { 0.0 }, if counts { slope } else { 0.0 })
}

/// eˣ for x ≤ 0, to 2 units in the last place; 10⁻³⁸ below -87; NaN for NaN.
#[inline(always)]
fn exp_of_negative(x: f32) -> f32 {
    // Adding and taking away 1.5 · 2²³ rounds, and leaves the whole number in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // ln 2 in two parts, the first with zeros at its end so that its products are exact.
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    let x = if x < -87.0 { -87.0 } else { x };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (x - n * LN_2[0]) - n * LN_2[1];
    let mut p = 1.0 / 5040.0;
    for c in [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        p = p * r + c;
    }
    let power = f32::from_bits(shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23);
    p * power
}

/// ln(1 + e) for 0 ≤ e ≤ 1, to 2 units in the last place.
#[inline(always)]
fn ln_1p(e: f32) -> f32 {
    // ln(1 + e) = 2 artanh(e / (2 + e)), of which the series needs seven terms up to 1/3.
    let q = e / (2.0 + e);
    let z = q * q;
    let mut p = 1.0 / 13.0;
    for c in [1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0] {
        p = p * z + c;
    }
    2.0 * q * p
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_and_logarithm_are_those_of_double_precision() {
        for i in 0..200_000 {
            let x = -(i as f32) * 87.0 / 200_000.0;
            let (found, expected) = (f64::from(exp_of_negative(x)), f64::from(x).exp());
            assert!(
                (found / expected - 1.0).abs() < 2.5e-7,
                "exp {x}: {found} for {expected}"
            );
            let e = i as f32 / 199_999.0;
            let (found, expected) = (f64::from(ln_1p(e)), f64::from(e).ln_1p());
            assert!(
                (found - expected).abs() <= 2.5e-7 * expected,
                "ln_1p {e}: {found} for {expected}"
            );
        }
        assert_eq!((exp_of_negative(0.0), ln_1p(0.0)), (1.0, 0.0));
        assert!(exp_of_negative(f32::NAN).is_nan() && ln_1p(f32::NAN).is_nan());
        assert!(exp_of_negative(f32::NEG_INFINITY) < 2e-38);
    }

    #[test]
    fn large_logits_give_finite_losses() {
        for (logit, signed, loss, slope) in [
            (1e4, 1.0, 1e4, 1.0),
            (-1e4, 1.0, 0.0, 0.0),
            (-1e4, -1.0, 1e4, -1.0),
            (1e4, -1.0, 0.0, 0.0),
        ] {
            assert_eq!(one(logit, signed), (loss, slope), "{logit} {signed}");
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let n = 1003;
        let logits: Vec<f32> = (0..n).map(|i| ((i * 7919) % 1000) as f32 * 0.02 - 10.0).collect();
        let signed: Vec<f32> = (0..n).map(|i| [0.75, -0.25, 0.0][i % 3]).collect();
        let (mut here, mut portable) = (vec![0.0; n], vec![0.0; n]);
        let sum = block_loss(&logits, &signed, &mut here);
        assert_eq!(
            sum.to_bits(),
            block_loss::portable(&logits, &signed, &mut portable).to_bits()
        );
        assert_eq!(here, portable);
    }
}

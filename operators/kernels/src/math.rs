//! Functions that have no exact result, from additions and multiplications alone: the same bits on every processor, and
//! loops over them become vectors.

/// The exponential; off by at most 3 parts in 10⁷, 0 below -87.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // Below, the result is no normal number; above, infinity would not come from the bits.
    let x = x.clamp(-87.5, 88.0);
    let rounded = x * std::f32::consts::LOG2_E + ROUND;
    let n = rounded - ROUND;
    // In two steps, the first of which is exact.
    let r = (x - n * 0.693_359_4) - n * -2.121_944_4e-4;
    let tail = 1.0 / 120.0 + r * (1.0 / 720.0);
    let tail = 1.0 / 24.0 + r * tail;
    let tail = 1.0 / 6.0 + r * tail;
    let series = 1.0 + r + r * r * (0.5 + r * tail);
    let exponent = rounded.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127);
    let power = f32::from_bits(exponent << 23);
    if x < -87.0 { 0.0 } else { series * power }
}

/// Added and taken away again, it rounds a small number to the nearest whole one, which the last bits hold in between.
const ROUND: f32 = 12_582_912.0;

/// The error function; off by at most 6e-7 (Abramowitz and Stegun 7.1.26).
#[inline(always)]
pub fn erf(x: f32) -> f32 {
    let a = x.abs();
    let t = 1.0 / (1.0 + 0.327_591_1 * a);
    let series = 1.061_405_4_f32;
    let series = series * t - 1.453_152_1;
    let series = series * t + 1.421_413_8;
    let series = series * t - 0.284_496_74;
    let series = series * t + 0.254_829_6;
    let value = 1.0 - series * t * exp(-a * a);
    if x < 0.0 { -value } else { value }
}

/// Sums that run side by side, so that every width of a vector adds in the same order.
const LANES: usize = 16;

#[inline(always)]
fn lanes(sums: [f32; LANES]) -> f32 {
    // Behind this, compilers cannot spread the tree of additions into the loops that made the lanes.
    let mut sums = std::hint::black_box(sums);
    let mut half = LANES / 2;
    while half > 0 {
        for lane in 0..half {
            sums[lane] += sums[lane + half];
        }
        half /= 2;
    }
    sums[0]
}

/// The sum of products.
#[inline(always)]
pub fn product(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    let (a_lanes, a_rest) = a.as_chunks::<LANES>();
    let (b_lanes, b_rest) = b.as_chunks::<LANES>();
    for (a, b) in a_lanes.iter().zip(b_lanes) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    let sum = if a_lanes.is_empty() { 0.0 } else { lanes(sums) };
    a_rest.iter().zip(b_rest).fold(sum, |sum, (a, b)| sum + a * b)
}

/// The sum.
#[inline(always)]
pub fn sum(a: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    let (all, rest) = a.as_chunks::<LANES>();
    for a in all {
        for (sum, a) in sums.iter_mut().zip(a) {
            *sum += a;
        }
    }
    rest.iter().fold(lanes(sums), |sum, a| sum + a)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_that_of_the_library() {
        for step in -870_000..=880_000 {
            let x = step as f32 * 1e-4;
            let expected = libm::exp(f64::from(x));
            let error = (f64::from(exp(x)) - expected).abs() / expected;
            assert!(error < 3e-7, "exp({x}) is off by {error}");
        }
        assert_eq!((exp(0.0), exp(-1e9), exp(f32::NEG_INFINITY)), (1.0, 0.0, 0.0));
        assert!(exp(1e9).is_finite());
    }

    #[test]
    fn the_error_function_is_that_of_the_library() {
        for step in -60_000..=60_000 {
            let x = step as f32 * 1e-4;
            let error = (f64::from(erf(x)) - libm::erf(f64::from(x))).abs();
            assert!(error < 6e-7, "erf({x}) is off by {error}");
        }
        assert_eq!((erf(20.0), erf(-20.0)), (1.0, -1.0));
    }

    #[test]
    fn sums_are_those_of_all_numbers() {
        let a: Vec<f32> = (0..37).map(|k| k as f32).collect();
        assert_eq!(sum(&a), 666.0);
        assert_eq!(product(&a, &a), (0..37).map(|k| (k * k) as f32).sum::<f32>());
    }
}

//! Sums of rows, each by a weight: what gradients of weights are, and of attention.

/// Adds so many rows, each by its weight.
#[inline(always)]
pub fn add_rows<'a>(count: usize, weight: impl Fn(usize) -> f32, row: impl Fn(usize) -> &'a [f32], to: &mut [f32]) {
    let mut from = 0;
    while from < to.len() {
        let to = &mut to[from..];
        from += match to.len() {
            64.. => add_parts::<64>(count, &weight, &row, from, to),
            32.. => add_parts::<32>(count, &weight, &row, from, to),
            16.. => add_parts::<16>(count, &weight, &row, from, to),
            8.. => add_parts::<8>(count, &weight, &row, from, to),
            _ => add_parts::<1>(count, &weight, &row, from, to),
        };
    }
}

/// Adds so many numbers of rows; returns how many.
#[inline(always)]
fn add_parts<'a, const D: usize>(
    count: usize,
    weight: &impl Fn(usize) -> f32,
    row: &impl Fn(usize) -> &'a [f32],
    from: usize,
    to: &mut [f32],
) -> usize {
    let mut sums = [0.0; D];
    for index in 0..count {
        let weight = weight(index);
        let row = row(index)[from..][..D].iter();
        sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += value * weight);
    }
    to.iter_mut().zip(&sums).for_each(|(to, sum)| *to += sum);
    D
}

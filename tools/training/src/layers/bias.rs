//! Bias, with or without ReLU.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::map::{MapShape, buffer, numbers, tensor, with_numbers};

/// Adds `[channels]` to every cell inside the border of a map.
#[derive(Clone, Copy, Debug)]
pub struct Bias {
    /// Whether what is negative then becomes 0.
    pub relu: bool,
}

impl CustomOp2 for Bias {
    fn name(&self) -> &'static str {
        "bias"
    }

    fn cpu_fwd(&self, x: &CpuStorage, xl: &Layout, b: &CpuStorage, bl: &Layout) -> Result<(CpuStorage, Shape)> {
        let map = MapShape::of(xl.shape())?;
        let (x, bias) = (numbers(x, xl)?, numbers(b, bl)?);
        if bias.len() != map.channels {
            bail!("a bias of {} numbers for {} channels", bias.len(), map.channels);
        }
        let min = if self.relu { 0.0 } else { f32::NEG_INFINITY };
        let mut out = buffer(map.len());
        map.fill_rows(&mut out, |image, row, cells| {
            let from = map.row(x, image, row).chunks_exact(map.channels);
            for (out, x) in cells.chunks_exact_mut(map.channels).zip(from) {
                for ((out, x), b) in out.iter_mut().zip(x).zip(bias) {
                    // Not `max`, which would hide NaN.
                    let sum = x + b;
                    *out = if sum < min { min } else { sum };
                }
            }
        });
        Ok((CpuStorage::F32(out), map.dims()))
    }

    fn bwd(&self, x: &Tensor, b: &Tensor, out: &Tensor, grad: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let map = MapShape::of(x.shape())?;
        let relu = self.relu;
        let dx = if relu {
            let mut dx = buffer(map.len());
            with_numbers(grad, |grad| {
                with_numbers(out, |out| {
                    map.fill_rows(&mut dx, |image, row, cells| {
                        let (grad, out) = (map.row(grad, image, row), map.row(out, image, row));
                        for ((dx, g), out) in cells.iter_mut().zip(grad).zip(out) {
                            *dx = let_through(*out, *g);
                        }
                    });
                    Ok(())
                })
            })?;
            tensor(dx, map.dims())?
        } else {
            grad.clone()
        };
        let db = with_numbers(&dx, |dx| {
            Ok(channel_sums(&map, |image, row, sum| {
                for cell in map.row(dx, image, row).chunks_exact(map.channels) {
                    sum.iter_mut().zip(cell).for_each(|(sum, value)| *sum += value);
                }
            }))
        })?;
        let db: Vec<f32> = db.iter().map(|v| *v as f32).collect();
        Ok((Some(dx), Some(tensor(db, b.shape().clone())?)))
    }
}

/// Sums of a row in single precision, of rows in double, in a fixed order.
pub(crate) fn channel_sums(map: &MapShape, add: impl Fn(usize, usize, &mut [f32]) + Sync) -> Vec<f64> {
    sums(map, map.channels, add)
}

/// What a ReLU with this result lets through of a gradient. By a mask: half of the results are zero, and which ones no branch
/// foresees.
#[inline]
pub(super) fn let_through(out: f32, grad: f32) -> f32 {
    f32::from_bits(grad.to_bits() & u32::from(out > 0.0).wrapping_neg())
}

/// As [`channel_sums`], of `width` numbers.
pub(crate) fn sums(map: &MapShape, width: usize, add: impl Fn(usize, usize, &mut [f32]) + Sync) -> Vec<f64> {
    let rows: Vec<Vec<f32>> = (0..map.batch * map.rows)
        .into_par_iter()
        .map(|row| {
            let mut sum = vec![0.0; width];
            add(row / map.rows, row % map.rows, &mut sum);
            sum
        })
        .collect();
    let mut total = vec![0.0; width];
    for row in rows {
        total
            .iter_mut()
            .zip(row)
            .for_each(|(total, value)| *total += f64::from(value));
    }
    total
}

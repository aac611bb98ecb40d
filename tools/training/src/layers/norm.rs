//! Batch norm with ReLU.

use std::sync::{Arc, OnceLock};

use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use realo_nn::weights::BATCH_NORM_EPS;

use super::bias::{let_through, sums};
use super::map::{MapShape, buffer, numbers, tensor, with_numbers};

/// Mean and variance of each channel.
#[derive(Clone, Debug, PartialEq)]
pub struct Moments {
    /// Means.
    pub mean: Vec<f32>,
    /// Variances about them, divided by the count.
    pub variance: Vec<f32>,
    /// Numbers of each channel that they were taken from.
    pub count: usize,
}

/// Which mean and variance a batch norm takes.
#[derive(Clone, Debug)]
pub enum Statistics {
    /// The batch's own; they are left here for the running statistics.
    Batch(Arc<OnceLock<Moments>>),
    /// Those of training.
    Running(Moments),
}

impl Statistics {
    /// To be filled by a batch.
    pub fn batch() -> Self {
        Statistics::Batch(Arc::default())
    }

    /// What was used; `None` before the forward pass.
    pub fn moments(&self) -> Option<&Moments> {
        match self {
            Statistics::Batch(moments) => moments.get(),
            Statistics::Running(moments) => Some(moments),
        }
    }
}

/// `max(0, (x - mean) / sqrt(variance + eps) * weight + bias)` over the cells inside the border of a map; eps is 1e-3.
#[derive(Clone, Debug)]
pub struct Norm {
    /// Where mean and variance come from.
    pub statistics: Statistics,
}

impl CustomOp3 for Norm {
    fn name(&self) -> &'static str {
        "batch norm and ReLU"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        xl: &Layout,
        w: &CpuStorage,
        wl: &Layout,
        b: &CpuStorage,
        bl: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let map = MapShape::of(xl.shape())?;
        let (x, weight, bias) = (numbers(x, xl)?, numbers(w, wl)?, numbers(b, bl)?);
        if weight.len() != map.channels || bias.len() != map.channels {
            bail!(
                "batch norm of {} and {} numbers for {} channels",
                weight.len(),
                bias.len(),
                map.channels
            );
        }
        let moments = match &self.statistics {
            Statistics::Batch(own) => own.get_or_init(|| moments_of(x, &map)),
            Statistics::Running(moments) => moments,
        };
        let (scale, shift) = moments.affine(weight, bias);
        let mut out = buffer(map.len());
        map.fill_rows(&mut out, |image, row, cells| {
            let from = map.row(x, image, row).chunks_exact(map.channels);
            for (out, x) in cells.chunks_exact_mut(map.channels).zip(from) {
                for (((out, x), scale), shift) in out.iter_mut().zip(x).zip(&scale).zip(&shift) {
                    // Not `max`, which would hide NaN.
                    let value = x * scale + shift;
                    *out = if value < 0.0 { 0.0 } else { value };
                }
            }
        });
        Ok((CpuStorage::F32(out), map.dims()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let map = MapShape::of(x.shape())?;
        let Some(moments) = self.statistics.moments() else {
            bail!("batch norm: the backward pass came before the forward pass");
        };
        let fixed = matches!(self.statistics, Statistics::Running(_));
        let (dx, dw, db) = with_numbers(x, |x| {
            with_numbers(out, |out| {
                with_numbers(grad, |grad| {
                    with_numbers(weight, |weight| {
                        Ok(gradients(&map, moments, fixed, [x, out, grad, weight]))
                    })
                })
            })
        })?;
        let c = map.channels;
        Ok((
            Some(tensor(dx, map.dims())?),
            Some(tensor(dw, c)?),
            Some(tensor(db, c)?),
        ))
    }
}

impl Moments {
    /// 1 / sqrt(variance + eps).
    pub(crate) fn inverse(&self) -> Vec<f32> {
        self.variance
            .iter()
            .map(|v| 1.0 / (v + BATCH_NORM_EPS).sqrt())
            .collect()
    }

    /// The batch norm as factor and summand.
    pub(crate) fn affine(&self, weight: &[f32], bias: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let scale: Vec<f32> = self
            .inverse()
            .iter()
            .zip(weight)
            .map(|(inverse, w)| inverse * w)
            .collect();
        let shift = scale
            .iter()
            .zip(&self.mean)
            .zip(bias)
            .map(|((scale, mean), b)| b - mean * scale);
        let shift = shift.collect();
        (scale, shift)
    }
}

fn moments_of(x: &[f32], map: &MapShape) -> Moments {
    let c = map.channels;
    // Differences to one cell keep the digits of a variance that is small beside the mean.
    let origin = &map.row(x, 0, map.rows / 2)[map.columns / 2 * c..][..c];
    let total = sums(map, 2 * c, |image, row, sum| {
        let (sum, squares) = sum.split_at_mut(c);
        for cell in map.row(x, image, row).chunks_exact(c) {
            for (((x, origin), sum), square) in cell.iter().zip(origin).zip(&mut *sum).zip(&mut *squares) {
                let value = x - origin;
                *sum += value;
                *square += value * value;
            }
        }
    });
    let count = map.cells() as f64;
    let (sum, squares) = total.split_at(c);
    let pairs = sum.iter().zip(squares).zip(origin);
    let (mean, variance) = pairs
        .map(|((sum, square), origin)| {
            let mean = sum / count;
            (
                (mean + f64::from(*origin)) as f32,
                (square / count - mean * mean).max(0.0) as f32,
            )
        })
        .unzip();
    Moments {
        mean,
        variance,
        count: map.cells(),
    }
}

/// Gradients of x, weight, bias. With fixed statistics, mean and variance do not depend on x.
fn gradients(
    map: &MapShape,
    moments: &Moments,
    fixed: bool,
    [x, out, grad, weight]: [&[f32]; 4],
) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let c = map.channels;
    let (mean, inverse) = (&moments.mean, moments.inverse());
    let total = sums(map, 2 * c, |image, row, sum| {
        let (plain, weighted) = sum.split_at_mut(c);
        let cells = map.row(x, image, row).chunks_exact(c);
        let rest = map
            .row(out, image, row)
            .chunks_exact(c)
            .zip(map.row(grad, image, row).chunks_exact(c));
        for (x, (out, grad)) in cells.zip(rest) {
            let (plain, weighted) = (&mut plain[..c], &mut weighted[..c]);
            let (x, out, grad, mean) = (&x[..c], &out[..c], &grad[..c], &mean[..c]);
            for i in 0..c {
                let g = let_through(out[i], grad[i]);
                plain[i] += g;
                weighted[i] += g * (x[i] - mean[i]);
            }
        }
    });
    let db: Vec<f32> = total[..c].iter().map(|v| *v as f32).collect();
    let dw: Vec<f32> = total[c..]
        .iter()
        .zip(&inverse)
        .map(|(v, inverse)| (*v * f64::from(*inverse)) as f32)
        .collect();
    // dx = scale * (g - db / n - xhat * dw / n) = scale * g + slope * x + offset
    let n = if fixed { f64::INFINITY } else { map.cells() as f64 };
    let (mut scale, mut slope, mut offset) = (vec![0.0; c], vec![0.0; c], vec![0.0; c]);
    for i in 0..c {
        scale[i] = weight[i] * inverse[i];
        slope[i] = -scale[i] * inverse[i] * (f64::from(dw[i]) / n) as f32;
        offset[i] = -scale[i] * (total[i] / n) as f32 - slope[i] * mean[i];
    }
    let mut dx = buffer(map.len());
    map.fill_rows(&mut dx, |image, row, cells| {
        let from = map
            .row(x, image, row)
            .chunks_exact(c)
            .zip(map.row(out, image, row).chunks_exact(c));
        let grads = map.row(grad, image, row).chunks_exact(c);
        for ((dx, (x, out)), grad) in cells.chunks_exact_mut(c).zip(from).zip(grads) {
            let (x, out, grad) = (&x[..c], &out[..c], &grad[..c]);
            let (scale, slope, offset) = (&scale[..c], &slope[..c], &offset[..c]);
            for i in 0..c {
                let g = let_through(out[i], grad[i]);
                dx[i] = scale[i] * g + slope[i] * x[i] + offset[i];
            }
        }
    });
    (dx, dw, db)
}

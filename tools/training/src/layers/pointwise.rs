//! Transposed convolution with kernel = stride, and 1x1 convolution, which is its simplest case; without bias.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::map::{MapShape, buffer, numbers, tensor, with_numbers};
use super::product::{Arithmetic, View, multiply};

/// Parts of the weight gradient's sum, for each image.
const PARTS: usize = 4;

/// Order of the dimensions of weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WeightOrder {
    /// `[in, out, k, k]`: a transposed convolution that enlarges the map by k.
    Transposed,
    /// `[out, in, 1, 1]`: a 1x1 convolution.
    Plain,
}

/// Every cell becomes `factor` x `factor` cells, each by weights of its own.
#[derive(Clone, Copy, Debug)]
pub struct Pointwise {
    /// How the weights lie.
    pub order: WeightOrder,
    /// Of its products.
    pub arithmetic: Arithmetic,
}

impl CustomOp2 for Pointwise {
    fn name(&self) -> &'static str {
        "pointwise"
    }

    fn cpu_fwd(&self, x: &CpuStorage, xl: &Layout, w: &CpuStorage, wl: &Layout) -> Result<(CpuStorage, Shape)> {
        let shapes = Shapes::new(xl.shape(), wl.shape(), self)?;
        let (x, w) = (numbers(x, xl)?, shapes.pack(numbers(w, wl)?));
        let mut out = buffer(shapes.output.len());
        shapes.forward(&mut out, x, &w);
        Ok((CpuStorage::F32(out), shapes.output.dims()))
    }

    fn bwd(&self, x: &Tensor, w: &Tensor, _: &Tensor, grad: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let shapes = Shapes::new(x.shape(), w.shape(), self)?;
        with_numbers(grad, |grad| {
            let packed = with_numbers(w, |w| Ok(shapes.pack(w)))?;
            let dx = shapes.input_gradient(grad, &packed);
            let dw = with_numbers(x, |x| Ok(shapes.weight_gradient(x, grad)))?;
            Ok((
                Some(tensor(dx, shapes.input.dims())?),
                Some(tensor(dw, w.shape().clone())?),
            ))
        })
    }
}

struct Shapes {
    input: MapShape,
    output: MapShape,
    factor: usize,
    order: WeightOrder,
    arithmetic: Arithmetic,
}

impl Shapes {
    fn new(x: &Shape, w: &Shape, Pointwise { order, arithmetic }: &Pointwise) -> Result<Self> {
        let (order, arithmetic) = (*order, *arithmetic);
        let input = MapShape::of(x)?;
        let (first, second, factor, width) = w.dims4()?;
        let (within, out) = match order {
            WeightOrder::Transposed => (first, second),
            WeightOrder::Plain => (second, first),
        };
        if within != input.channels || factor != width || (order == WeightOrder::Plain && factor != 1) {
            bail!(
                "{order:?} pointwise layer on {} channels: found weights {:?}",
                input.channels,
                w.dims()
            );
        }
        let output = MapShape {
            rows: input.rows * factor,
            columns: input.columns * factor,
            channels: out,
            ..input
        };
        Ok(Shapes {
            input,
            output,
            factor,
            order,
            arithmetic,
        })
    }

    /// Numbers of a cell's `factor` successors in one row.
    fn span(&self) -> usize {
        self.factor * self.output.channels
    }

    /// Place of a weight for cell (dy, dx) of the enlarged square in a tensor of weights.
    fn place(&self, i: usize, o: usize, dy: usize, dx: usize) -> usize {
        match self.order {
            WeightOrder::Transposed => ((i * self.output.channels + o) * self.factor + dy) * self.factor + dx,
            WeightOrder::Plain => o * self.input.channels + i,
        }
    }

    /// `[factor (dy)][in][factor (dx) * out]`.
    fn pack(&self, w: &[f32]) -> Vec<f32> {
        let (f, outs) = (self.factor, self.output.channels);
        let mut packed = Vec::with_capacity(w.len());
        for dy in 0..f {
            for i in 0..self.input.channels {
                for dx in 0..f {
                    packed.extend((0..outs).map(|o| w[self.place(i, o, dy, dx)]));
                }
            }
        }
        packed
    }

    fn forward(&self, out: &mut [f32], x: &[f32], packed: &[f32]) {
        let (ins, span) = (self.input.channels, self.span());
        self.output.fill_rows(out, |image, row, cells| {
            let a = View::rows(self.input.row(x, image, row / self.factor), ins);
            let b = View::rows(&packed[row % self.factor * ins * span..], span);
            let size = [self.input.columns, ins, span];
            multiply(self.arithmetic, cells, span, a, b, size, false);
        });
    }

    fn input_gradient(&self, grad: &[f32], packed: &[f32]) -> Vec<f32> {
        let (ins, span) = (self.input.channels, self.span());
        let mut dx = buffer(self.input.len());
        // `[factor (dy)][factor (dx) * out][in]`, whose rows are contiguous.
        let mut turned = Vec::with_capacity(packed.len());
        for packed in packed.chunks(ins * span) {
            for o in 0..span {
                turned.extend(packed.iter().skip(o).step_by(span));
            }
        }
        self.input.fill_rows(&mut dx, |image, row, cells| {
            for dy in 0..self.factor {
                let a = View::rows(self.output.row(grad, image, row * self.factor + dy), span);
                let b = View::rows(&turned[dy * ins * span..], ins);
                let size = [self.input.columns, span, ins];
                multiply(self.arithmetic, cells, ins, a, b, size, dy > 0);
            }
        });
        dx
    }

    fn weight_gradient(&self, x: &[f32], grad: &[f32]) -> Vec<f32> {
        let (ins, span, rows) = (self.input.channels, self.span(), self.input.rows);
        let size = self.factor * ins * span;
        let slices: Vec<(usize, usize, usize)> = (0..self.input.batch)
            .flat_map(|image| (0..PARTS).map(move |part| (image, rows * part / PARTS, rows * (part + 1) / PARTS)))
            .collect();
        let sums: Vec<Vec<f32>> = slices
            .par_iter()
            .map(|&(image, from, to)| {
                let mut sum = vec![0.0; size];
                for row in from..to {
                    let a = View::columns(self.input.row(x, image, row), ins);
                    for (dy, sum) in sum.chunks_mut(ins * span).enumerate() {
                        let b = View::rows(self.output.row(grad, image, row * self.factor + dy), span);
                        let size = [ins, self.input.columns, span];
                        multiply(self.arithmetic, sum, span, a, b, size, true);
                    }
                }
                sum
            })
            .collect();
        let mut dw = vec![0.0; size];
        let outs = self.output.channels;
        for at in 0..size {
            let (dy, i, dx, o) = (at / (ins * span), at / span % ins, at % span / outs, at % outs);
            dw[self.place(i, o, dy, dx)] = sums.iter().map(|sum| sum[at]).sum();
        }
        dw
    }
}

//! 3x3 convolution with a border of one cell and stride 1 or 2, without bias.

use candle_core::{CpuStorage, CustomOp2, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::map::{MapShape, buffer, numbers, tensor, with_numbers};
use super::product::{Arithmetic, View, multiply};

/// Smallest cells of one product: enough that packing the weights anew for it costs little.
const BAND: usize = 512;

/// Parts of the weight gradient's sum.
const PARTS: usize = 4;

/// Convolution of a map `[batch, rows + 2, columns + 2, in]` by weights `[out, in, 3, 3]`.
///
/// A kernel row of a window is 3 `in` contiguous numbers of the map, so each is one product of overlapping rows.
#[derive(Clone, Copy, Debug)]
pub struct Conv {
    /// 1 or 2.
    pub stride: usize,
    /// Of its products.
    pub arithmetic: Arithmetic,
}

impl CustomOp2 for Conv {
    fn name(&self) -> &'static str {
        "conv3x3"
    }

    fn cpu_fwd(&self, x: &CpuStorage, xl: &Layout, w: &CpuStorage, wl: &Layout) -> Result<(CpuStorage, Shape)> {
        let shapes = Shapes::new(xl.shape(), wl.shape(), self)?;
        let kernel = Kernel::forward(numbers(w, wl)?, &shapes);
        let mut out = buffer(shapes.output.len());
        convolve(&mut out, numbers(x, xl)?, &kernel, &shapes);
        Ok((CpuStorage::F32(out), shapes.output.dims()))
    }

    fn bwd(&self, x: &Tensor, w: &Tensor, _: &Tensor, grad: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let shapes = Shapes::new(x.shape(), w.shape(), self)?;
        with_numbers(grad, |grad| {
            let dx = with_numbers(w, |w| Ok(input_gradient(grad, w, &shapes)))?;
            let dw = with_numbers(x, |x| Ok(weight_gradient(x, grad, &shapes)))?;
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
    stride: usize,
    arithmetic: Arithmetic,
}

impl Shapes {
    fn new(x: &Shape, w: &Shape, Conv { stride, arithmetic }: &Conv) -> Result<Self> {
        let (stride, arithmetic) = (*stride, *arithmetic);
        let input = MapShape::of(x)?;
        let (out, within, height, width) = w.dims4()?;
        if within != input.channels || (height, width) != (3, 3) || !(1..=2).contains(&stride) {
            bail!(
                "conv3x3: expected weights [out, {}, 3, 3] and a stride of 1 or 2, found {:?} and {stride}",
                input.channels,
                w.dims()
            );
        }
        let output = MapShape {
            rows: input.rows.div_ceil(stride),
            columns: input.columns.div_ceil(stride),
            channels: out,
            ..input
        };
        Ok(Shapes {
            input,
            output,
            stride,
            arithmetic,
        })
    }

    /// The stride-1 convolution that leads gradients back.
    fn reversed(&self) -> Shapes {
        Shapes {
            input: self.output,
            output: self.input,
            stride: 1,
            arithmetic: self.arithmetic,
        }
    }
}

/// Weights as three matrices, one for each kernel row: `[3][3 * in][out]`.
struct Kernel {
    data: Vec<f32>,
}

impl Kernel {
    fn packed(outs: usize, ins: usize, weight: impl Fn(usize, usize, usize, usize) -> f32) -> Self {
        let mut data = Vec::with_capacity(9 * ins * outs);
        for ky in 0..3 {
            for kx in 0..3 {
                for i in 0..ins {
                    data.extend((0..outs).map(|o| weight(o, i, ky, kx)));
                }
            }
        }
        Kernel { data }
    }

    fn forward(w: &[f32], shapes: &Shapes) -> Self {
        let (ins, outs) = (shapes.input.channels, shapes.output.channels);
        Kernel::packed(outs, ins, |o, i, ky, kx| w[(o * ins + i) * 9 + ky * 3 + kx])
    }

    /// Turned by 180 degrees, inputs and outputs exchanged.
    fn turned(w: &[f32], shapes: &Shapes) -> Self {
        let (ins, outs) = (shapes.input.channels, shapes.output.channels);
        Kernel::packed(ins, outs, |i, o, ky, kx| w[(o * ins + i) * 9 + (2 - ky) * 3 + (2 - kx)])
    }

    fn row(&self, ky: usize) -> &[f32] {
        let len = self.data.len() / 3;
        &self.data[ky * len..][..len]
    }

    /// The matrices of columns `kx..` of a kernel row.
    fn from(&self, ky: usize, kx: usize) -> &[f32] {
        let len = self.data.len() / 9;
        &self.data[(ky * 3 + kx) * len..]
    }
}

fn convolve(out: &mut [f32], x: &[f32], kernel: &Kernel, shapes: &Shapes) {
    match shapes.stride {
        1 => convolve_bands(out, x, kernel, shapes),
        _ => convolve_rows(out, x, kernel, shapes),
    }
}

/// Stride 1: several rows at once; what falls on the border between two rows is set to 0 afterwards.
fn convolve_bands(out: &mut [f32], x: &[f32], kernel: &Kernel, shapes: &Shapes) {
    let Shapes { input, output, .. } = shapes;
    let (ins, outs, pitch) = (input.channels, output.channels, output.pitch());
    let band = BAND.div_ceil(output.columns).min(output.rows);
    let bands = output.rows.div_ceil(band);
    let mut jobs: Vec<(usize, usize, &mut [f32])> = Vec::with_capacity(output.batch * bands);
    for (image, map) in out.chunks_mut(output.image()).enumerate() {
        let (top, rest) = map.split_at_mut(pitch);
        let (middle, bottom) = rest.split_at_mut(output.rows * pitch);
        top.fill(0.0);
        bottom.fill(0.0);
        jobs.extend(
            middle
                .chunks_mut(band * pitch)
                .enumerate()
                .map(|(i, rows)| (image, i * band, rows)),
        );
    }
    jobs.into_par_iter().for_each(|(image, first, rows)| {
        let cells = rows.len() / outs - 2;
        for ky in 0..3 {
            let from = input.at(image, (first + ky) as isize - 1, -1);
            let (a, b) = (View::rows(&x[from..], ins), View::rows(kernel.row(ky), outs));
            let size = [cells, 3 * ins, outs];
            multiply(shapes.arithmetic, &mut rows[outs..], outs, a, b, size, ky > 0);
        }
        for row in rows.chunks_mut(pitch) {
            row[..outs].fill(0.0);
            row[pitch - outs..].fill(0.0);
        }
    });
}

fn convolve_rows(out: &mut [f32], x: &[f32], kernel: &Kernel, shapes: &Shapes) {
    let Shapes {
        input, output, stride, ..
    } = shapes;
    let (ins, outs) = (input.channels, output.channels);
    output.fill_rows(out, |image, row, cells| {
        for ky in 0..3 {
            let from = input.at(image, (row * stride + ky) as isize - 1, -1);
            let (a, b) = (View::rows(&x[from..], stride * ins), View::rows(kernel.row(ky), outs));
            let size = [output.columns, 3 * ins, outs];
            multiply(shapes.arithmetic, cells, outs, a, b, size, ky > 0);
        }
    });
}

fn input_gradient(grad: &[f32], w: &[f32], shapes: &Shapes) -> Vec<f32> {
    let kernel = Kernel::turned(w, shapes);
    let mut dx = buffer(shapes.input.len());
    match shapes.stride {
        1 => convolve_bands(&mut dx, grad, &kernel, &shapes.reversed()),
        _ => spread_rows(&mut dx, grad, &kernel, shapes),
    }
    dx
}

/// Stride 2. Input (2r + i, 2c + j) was seen by the centre of window (r, c) for i = j = 0; an odd one lies between two
/// windows, and their gradients are neighbours in memory.
fn spread_rows(dx: &mut [f32], grad: &[f32], kernel: &Kernel, shapes: &Shapes) {
    let Shapes { input, output, .. } = shapes;
    let (ins, outs) = (input.channels, output.channels);
    input.fill_rows(dx, |image, y, cells| {
        // In the turned kernel, row 0 belongs to the window above, 2 to the one below; row 1 is the centre.
        let (above, below) = (y / 2, y / 2 + 1);
        let rows: &[(usize, usize)] = match y % 2 {
            0 => &[(above, 1)],
            _ => &[(above, 0), (below, 2)],
        };
        let mut first = true;
        for &(row, ky) in rows.iter().filter(|(row, _)| *row < output.rows) {
            let from = output.at(image, row as isize, 0);
            let even = output.columns;
            let (a, b) = (View::rows(&grad[from..], outs), View::rows(kernel.from(ky, 1), ins));
            multiply(shapes.arithmetic, cells, 2 * ins, a, b, [even, outs, ins], !first);
            let odd = input.columns / 2;
            // Columns 0 and 2 of the turned kernel, one above the other.
            let sides = [&kernel.from(ky, 0)[..outs * ins], &kernel.from(ky, 2)[..outs * ins]];
            for (side, matrix) in sides.into_iter().enumerate() {
                let a = View::rows(&grad[from + side * outs..], outs);
                if odd > 0 {
                    let (b, size) = (View::rows(matrix, ins), [odd, outs, ins]);
                    let add = !first || side > 0;
                    multiply(shapes.arithmetic, &mut cells[ins..], 2 * ins, a, b, size, add);
                }
            }
            first = false;
        }
    });
}

fn weight_gradient(x: &[f32], grad: &[f32], shapes: &Shapes) -> Vec<f32> {
    let (ins, outs) = (shapes.input.channels, shapes.output.channels);
    let (batch, rows) = (shapes.output.batch, shapes.output.rows);
    // (image, rows) of each part.
    let slices: Vec<(usize, usize, usize)> = (0..batch)
        .flat_map(|image| (0..PARTS).map(move |part| (image, rows * part / PARTS, rows * (part + 1) / PARTS)))
        .collect();
    let sums: Vec<Vec<f32>> = slices
        .par_iter()
        .map(|&(image, from, to)| {
            let mut sum = vec![0.0; 9 * ins * outs];
            if to > from {
                weight_gradient_of(&mut sum, x, grad, shapes, image, from..to);
            }
            sum
        })
        .collect();
    let mut dw = vec![0.0; 9 * ins * outs];
    dw.par_chunks_mut(9 * ins).enumerate().for_each(|(o, dw)| {
        for (at, value) in dw.iter_mut().enumerate() {
            let (i, k) = (at / 9, at % 9);
            *value = sums.iter().map(|sum| sum[(k * ins + i) * outs + o]).sum();
        }
    });
    dw
}

/// Adds what some rows of an image contribute, `[3][3 * in][out]`.
fn weight_gradient_of(
    sum: &mut [f32],
    x: &[f32],
    grad: &[f32],
    shapes: &Shapes,
    image: usize,
    rows: std::ops::Range<usize>,
) {
    let Shapes {
        input, output, stride, ..
    } = shapes;
    let (ins, outs) = (input.channels, output.channels);
    // With stride 1 the border between two rows may take part: its gradient is 0.
    let (step, cells) = match stride {
        1 => (rows.len(), (rows.len() - 1) * (output.columns + 2) + output.columns),
        _ => (1, output.columns),
    };
    for row in rows.step_by(step) {
        let g = &grad[output.at(image, row as isize, 0)..];
        for (ky, sum) in sum.chunks_mut(3 * ins * outs).enumerate() {
            let from = input.at(image, (row * stride + ky) as isize - 1, -1);
            let a = View::columns(&x[from..], stride * ins);
            let size = [3 * ins, cells, outs];
            multiply(shapes.arithmetic, sum, outs, a, View::rows(g, outs), size, true);
        }
    }
}

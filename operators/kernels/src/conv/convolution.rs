//! What a convolution is.

/// A convolution with bias on a map padded with zeros so that stride 1 keeps its size, or a transposed one that enlarges
/// the map by `stride` (kernel = stride, no padding).
#[derive(Clone, Debug, PartialEq)]
pub struct Convolution {
    /// Channels that it reads.
    pub inputs: usize,
    /// Channels that it gives.
    pub outputs: usize,
    /// Side of the kernel: 1 or 3, or the stride if transposed.
    pub kernel: usize,
    /// Cells from one window to the next, or the factor of enlargement.
    pub stride: usize,
    /// Whether it enlarges the map.
    pub transposed: bool,
    /// Whether negative results become zero.
    pub relu: bool,
    /// `[outputs, inputs, kernel, kernel]`, or `[inputs, outputs, kernel, kernel]` if transposed.
    pub weights: Vec<f32>,
    /// One for each output.
    pub bias: Vec<f32>,
}

impl Convolution {
    /// Rows or columns of the result from those of the input.
    pub fn size(&self, input: usize) -> usize {
        match self.transposed {
            true => input * self.stride,
            false => input.div_ceil(self.stride),
        }
    }

    /// The largest weight of each output, without its sign.
    pub fn max_weights(&self) -> impl Iterator<Item = f32> {
        let taps = self.kernel * self.kernel;
        (0..self.outputs).map(move |output| {
            let weights = (0..self.inputs * taps).map(|i| {
                let (input, tap) = (i / taps, i % taps);
                self.weight(output, input, tap / self.kernel, tap % self.kernel).abs()
            });
            weights.fold(0.0, f32::max)
        })
    }

    pub fn weight(&self, output: usize, input: usize, row: usize, column: usize) -> f32 {
        let (major, minor, minors) = match self.transposed {
            true => (input, output, self.outputs),
            false => (output, input, self.inputs),
        };
        self.weights[((major * minors + minor) * self.kernel + row) * self.kernel + column]
    }
}

//! Agents' maps in the ego's cells.
//!
//! This samples as `realo-kernels` does, but by operations on tensors: they run on a GPU, and gradients flow through them.

use candle_core::{Result, Tensor};
use realo_kernels::warp::Warp;

/// Added to a score or a feature where an agent takes no part: no other is less, and no sum overflows.
const NOT_THERE: f64 = 1e30;

/// An agent's map in the ego's cells.
#[derive(Clone, Debug)]
pub struct Placed {
    /// `[rows, columns, channels]`: bilinear between the cells around each place, zeros beyond the agent's own map.
    pub map: Tensor,
    /// `[rows, columns, 1]`: what the agent's map would be if it were 1 everywhere.
    pub reach: Tensor,
    /// `[rows, columns, 1]`: 1 where the agent takes part, since the nearest cell is one of its map; else 0.
    pub covered: Tensor,
}

impl Placed {
    /// Brings a map, `[rows, columns, channels]` in f32, to the ego's cells, as many as it has itself; of one that reports its
    /// confidence, the cells that are there.
    ///
    /// # Errors
    /// Those of candle.
    pub fn new(map: &Tensor, warp: &Warp, confidence: Option<&[f32]>) -> Result<Self> {
        let (rows, columns, channels) = map.dims3()?;
        let device = map.device();
        let ones = || Tensor::ones((rows, columns, 1), map.dtype(), device);
        if *warp == Warp::IDENTITY && confidence.is_none() {
            return Ok(Placed {
                map: map.clone(),
                reach: ones()?,
                covered: ones()?,
            });
        }
        let Sampling {
            corners,
            reach,
            covered,
        } = Sampling::new(warp, [rows, columns], confidence);
        let cells = map.reshape((rows * columns, channels))?;
        let [first, rest @ ..] = corners;
        let mut sum = first.of(&cells)?;
        for corner in rest {
            sum = (sum + corner.of(&cells)?)?;
        }
        let plane = |numbers: Vec<f32>| Tensor::from_vec(numbers, (rows, columns, 1), device);
        Ok(Placed {
            map: sum.reshape((rows, columns, channels))?,
            reach: plane(reach)?,
            covered: plane(covered)?,
        })
    }

    /// `[rows, columns, 1]`: 0 where the agent takes part, else what makes nobody look at it.
    pub fn absence(&self) -> Result<Tensor> {
        self.covered.affine(NOT_THERE, -NOT_THERE)
    }
}

/// Where the ego's cells lie in another map, from the exact places: computed on the host in f64.
struct Sampling {
    corners: [Corner; 4],
    reach: Vec<f32>,
    covered: Vec<f32>,
}

/// For each of the ego's cells one cell of the other map, and its weight.
#[derive(Default)]
struct Corner {
    cells: Vec<u32>,
    weights: Vec<f32>,
}

impl Corner {
    fn of(self, cells: &Tensor) -> Result<Tensor> {
        let (count, device) = (self.cells.len(), cells.device());
        let taken = cells.index_select(&Tensor::from_vec(self.cells, count, device)?, 0)?;
        taken.broadcast_mul(&Tensor::from_vec(self.weights, (count, 1), device)?)
    }
}

impl Sampling {
    fn new(warp: &Warp, [rows, columns]: [usize; 2], confidence: Option<&[f32]>) -> Self {
        let mut sampling = Sampling {
            corners: Default::default(),
            reach: Vec::new(),
            covered: Vec::new(),
        };
        let index = |[x, y]: [f64; 2]| y as usize * columns + x as usize;
        let is_there = |cell: [f64; 2]| confidence.is_none_or(|confidence| confidence[index(cell)] > 0.0);
        let inside = |[x, y]: [f64; 2]| (0.0..columns as f64).contains(&x) && (0.0..rows as f64).contains(&y);
        for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
            let place = warp.at(column, row);
            let first = place.map(f64::floor);
            let nearest = place.map(f64::round_ties_even);
            let covered = inside(nearest) && is_there(nearest);
            let corners = [0, 1, 2, 3].map(|corner| {
                let cell = [first[0] + (corner % 2) as f64, first[1] + (corner / 2) as f64];
                let part = |axis: usize| 1.0 - (place[axis] - cell[axis]).abs();
                match inside(cell) && is_there(cell) {
                    true => (index(cell), part(0) * part(1)),
                    false => (0, 0.0),
                }
            });
            let reach: f64 = corners.iter().map(|(_, weight)| weight).sum();
            let factor = match confidence {
                None => 1.0,
                Some(_) if covered => 1.0 / reach,
                Some(_) => 0.0,
            };
            for (to, (cell, weight)) in sampling.corners.iter_mut().zip(corners) {
                to.cells.push(cell as u32);
                to.weights.push((factor * weight) as f32);
            }
            sampling.reach.push((factor * reach) as f32);
            sampling.covered.push(if covered { 1.0 } else { 0.0 });
        }
        sampling
    }
}

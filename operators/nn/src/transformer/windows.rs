//! Attention within windows of a map, of several sizes, and how much each of them counts.

use super::{Norm, normalized};
use crate::arch::Window;
use crate::cells::{Linear, cells, each_cell, run};
use crate::conv::{Map, Pool, Rows, View, split};
use crate::math::{exp, product, sum};
use crate::part::Number;
use crate::simd::dispatch;

pub(super) struct OverWindows<E> {
    pub norm: Norm,
    pub windows: Vec<Within<E>>,
    pub split: Split,
}

pub(super) struct Within<E> {
    pub window: Window,
    /// `[2 side - 1, 2 side - 1]`, by the offset from who asks to who is asked.
    pub positions: Vec<f32>,
    pub all: Linear<E>,
    pub output: Linear<E>,
}

/// How much each attention over windows counts, by channel.
pub(super) struct Split {
    pub first: Vec<f32>,
    pub norm: Norm,
    pub second: Vec<f32>,
}

impl<E: Number> OverWindows<E> {
    pub fn run(&self, map: &mut Map<f32>, pool: &mut Pool) {
        let normed: Map<E> = self.norm.run(map, pool);
        self.add(&normed, map, pool);
    }

    /// Adds what all windows give; without the norm.
    pub fn add(&self, normed: &Map<E>, to: &mut Map<f32>, pool: &mut Pool) {
        let within = self.windows.iter().map(|within| within.run(normed, to.channels, pool));
        let made: Vec<Map<f32>> = within.collect();
        self.split.add(&made, to, pool);
    }
}

impl<E: Number> Within<E> {
    /// Without the norm.
    pub fn run(&self, normed: &Map<E>, channels: usize, pool: &mut Pool) -> Map<f32> {
        let (side, width) = (self.window.side, self.window.width());
        let all = run(&self.all, normed, 3 * width, pool);
        let view = all.view();
        let mut attended: Map<E> = Map::new(normed.rows, normed.columns, width);
        let (length, stored, columns) = (attended.row_length(), attended.stored, attended.columns);
        pool.each(attended.shares(pool.threads(), side), |Rows { range, data }| {
            let mut made = vec![0.0; side * columns * width];
            for (band, to) in range.step_by(side).zip(data.chunks_exact_mut(side * length)) {
                let start = (band + view.border) * view.line();
                let rows = &view.data[start..start + side * view.line()];
                attend(self.window, rows, &self.positions, columns, &mut made);
                for (from, to) in made.chunks_exact(columns * width).zip(to.chunks_exact_mut(length)) {
                    let to = to[stored..].chunks_exact_mut(stored);
                    for (from, to) in from.chunks_exact(width).zip(to) {
                        from.iter().zip(to).for_each(|(from, to)| *to = E::from_f32(*from));
                    }
                }
            }
        });
        run(&self.output, &attended, channels, pool)
    }
}

dispatch! {
    /// Attention within the windows of a band of rows: `rows` has queries, keys and values of each cell, with a border of one
    /// cell; `to` is `[side, columns, width]`.
    fn attend(window: Window, rows: &[f32], positions: &[f32], columns: usize, to: &mut [f32]) {
        let Window { side, heads, head_width } = window;
        let width = heads * head_width;
        let scale = 1.0 / (head_width as f32).sqrt();
        let cell = |row: usize, column: usize| ((row * (columns + 2)) + column + 1) * 3 * width;
        let mut scores = vec![0.0f32; side * side];
        for (first, head) in (0..columns).step_by(side).flat_map(|first| (0..heads).map(move |head| (first, head))) {
            let head_at = head * head_width;
            for asks in 0..side * side {
                let (row, column) = (asks / side, asks % side);
                let query = &rows[cell(row, first + column) + head_at..][..head_width];
                let mut greatest = f32::NEG_INFINITY;
                for (asked, score) in scores.iter_mut().enumerate() {
                    let (to_row, to_column) = (asked / side, asked % side);
                    let key = &rows[cell(to_row, first + to_column) + width + head_at..][..head_width];
                    let position = (to_row + side - 1 - row) * (2 * side - 1) + to_column + side - 1 - column;
                    *score = product(query, key) * scale + positions[position];
                    greatest = greatest.max(*score);
                }
                scores.iter_mut().for_each(|score| *score = exp(*score - greatest));
                let factor = 1.0 / sum(&scores);
                let to = &mut to[(row * columns + first + column) * width + head_at..][..head_width];
                to.fill(0.0);
                for (asked, score) in scores.iter().enumerate() {
                    let (from_row, from_column) = (asked / side, asked % side);
                    let value = &rows[cell(from_row, first + from_column) + 2 * width + head_at..][..head_width];
                    let weight = score * factor;
                    to.iter_mut().zip(value).for_each(|(to, value)| *to += value * weight);
                }
            }
        }
    }
}

impl Split {
    /// Adds what was made, each by how much it counts.
    pub fn add(&self, made: &[Map<f32>], to: &mut Map<f32>, pool: &mut Pool) {
        let counts = self.counts(made, pool);
        let views: Vec<View<f32>> = made.iter().map(Map::view).collect();
        let channels = to.channels;
        each_cell(to, 1, pool, |row, to| {
            for (view, counts) in views.iter().zip(counts.chunks_exact(channels)) {
                let from = cells(view, row).chunks_exact(channels);
                for (from, to) in from.zip(to.chunks_exact_mut(channels)) {
                    let numbers = to.iter_mut().zip(from).zip(counts);
                    numbers.for_each(|((to, from), count)| *to += from * count);
                }
            }
        });
    }

    /// `[attentions, channels]`: how much of each attention is taken.
    fn counts(&self, made: &[Map<f32>], pool: &mut Pool) -> Vec<f32> {
        let (rows, columns, channels) = (made[0].rows, made[0].columns, made[0].channels);
        let views: Vec<View<f32>> = made.iter().map(Map::view).collect();
        // A sum for each row, so that threads change no order.
        let mut sums = vec![0.0f32; rows * channels];
        pool.each(split(&mut sums, channels, rows, pool.threads(), 1), |share| {
            for (row, to) in share.range.zip(share.data.chunks_exact_mut(channels)) {
                for from in views.iter().flat_map(|view| cells(view, row).chunks_exact(channels)) {
                    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
                }
            }
        });
        let mut mean = vec![0.0f32; channels];
        for row in sums.chunks_exact(channels) {
            mean.iter_mut().zip(row).for_each(|(mean, row)| *mean += row);
        }
        mean.iter_mut().for_each(|mean| *mean /= (rows * columns) as f32);
        let linear = |weights: &[f32], from: &[f32]| -> Vec<f32> {
            weights
                .chunks_exact(from.len())
                .map(|weights| product(weights, from))
                .collect()
        };
        let first = linear(&self.first, &mean);
        let mut hidden = vec![0.0; channels];
        normalized(&first, &self.norm.weight, &self.norm.bias, &mut hidden);
        hidden.iter_mut().for_each(|value| *value = value.max(0.0));
        let mut counts = linear(&self.second, &hidden);
        for channel in 0..channels {
            let of = || (channel..made.len() * channels).step_by(channels);
            let greatest = of().fold(f32::NEG_INFINITY, |greatest, at| greatest.max(counts[at]));
            of().for_each(|at| counts[at] = exp(counts[at] - greatest));
            let all: f32 = of().map(|at| counts[at]).sum();
            of().for_each(|at| counts[at] /= all);
        }
        counts
    }
}

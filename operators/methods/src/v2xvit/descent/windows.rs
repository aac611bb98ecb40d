//! The way back through attention within windows, of several sizes, and through how much each of them counts.

use realo_kernels::cells::{line, line_mut};
use realo_kernels::conv::Map;
use realo_kernels::simd::dispatch;

use super::super::settings::Window;
use super::super::tiles::{Tile, Worker};
use super::super::windows::{LANES, Lanes, OverWindows, Within, attend, score, weights};
use super::agents::add;
use super::layer::{LinearBack, NormBack};
use super::rows::add_rows;
use super::split::SplitBack;
use super::sums::Sums;

/// As [`OverWindows`].
pub struct WindowsBack {
    pub norm: NormBack,
    pub windows: Vec<WithinBack>,
    pub split: SplitBack,
}

/// As [`Within`].
pub struct WithinBack {
    /// Key of gradients that lie as [`Within::positions`] do.
    pub positions: String,
    pub all: LinearBack,
    pub output: LinearBack,
}

impl WindowsBack {
    /// The gradient of a tile, from those of what windows of each size gave.
    pub fn run(
        &self,
        attention: &OverWindows<f32>,
        (tile, map, of_made): (Tile, &Map<f32>, &[Map<f32>]),
        sums: &mut Sums,
        worker: &mut Worker<f32>,
    ) -> Map<f32> {
        let normed = attention.norm.run(tile.alone(), line(map), worker);
        let mut of_normed = worker.single(map.columns, map.channels);
        line_mut(&mut of_normed).fill(0.0);
        for ((within, back), of_made) in attention.windows.iter().zip(&self.windows).zip(of_made) {
            let found = back.run(within, tile.columns, [&normed, of_made], sums, worker);
            add(&found, &mut of_normed);
            worker.keep_single([found]);
        }
        let of_map = self.norm.run(&attention.norm, map, &of_normed, sums, worker);
        worker.keep_single([of_normed]);
        worker.keep_own([normed]);
        of_map
    }
}

impl WithinBack {
    /// The gradient of a normed tile of so many columns; `read`: the tile, and the gradient of what it was given.
    fn run(
        &self,
        within: &Within<f32>,
        columns: usize,
        [normed, of_made]: [&Map<f32>; 2],
        sums: &mut Sums,
        worker: &mut Worker<f32>,
    ) -> Map<f32> {
        let (window, cells) = (within.window, normed.columns);
        let width = window.width();
        let all = worker.run(&within.all, normed);
        let mut attended = worker.single(cells, width);
        let positions = &within.positions;
        attend(window, columns, line(&all), positions, width, line_mut(&mut attended));
        let of_attended = self.output.run(&attended, of_made, sums, worker);
        let mut of_all = worker.single(cells, 3 * width);
        line_mut(&mut of_all).fill(0.0);
        let (of_positions, _) = sums.of(&self.positions, positions.len() * LANES).as_chunks_mut();
        let read = [line(&all), line(&of_attended)];
        attend_back(window, columns, read, positions, of_positions, line_mut(&mut of_all));
        let of_normed = self.all.run(normed, &of_all, sums, worker);
        worker.keep_single([all, attended, of_attended, of_all]);
        of_normed
    }
}

dispatch! {
    /// Adds the gradients of queries, keys and values, and those of positions. `read`: queries, keys and values of each cell of
    /// a tile, and the gradients of what attention gave it.
    fn attend_back(
        window: Window, columns: usize, read: [&[f32]; 2], positions: &[Lanes], of_positions: &mut [Lanes], to: &mut [f32],
    ) {
        let Window { side, heads, head_width } = window;
        let [all, of_attended] = read;
        let (cells, width) = (side * side, heads * head_width);
        let (rows, blocks) = (all.len() / (3 * width * columns), cells.div_ceil(LANES));
        let scale = 1.0 / (head_width as f32).sqrt();
        let offsets: Vec<usize> = (0..cells).map(|cell| cell / side * columns + cell % side).collect();
        // Those who ask in lanes; lanes of nobody stay 0.
        let [mut queries, mut gradients] = [(); 2].map(|()| vec![[0.0; LANES]; blocks * head_width]);
        let [mut shares, mut of_scores] = [(); 2].map(|()| vec![[0.0; LANES]; blocks * cells]);
        let corners = (0..rows).step_by(side).flat_map(|row| (0..columns).step_by(side).map(move |column| row * columns + column));
        for (first, head) in corners.flat_map(|first| (0..heads).map(move |head| (first, head))) {
            let at = |part: usize, cell: usize| ((first + offsets[cell]) * 3 + part) * width + head * head_width;
            let of = |part: usize, cell: usize| &all[at(part, cell)..][..head_width];
            let gradient = |cell: usize| &of_attended[(first + offsets[cell]) * width + head * head_width..][..head_width];
            for cell in 0..cells {
                let range = cell / LANES * head_width..(cell / LANES + 1) * head_width;
                let lanes = queries[range.clone()].iter_mut().zip(&mut gradients[range]);
                for ((query, gradient), (to_query, to_gradient)) in of(0, cell).iter().zip(gradient(cell)).zip(lanes) {
                    to_query[cell % LANES] = query * scale;
                    to_gradient[cell % LANES] = *gradient;
                }
            }
            for block in 0..blocks {
                let (own, pairs) = (block * head_width..(block + 1) * head_width, block * cells..(block + 1) * cells);
                let (queries, gradients) = (&queries[own.clone()], &gradients[own]);
                let (shares, of_scores) = (&mut shares[pairs.clone()], &mut of_scores[pairs.clone()]);
                for (cell, (shares, of_scores)) in shares.iter_mut().zip(&mut *of_scores).enumerate() {
                    *shares = score(queries, of(1, cell));
                    *of_scores = score(gradients, of(2, cell));
                }
                let factors = weights(shares, &positions[pairs.clone()]);
                lead_through_shares(factors, shares, of_scores, &mut of_positions[pairs]);
            }
            for cell in 0..cells {
                let own = &of_scores[cell / LANES * cells..][..cells];
                add_rows(cells, |asked| own[asked][cell % LANES] * scale, |asked| of(1, asked), &mut to[at(0, cell)..][..head_width]);
                let asking = |scores: &[Lanes], asks: usize| scores[asks / LANES * cells + cell][asks % LANES];
                add_rows(cells, |asks| asking(&of_scores, asks) * scale, |asks| of(0, asks), &mut to[at(1, cell)..][..head_width]);
                add_rows(cells, |asks| asking(&shares, asks), gradient, &mut to[at(2, cell)..][..head_width]);
            }
        }
    }
}

/// Makes shares of weights, by their factors, and gradients of scores of those of shares, which it adds to those of positions.
#[inline(always)]
fn lead_through_shares(factors: Lanes, shares: &mut [Lanes], of_scores: &mut [Lanes], of_positions: &mut [Lanes]) {
    let mut means = [0.0; LANES];
    for (shares, of_scores) in shares.iter_mut().zip(&*of_scores) {
        let numbers = shares.iter_mut().zip(&factors).zip(of_scores).zip(&mut means);
        for (((share, factor), of_score), mean) in numbers {
            *share *= factor;
            *mean += *share * of_score;
        }
    }
    for ((shares, of_scores), of_positions) in shares.iter().zip(of_scores).zip(of_positions) {
        let numbers = shares.iter().zip(of_scores).zip(of_positions).zip(&means);
        for (((share, of_score), of_position), mean) in numbers {
            *of_score = share * (*of_score - mean);
            *of_position += *of_score;
        }
    }
}

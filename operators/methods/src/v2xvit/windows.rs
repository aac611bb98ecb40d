//! Attention within windows of a map, of several sizes, and how much each of them counts.

use realo_kernels::cells::{Linear, line, line_mut};
use realo_kernels::conv::{Map, Packed};
use realo_kernels::math::{exp, product};
use realo_kernels::number::Number;
use realo_kernels::simd::dispatch;

use super::norm::{Norm, normalize};
use super::settings::Window;
use super::tiles::{Tile, Worker};

pub struct OverWindows<E> {
    pub norm: Norm,
    pub windows: Vec<Within<E>>,
    pub split: Split,
}

pub struct Within<E> {
    pub window: Window,
    /// What the offset from who asks to who is asked adds to a score: blocks of those who ask, for each who is asked.
    pub positions: Vec<Lanes>,
    pub all: Linear<E>,
    pub output: Packed<E>,
}

/// How much each attention over windows counts, by channel.
pub struct Split {
    pub first: Vec<f32>,
    pub norm: Norm,
    pub second: Vec<f32>,
}

/// Those who ask side by side.
pub type Lanes = [f32; LANES];
pub const LANES: usize = 16;

impl<E: Number> OverWindows<E> {
    /// What windows of each size give the cells of a tile; `rows` are its rows of the map.
    pub fn run(&self, tile: Tile, rows: &[f32], worker: &mut Worker<E>) -> Vec<Map<E>> {
        let normed = self.norm.run(tile, rows, worker);
        let made = self.windows.iter().map(|within| within.run(tile, &normed, worker));
        let made = made.collect();
        worker.keep_own([normed]);
        made
    }
}

impl<E: Number> Within<E> {
    /// `positions`: `[2 side - 1, 2 side - 1]`, by the offset from who asks to who is asked.
    pub fn new(window: Window, positions: &[f32], all: Linear<E>, output: Packed<E>) -> Self {
        let cells = window.side * window.side;
        let position = |asks: usize, asked: usize| match asks < cells {
            true => positions[window.offset(asks, asked)],
            false => 0.0,
        };
        let blocks = (0..cells)
            .step_by(LANES)
            .flat_map(|first| (0..cells).map(move |asked| (first, asked)));
        Within {
            window,
            positions: blocks
                .map(|(first, asked)| std::array::from_fn(|lane| position(first + lane, asked)))
                .collect(),
            all,
            output,
        }
    }

    /// What the attention gives the cells of a tile; without the norm.
    pub fn run(&self, tile: Tile, normed: &Map<E>, worker: &mut Worker<E>) -> Map<E> {
        let all = worker.run(&self.all, normed);
        let mut attended = worker.own(tile.cells(), self.window.width());
        let stored = attended.stored;
        attend(
            self.window,
            tile.columns,
            line(&all),
            &self.positions,
            stored,
            line_mut(&mut attended),
        );
        let made = worker.run_own(&self.output, &attended);
        worker.keep_single([all]);
        worker.keep_own([attended]);
        made
    }
}

dispatch! {
    /// Attention within the windows of a tile of so many columns. `all` has queries, keys and values of each cell; `positions`
    /// those who ask in lanes, for each who is asked; `to` has `stored` numbers for each cell.
    pub fn attend<E: Number>(
        window: Window, columns: usize, all: &[f32], positions: &[Lanes], stored: usize, to: &mut [E],
    ) {
        let Window { side, heads, head_width } = window;
        let (cells, width) = (side * side, heads * head_width);
        let (rows, blocks) = (all.len() / (3 * width * columns), cells.div_ceil(LANES));
        let scale = 1.0 / (head_width as f32).sqrt();
        let offsets: Vec<usize> = (0..cells).map(|cell| cell / side * columns + cell % side).collect();
        let mut queries = vec![[0.0; LANES]; blocks * head_width];
        let mut scores = vec![[0.0; LANES]; blocks * cells];
        let mut factors = vec![[0.0; LANES]; blocks];
        let corners = (0..rows).step_by(side).flat_map(|row| (0..columns).step_by(side).map(move |column| row * columns + column));
        for (first, head) in corners.flat_map(|first| (0..heads).map(move |head| (first, head))) {
            let of = |part: usize, cell: usize| {
                &all[((first + offsets[cell]) * 3 + part) * width + head * head_width..][..head_width]
            };
            for cell in 0..cells {
                let lanes = &mut queries[cell / LANES * head_width..][..head_width];
                lanes.iter_mut().zip(of(0, cell)).for_each(|(lanes, query)| lanes[cell % LANES] = query * scale);
            }
            for (block, factors) in factors.iter_mut().enumerate() {
                let queries = &queries[block * head_width..][..head_width];
                let scores = &mut scores[block * cells..][..cells];
                let positions = &positions[block * cells..][..cells];
                for (cell, scores) in scores.iter_mut().enumerate() {
                    *scores = score(queries, of(1, cell));
                }
                *factors = weights(scores, positions);
            }
            for (block, factors) in factors.iter().enumerate() {
                let scores = &scores[block * cells..][..cells];
                let asking = (cells - block * LANES).min(LANES);
                let mut from = 0;
                while from < head_width {
                    let values = |cell| &of(2, cell)[from..];
                    let mut write = |lane: usize, made: &[f32]| {
                        let at = (first + offsets[block * LANES + lane]) * stored + head * head_width + from;
                        let to = to[at..at + made.len()].iter_mut().zip(made);
                        to.for_each(|(to, value)| *to = E::from_f32(value * factors[lane]));
                    };
                    from += match head_width - from {
                        64.. => each::<64>(asking, |lane| mean(scores, lane, values), &mut write),
                        32.. => each::<32>(asking, |lane| mean(scores, lane, values), &mut write),
                        16.. => each::<16>(asking, |lane| mean(scores, lane, values), &mut write),
                        // Of narrow heads, for all who ask at once.
                        4.. => {
                            let made = means::<4>(scores, values);
                            each(asking, |lane| made.map(|lanes| lanes[lane]), &mut write)
                        }
                        _ => {
                            let made = means::<1>(scores, values);
                            each(asking, |lane| made.map(|lanes| lanes[lane]), &mut write)
                        }
                    };
                }
            }
        }
    }
}

/// Products of queries, `[head width]` of lanes, with a key.
#[inline(always)]
pub fn score(queries: &[Lanes], key: &[f32]) -> Lanes {
    let mut sums = [0.0; LANES];
    for (queries, key) in queries.iter().zip(key) {
        sums.iter_mut()
            .zip(queries)
            .for_each(|(sum, query)| *sum += query * key);
    }
    sums
}

/// Makes weights of scores, but for the factors that it returns.
#[inline(always)]
pub fn weights(scores: &mut [Lanes], positions: &[Lanes]) -> Lanes {
    let mut max = [f32::NEG_INFINITY; LANES];
    for (scores, positions) in scores.iter_mut().zip(positions) {
        for ((score, position), max) in scores.iter_mut().zip(positions).zip(&mut max) {
            *score += position;
            *max = max.max(*score);
        }
    }
    let mut sums = [0.0; LANES];
    for scores in scores {
        for ((score, max), sum) in scores.iter_mut().zip(&max).zip(&mut sums) {
            *score = exp(*score - max);
            *sum += *score;
        }
    }
    sums.map(|sum| 1.0 / sum)
}

/// Writes what some channels make for each who asks; how many channels.
#[inline(always)]
fn each<const D: usize>(
    asking: usize,
    made: impl Fn(usize) -> [f32; D],
    write: &mut impl FnMut(usize, &[f32]),
) -> usize {
    (0..asking).for_each(|lane| write(lane, &made(lane)));
    D
}

/// Values of some channels, weighed by the scores of a lane.
#[inline(always)]
fn mean<'a, const D: usize>(scores: &[Lanes], lane: usize, value: impl Fn(usize) -> &'a [f32]) -> [f32; D] {
    let mut sums = [0.0; D];
    for (cell, scores) in scores.iter().enumerate() {
        let score = scores[lane];
        sums.iter_mut()
            .zip(&value(cell)[..D])
            .for_each(|(sum, value)| *sum += value * score);
    }
    sums
}

/// Values of some channels, weighed by the scores of every lane.
#[inline(always)]
fn means<'a, const D: usize>(scores: &[Lanes], value: impl Fn(usize) -> &'a [f32]) -> [Lanes; D] {
    let mut sums = [[0.0; LANES]; D];
    for (cell, scores) in scores.iter().enumerate() {
        let values = &value(cell)[..D];
        for d in 0..D {
            for lane in 0..LANES {
                sums[d][lane] += values[d] * scores[lane];
            }
        }
    }
    sums
}

impl Split {
    /// `[attentions, channels]`: how much of each attention is taken, from the mean over all cells of their sum.
    pub fn counts(&self, mean: &[f32]) -> Vec<f32> {
        let channels = mean.len();
        let linear = |weights: &[f32], from: &[f32]| -> Vec<f32> {
            weights
                .chunks_exact(from.len())
                .map(|weights| product(weights, from))
                .collect()
        };
        let mut hidden = vec![0.0; channels];
        normalize(
            &linear(&self.first, mean),
            [&self.norm.weight, &self.norm.bias],
            channels,
            &mut hidden,
        );
        hidden.iter_mut().for_each(|value: &mut f32| *value = value.max(0.0));
        let mut counts = linear(&self.second, &hidden);
        for channel in 0..channels {
            let of = || (channel..self.second.len() / channels).step_by(channels);
            let max = of().fold(f32::NEG_INFINITY, |max, at| max.max(counts[at]));
            of().for_each(|at| counts[at] = exp(counts[at] - max));
            let all: f32 = of().map(|at| counts[at]).sum();
            of().for_each(|at| counts[at] /= all);
        }
        counts
    }
}

dispatch! {
    /// Adds cells to a sum of each channel.
    pub fn sum_up<E: Number>(cells: &[E], stored: usize, sums: &mut [f32]) {
        for cell in cells.chunks_exact(stored) {
            sums.iter_mut().zip(cell).for_each(|(sum, value)| *sum += value.to_f32());
        }
    }
}

dispatch! {
    /// Adds cells, each channel by how much it counts.
    pub fn add_counted<E: Number>(cells: &[E], stored: usize, counts: &[f32], to: &mut [f32]) {
        for (cell, to) in cells.chunks_exact(stored).zip(to.chunks_exact_mut(counts.len())) {
            to.iter_mut().zip(cell).zip(counts).for_each(|((to, value), count)| *to += value.to_f32() * count);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use realo_kernels::cells::packed;
    use realo_kernels::conv::Isa;
    use realo_nn::filler::Numbers;

    proptest! {
        #[test]
        fn attention_is_what_its_formula_says_with_the_same_bits_on_all_instructions(
            seed in any::<u64>(),
            side in 1usize..6,
            heads in 1usize..4,
            head_width in prop_oneof![1usize..20, Just(32usize), Just(83usize)],
            across in [1usize..3, 1usize..3],
        ) {
            let window = Window { side, heads, head_width };
            let [rows, columns] = across.map(|windows| windows * side);
            let width = heads * head_width;
            let mut numbers = Numbers::new(seed);
            let (all, offsets) = (numbers.list(rows * columns * 3 * width), numbers.list((2 * side - 1).pow(2)));
            let layer = || packed::<f32, f32>(vec![1.0], vec![0.0], [1, 1], Isa::Portable);
            let within = Within::new(window, &offsets, layer(), layer());
            let [mut found, mut portable] = [(); 2].map(|()| vec![0.0f32; rows * columns * width]);
            attend(window, columns, &all, &within.positions, width, &mut found);
            attend::portable(window, columns, &all, &within.positions, width, &mut portable);
            prop_assert_eq!(&found, &portable);
            for (at, found) in found.iter().enumerate() {
                let (cell, head, channel) = (at / width, at % width / head_width, at % head_width);
                let [row, column] = [cell / columns, cell % columns];
                let number = |part: usize, [row, column]: [usize; 2], channel: usize| {
                    f64::from(all[((row * columns + column) * 3 + part) * width + head * head_width + channel])
                };
                let asked = (0..side * side).map(|k| [row / side * side + k / side, column / side * side + k % side]);
                let weights = asked.clone().map(|asked| {
                    let products = (0..head_width).map(|d| number(0, [row, column], d) * number(1, asked, d));
                    let [down, right] = [asked[0] + side - 1 - row, asked[1] + side - 1 - column];
                    let offset = f64::from(offsets[down * (2 * side - 1) + right]);
                    (products.sum::<f64>() / (head_width as f64).sqrt() + offset).exp()
                });
                let values = weights.clone().zip(asked).map(|(weight, asked)| weight * number(2, asked, channel));
                let expected = values.sum::<f64>() / weights.sum::<f64>();
                prop_assert!((f64::from(*found) - expected).abs() < 1e-5, "{} {}", found, expected);
            }
        }
    }
}

//! The way back through a block; workers take bands of the map through it, tile by tile, and compute again what lies within.

use std::ops::Range;

use realo_kernels::cells::{line, line_mut};
use realo_kernels::conv::Map;
use realo_kernels::simd::dispatch;

use super::super::blocks::Block;
use super::super::forward::Forward;
use super::super::state::Asked;
use super::super::tiles::{Crew, Tile, Tiles, Worker};
use super::super::windows::add_counted;
use super::agents::{AgentsBack, Tiled};
use super::forward::ForwardBack;
use super::sums::Sums;
use super::windows::WindowsBack;

/// As [`Block`].
pub struct BlockBack {
    pub agents: AgentsBack,
    pub windows: WindowsBack,
}

/// What a block read and made.
pub struct KeptBlock {
    /// By agent: the map that the block read.
    pub before: Vec<Vec<f32>>,
    /// By who asks, as all that follows: the map after attention over agents.
    pub between: Vec<Vec<f32>>,
    /// Then by size of windows: what attention within them gave.
    pub made: Vec<Vec<Vec<f32>>>,
    /// The mean of all of that over the map, and how much each size counts.
    pub means: Vec<Vec<f32>>,
    pub counts: Vec<Vec<f32>>,
}

/// A block on the way back.
pub struct Step<'a> {
    pub tiles: Tiles,
    pub channels: usize,
    pub kinds: &'a [usize],
    pub covered: &'a [Vec<bool>],
    pub kept: &'a KeptBlock,
    pub block: (&'a Block<f32>, &'a BlockBack),
    pub forward: Option<(&'a Forward<f32>, &'a ForwardBack)>,
}

/// Rows of a tile's height.
struct Band<'a> {
    cells: Range<usize>,
    /// By agent: of what the block gave, then of what it read.
    gradients: Vec<&'a mut [f32]>,
    /// By who asks.
    of_counts: Vec<Vec<f32>>,
    sums: Sums,
}

impl Step<'_> {
    /// Makes gradients of what the block gave those of what it read.
    pub fn run(&self, gradients: &mut [Vec<f32>], sums: &mut Sums, crew: &mut Crew<f32>) {
        let mut bands = self.bands(gradients);
        crew.each(&mut bands, |band, worker| {
            let tiles = self.tiles.across();
            tiles.for_each(|tile| self.lead_through_conclusion(band, tile, worker));
        });
        let of_means: Vec<Vec<f32>> = (0..self.kept.counts.len())
            .map(|asks| self.lead_through_counts(&bands, asks, sums))
            .collect();
        crew.each(&mut bands, |band, worker| {
            for tile in self.tiles.across() {
                self.lead_through_windows(band, tile, &of_means, worker);
                self.lead_through_agents(band, tile, worker);
            }
        });
        // A sum for each band, so that threads change no order.
        bands.into_iter().for_each(|band| sums.add_all(band.sums));
    }

    fn bands<'a>(&self, gradients: &'a mut [Vec<f32>]) -> Vec<Band<'a>> {
        let count = self.tiles.bands();
        let cells = self.tiles.cells() / count;
        let band = |index: usize| Band {
            cells: index * cells..(index + 1) * cells,
            gradients: Vec::new(),
            of_counts: self.kept.counts.iter().map(|counts| vec![0.0; counts.len()]).collect(),
            sums: Sums::default(),
        };
        let mut bands: Vec<Band> = (0..count).map(band).collect();
        for gradient in gradients {
            let rows = gradient.chunks_exact_mut(cells * self.channels);
            bands
                .iter_mut()
                .zip(rows)
                .for_each(|(band, rows)| band.gradients.push(rows));
        }
        bands
    }

    fn rows<'a>(&self, band: &Band, map: &'a [f32]) -> &'a [f32] {
        &map[band.cells.start * self.channels..band.cells.end * self.channels]
    }

    /// Through the feed-forward, if one follows, to what windows gave.
    fn lead_through_conclusion(&self, band: &mut Band, tile: Tile, worker: &mut Worker<f32>) {
        let (kept, channels) = (self.kept, self.channels);
        for (asks, made) in kept.made.iter().enumerate() {
            if let Some((forward, back)) = self.forward {
                let mut map = worker.gather(tile, self.rows(band, &kept.between[asks]), channels);
                for (made, counts) in made.iter().zip(kept.counts[asks].chunks_exact(channels)) {
                    let to = line_mut(&mut map).chunks_exact_mut(tile.columns * channels);
                    tile.lines(self.rows(band, made), channels)
                        .zip(to)
                        .for_each(|(made, to)| add_counted(made, channels, counts, to));
                }
                let gradient = worker.gather(tile, band.gradients[asks], channels);
                let found = back.run(forward, (tile, &map, &gradient), &mut band.sums, worker);
                tile.add(line(&found), channels, band.gradients[asks]);
                worker.keep_single([map, gradient, found]);
            }
            let of_counts = band.of_counts[asks].chunks_exact_mut(channels);
            for (made, of_counts) in made.iter().zip(of_counts) {
                let made = &made[band.cells.start * channels..band.cells.end * channels];
                tile.lines(made, channels)
                    .zip(tile.lines(band.gradients[asks], channels))
                    .for_each(|(made, gradient)| add_products(made, gradient, of_counts));
            }
        }
    }

    /// What each cell's gradient has in addition, since all cells decide how much windows of each size count.
    fn lead_through_counts(&self, bands: &[Band], asks: usize, sums: &mut Sums) -> Vec<f32> {
        let (kept, (block, back)) = (self.kept, self.block);
        let mut of_counts = vec![0.0; kept.counts[asks].len()];
        for band in bands {
            let numbers = of_counts.iter_mut().zip(&band.of_counts[asks]);
            numbers.for_each(|(sum, number)| *sum += number);
        }
        let (mean, counts) = (&kept.means[asks], &kept.counts[asks]);
        let (split, cells) = (&block.windows.split, self.tiles.cells() as f32);
        let mut of_mean = back.windows.split.run(split, mean, counts, &of_counts, sums);
        of_mean.iter_mut().for_each(|gradient| *gradient /= cells);
        of_mean
    }

    fn lead_through_windows(&self, band: &mut Band, tile: Tile, of_means: &[Vec<f32>], worker: &mut Worker<f32>) {
        let (kept, channels, (block, back)) = (self.kept, self.channels, self.block);
        for (asks, of_mean) in of_means.iter().enumerate() {
            let gradient = worker.gather(tile, band.gradients[asks], channels);
            let map = worker.gather(tile, self.rows(band, &kept.between[asks]), channels);
            let mut of_made = Vec::new();
            for counts in kept.counts[asks].chunks_exact(channels) {
                let mut to = worker.single(tile.cells(), channels);
                share_out(line(&gradient), counts, of_mean, line_mut(&mut to));
                of_made.push(to);
            }
            let read = (tile, &map, &of_made[..]);
            let found = back.windows.run(&block.windows, read, &mut band.sums, worker);
            tile.add(line(&found), channels, band.gradients[asks]);
            worker.keep_single(of_made);
            worker.keep_single([gradient, map, found]);
        }
    }

    fn lead_through_agents(&self, band: &mut Band, tile: Tile, worker: &mut Worker<f32>) {
        let (kept, channels, (block, back)) = (self.kept, self.channels, self.block);
        let covers = self.covered.iter().map(|covered| &covered[band.cells.clone()]);
        let covers: Vec<Vec<bool>> = covers
            .map(|covered| tile.lines(covered, 1).flatten().copied().collect())
            .collect();
        let asked = covers.iter().zip(self.kinds);
        let asked: Vec<Asked> = asked.map(|(covered, kind)| Asked { kind: *kind, covered }).collect();
        let maps = kept.before.iter().map(|map| self.rows(band, map));
        let maps: Vec<Map<f32>> = maps.map(|rows| worker.gather(tile, rows, channels)).collect();
        let norm = &block.agents.norm;
        let normed: Vec<Map<f32>> = maps
            .iter()
            .map(|map| norm.run(tile.alone(), line(map), worker))
            .collect();
        let mut of_normed: Vec<Map<f32>> = maps.iter().map(|map| worker.single(map.columns, channels)).collect();
        of_normed.iter_mut().for_each(|map| line_mut(map).fill(0.0));
        let mut tiled = Tiled {
            asked: &asked,
            normed: &normed,
            of_normed: &mut of_normed,
        };
        for asks in 0..kept.counts.len() {
            let gradient = worker.gather(tile, band.gradients[asks], channels);
            let sums = &mut band.sums;
            back.agents
                .run(&block.agents, &mut tiled, (asks, &gradient), sums, worker);
            worker.keep_single([gradient]);
        }
        for ((map, of_normed), gradient) in maps.iter().zip(&of_normed).zip(&mut band.gradients) {
            let found = back.agents.norm.run(norm, map, of_normed, &mut band.sums, worker);
            tile.add(line(&found), channels, gradient);
            worker.keep_single([found]);
        }
        worker.keep_single(maps);
        worker.keep_single(of_normed);
        worker.keep_own(normed);
    }
}

dispatch! {
    /// Adds products of cells to a sum of each channel.
    fn add_products(a: &[f32], b: &[f32], sums: &mut [f32]) {
        for (a, b) in a.chunks_exact(sums.len()).zip(b.chunks_exact(sums.len())) {
            sums.iter_mut().zip(a).zip(b).for_each(|((sum, a), b)| *sum += a * b);
        }
    }
}

dispatch! {
    /// Cells, each channel by how much it counts, with what is the same in all.
    fn share_out(cells: &[f32], counts: &[f32], added: &[f32], to: &mut [f32]) {
        for (cell, to) in cells.chunks_exact(counts.len()).zip(to.chunks_exact_mut(counts.len())) {
            let numbers = to.iter_mut().zip(cell).zip(counts).zip(added);
            numbers.for_each(|(((to, value), count), added)| *to = value * count + added);
        }
    }
}

//! Fusions that look at one cell at a time.

use crate::agents::{Agent, lead_back, sample};
use crate::bev::BevView;
use crate::conv::{Pool, split};
use crate::simd::dispatch;

/// Agents of a fusion that is trained, at most.
const MOST_AGENTS: usize = 64;

/// A fusion that looks at one cell at a time.
pub trait CellFusion: Sync {
    /// Writes the fused features of a cell: from the ego's own, and from those of the others that cover it, one after the
    /// other. Must be `#[inline(always)]` to be compiled for the processor's instructions.
    fn cell(&self, own: &[f32], others: &[f32], to: &mut [f32]);
}

/// A fusion that gradients lead back through.
pub trait CellDescent: CellFusion {
    /// Writes the gradients of the features that [`CellFusion::cell`] read, from that of what it wrote. Must be
    /// `#[inline(always)]`.
    fn back(&self, own: &[f32], others: &[f32], gradient: &[f32], of_own: &mut [f32], of_others: &mut [f32]);
}

/// Fuses maps of one size cell by cell, the ego's first; an agent takes no part in cells that its map does not cover.
pub fn fuse<F: CellFusion>(fusion: &F, agents: &[Agent], pool: &mut Pool) -> Vec<f32> {
    let ego = agents[0].map;
    let length = ego.columns * ego.channels;
    let mut fused = vec![0.0; ego.rows * length];
    let shares = split(&mut fused, length, ego.rows, pool.threads(), 1);
    pool.each(shares, |share| {
        let mut scratch = vec![0.0; agents.len() * ego.channels];
        for (row, to) in share.range.zip(share.data.chunks_exact_mut(length)) {
            fuse_row(fusion, agents, row, &mut scratch, to);
        }
    });
    fused
}

/// As [`fuse`], on one thread and without instructions that a processor may lack.
pub fn fuse_portably<F: CellFusion>(fusion: &F, agents: &[Agent]) -> Vec<f32> {
    let ego = agents[0].map;
    let length = ego.columns * ego.channels;
    let (mut fused, mut scratch) = (vec![0.0; ego.rows * length], vec![0.0; agents.len() * ego.channels]);
    for (row, to) in fused.chunks_exact_mut(length).enumerate() {
        fuse_row::portable(fusion, agents, row, &mut scratch, to);
    }
    fused
}

dispatch! {
    fn fuse_row<F: CellFusion>(fusion: &F, agents: &[Agent], row: usize, scratch: &mut [f32], to: &mut [f32]) {
        let ego = agents[0].map;
        let channels = ego.channels;
        let own = ego.data[row * ego.columns * channels..].chunks_exact(channels);
        for (column, (own, to)) in own.zip(to.chunks_exact_mut(channels)).enumerate() {
            let mut covering = 0;
            for other in &agents[1..] {
                let cell = &mut scratch[covering * channels..(covering + 1) * channels];
                covering += usize::from(sample(other, column, row, None, cell));
            }
            fusion.cell(own, &scratch[..covering * channels], to);
        }
    }
}

/// The gradients of agents' maps, the ego's first, from that of the map that [`fuse`] made of them. All cells of all maps are there.
pub fn descend<F: CellDescent>(fusion: &F, agents: &[Agent], gradient: &[f32], pool: &mut Pool) -> Vec<Vec<f32>> {
    let ego = agents[0].map;
    let length = ego.columns * ego.channels;
    // In the ego's cells, row by row: of the ego, then of each other.
    let mut placed = vec![0.0; ego.rows * agents.len() * length];
    let shares = split(&mut placed, agents.len() * length, ego.rows, pool.threads(), 1);
    pool.each(shares, |share| {
        let mut scratch = vec![0.0; 2 * agents.len() * ego.channels];
        for (row, to) in share.range.zip(share.data.chunks_exact_mut(agents.len() * length)) {
            descend_row(
                fusion,
                agents,
                row,
                &gradient[row * length..][..length],
                &mut scratch,
                to,
            );
        }
    });
    let mut of_maps: Vec<Vec<f32>> = agents.iter().map(|agent| vec![0.0; agent.map.data.len()]).collect();
    let of_map = |(index, to): (usize, &mut Vec<f32>)| {
        let rows = placed.chunks_exact(agents.len() * length);
        let rows = rows.map(|row| &row[index * length..][..length]);
        match index {
            0 => to
                .chunks_exact_mut(length)
                .zip(rows)
                .for_each(|(to, row)| to.copy_from_slice(row)),
            _ => lead_back(&agents[index], ego.columns, &rows.collect::<Vec<_>>().concat(), to),
        }
    };
    let threads = pool.threads();
    let mut shares: Vec<Vec<_>> = (0..threads).map(|_| Vec::new()).collect();
    for (index, to) in of_maps.iter_mut().enumerate() {
        shares[index % threads].push((index, to));
    }
    pool.each(shares, |share| share.into_iter().for_each(of_map));
    of_maps
}

dispatch! {
    fn descend_row<F: CellDescent>(
        fusion: &F,
        agents: &[Agent],
        row: usize,
        gradient: &[f32],
        scratch: &mut [f32],
        to: &mut [f32],
    ) {
        let BevView { columns, channels, data, .. } = agents[0].map;
        let length = columns * channels;
        let own = data[row * length..].chunks_exact(channels);
        let (cells, of_cells) = scratch.split_at_mut(agents.len() * channels);
        for (column, (own, gradient)) in own.zip(gradient.chunks_exact(channels)).enumerate() {
            let mut covering = 0;
            let mut which = [0; MOST_AGENTS];
            for (index, other) in agents.iter().enumerate().skip(1) {
                let cell = &mut cells[covering * channels..(covering + 1) * channels];
                if sample(other, column, row, None, cell) {
                    which[covering] = index;
                    covering += 1;
                }
            }
            let size = covering * channels;
            let of_own = &mut to[column * channels..][..channels];
            fusion.back(own, &cells[..size], gradient, of_own, &mut of_cells[..size]);
            for (index, of_cell) in which[..covering].iter().zip(of_cells.chunks_exact(channels)) {
                to[index * length + column * channels..][..channels].copy_from_slice(of_cell);
            }
        }
    }
}

//! Fusions that look at one cell at a time.

use crate::agents::{Agent, sample};
use crate::conv::{Pool, split};
use crate::simd::dispatch;

/// A fusion that looks at one cell at a time.
pub trait CellFusion: Sync {
    /// Writes the fused features of a cell: from the ego's own, and from those of the others that cover it, one after the
    /// other. Must be `#[inline(always)]` to be compiled for the processor's instructions.
    fn cell(&self, own: &[f32], others: &[f32], to: &mut [f32]);
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

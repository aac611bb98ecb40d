//! Attention, cell by cell.

use realo_kernels::by_cell::CellFusion;
use realo_kernels::math::{exp, product};

/// Attention of the ego, with products scaled for so many channels.
#[derive(Clone, Copy, Debug)]
pub struct Attention {
    /// The channels.
    pub width: usize,
}

impl CellFusion for Attention {
    #[inline(always)]
    fn cell(&self, own: &[f32], others: &[f32], to: &mut [f32]) {
        let scale = 1.0 / (self.width as f32).sqrt();
        let own_score = product(own, own) * scale;
        // With one pass over the agents: what was summed before a greater score came is made smaller.
        let (mut max, mut sum) = (own_score, 1.0);
        to.copy_from_slice(own);
        for other in others.chunks_exact(own.len()) {
            let score = product(own, other) * scale;
            let (before, now) = match score > max {
                true => (exp(max - score), 1.0),
                false => (1.0, exp(score - max)),
            };
            max = max.max(score);
            sum = sum * before + now;
            for (to, other) in to.iter_mut().zip(other) {
                *to = *to * before + other * now;
            }
        }
        let factor = 1.0 / sum;
        to.iter_mut().for_each(|to| *to *= factor);
    }
}

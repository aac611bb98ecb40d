//! The weighted mean, cell by cell.

use realo_kernels::by_cell::CellFusion;

/// How much the features of others count, by channel.
#[derive(Clone, Debug)]
pub struct Mean(Vec<f32>);

impl Mean {
    /// Of logits.
    pub fn new(logits: &[f32]) -> Self {
        Mean(logits.iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect())
    }
}

impl CellFusion for Mean {
    #[inline(always)]
    fn cell(&self, own: &[f32], others: &[f32], to: &mut [f32]) {
        to.copy_from_slice(own);
        let others = others.chunks_exact(own.len());
        let count = others.len() as f32;
        for other in others {
            for ((to, from), share) in to.iter_mut().zip(other).zip(&self.0) {
                *to += from * share;
            }
        }
        to.iter_mut()
            .zip(&self.0)
            .for_each(|(to, share)| *to /= 1.0 + count * share);
    }
}

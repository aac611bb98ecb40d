//! The maximum, cell by cell.

use realo_kernels::by_cell::CellFusion;

/// The maximum of each feature.
#[derive(Clone, Copy, Debug)]
pub struct Max;

impl CellFusion for Max {
    #[inline(always)]
    fn cell(&self, own: &[f32], others: &[f32], to: &mut [f32]) {
        to.copy_from_slice(own);
        for other in others.chunks_exact(own.len()) {
            for (to, other) in to.iter_mut().zip(other) {
                *to = if *other > *to { *other } else { *to };
            }
        }
    }
}

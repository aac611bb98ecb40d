//! The maximum, cell by cell.

use realo_kernels::by_cell::{CellDescent, CellFusion};

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

impl CellDescent for Max {
    #[inline(always)]
    fn back(&self, own: &[f32], others: &[f32], gradient: &[f32], of_own: &mut [f32], of_others: &mut [f32]) {
        of_others.fill(0.0);
        for (channel, gradient) in gradient.iter().enumerate() {
            let (mut max, mut of_max) = (own[channel], None);
            for at in (channel..others.len()).step_by(own.len()) {
                if others[at] > max {
                    (max, of_max) = (others[at], Some(at));
                }
            }
            of_own[channel] = if of_max.is_none() { *gradient } else { 0.0 };
            if let Some(at) = of_max {
                of_others[at] = *gradient;
            }
        }
    }
}

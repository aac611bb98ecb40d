//! Attention, cell by cell.

use realo_kernels::by_cell::{CellDescent, CellFusion};
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

impl CellDescent for Attention {
    #[inline(always)]
    fn back(&self, own: &[f32], others: &[f32], gradient: &[f32], of_own: &mut [f32], of_others: &mut [f32]) {
        let channels = own.len();
        let scale = 1.0 / (self.width as f32).sqrt();
        let own_score = product(own, own) * scale;
        // How much each agent counts is kept in the first number of its gradient until that is written.
        let mut max = own_score;
        for (other, of) in others.chunks_exact(channels).zip(of_others.chunks_exact_mut(channels)) {
            of[0] = product(own, other) * scale;
            max = max.max(of[0]);
        }
        let own_share = exp(own_score - max);
        let mut sum = own_share;
        for of in of_others.chunks_exact_mut(channels) {
            of[0] = exp(of[0] - max);
            sum += of[0];
        }
        let along_own = product(gradient, own);
        let mut mean = own_share / sum * along_own;
        for (other, of) in others.chunks_exact(channels).zip(of_others.chunks_exact(channels)) {
            mean += of[0] / sum * product(gradient, other);
        }
        let own_share = own_share / sum;
        let of_own_score = own_share * (along_own - mean) * scale;
        for ((to, gradient), own) in of_own.iter_mut().zip(gradient).zip(own) {
            *to = own_share * gradient + 2.0 * of_own_score * own;
        }
        for (other, of) in others.chunks_exact(channels).zip(of_others.chunks_exact_mut(channels)) {
            let share = of[0] / sum;
            let of_score = share * (product(gradient, other) - mean) * scale;
            let numbers = of.iter_mut().zip(of_own.iter_mut()).zip(gradient).zip(own).zip(other);
            for ((((of, of_own), gradient), own), other) in numbers {
                *of = share * gradient + of_score * own;
                *of_own += of_score * other;
            }
        }
    }
}

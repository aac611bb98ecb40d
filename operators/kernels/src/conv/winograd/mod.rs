//! Convolutions of 3x3 with stride 1 by tiles of 4x4 outputs, with a quarter of the direct kernels' products.
//!
//! Winograd's F(4x4, 3x3), as in Lavin and Gray 2016 (arXiv:1509.09308): `Y = Aᵀ [(G g Gᵀ) ⊙ (Bᵀ d B)] A`, where the
//! sum over channels makes each of the 6x6 places a product of matrices. Tiles lie on a grid that begins at the map's first
//! cell, so that it does not matter which thread computes them.

pub(super) mod places;
mod points;
mod share;
#[cfg(test)]
mod tests;

pub(super) use share::share;

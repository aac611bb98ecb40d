//! The three transforms, Toom and Cook's for the points 0, ±√½, ±√2 and ∞. Of points in pairs, which share half of the
//! work, these lose least in f32, half as much as ±1 and ±2.
#![allow(unsafe_code)]

use std::f64::consts::{FRAC_1_SQRT_2, SQRT_2};

use super::places::{POINTS, SIDE};
use crate::conv::tile::{Float, Load};

const NEAR: f32 = FRAC_1_SQRT_2 as f32;
const FAR: f32 = SQRT_2 as f32;

/// `Bᵀ d B` of a register of channels: reads cells `line` and `cell` numbers apart, writes places `place` numbers apart.
/// `M` reads the map.
///
/// # Safety
/// All of them are there, and the CPU has the instructions of `S` and `M`.
#[inline(always)]
pub(super) unsafe fn inputs_at_places<S: Float, M: Load<Results = S::Register>>(
    from: *const M::Element,
    [line, cell]: [usize; 2],
    to: *mut f32,
    place: usize,
) {
    // SAFETY: the caller's promise.
    unsafe {
        // Rows are filled as columns come: put together afterwards, they would go through memory once more.
        let mut rows = [[S::zero(); POINTS]; POINTS];
        for x in 0..POINTS {
            let mut column = [S::zero(); POINTS];
            for (y, number) in column.iter_mut().enumerate() {
                *number = M::load(from.add(y * line + x * cell));
            }
            for (row, number) in rows.iter_mut().zip(inputs_at_points::<S>(column)) {
                row[x] = number;
            }
        }
        for (y, row) in rows.into_iter().enumerate() {
            for (x, number) in inputs_at_points::<S>(row).into_iter().enumerate() {
                S::store(number, to.add((y * POINTS + x) * place));
            }
        }
    }
}

/// `Aᵀ m A` of a register of outputs, read from places `place` numbers apart.
///
/// # Safety
/// All of them are there, and the CPU has the instructions of `S`.
#[inline(always)]
pub(super) unsafe fn outputs_of_places<S: Float>(from: *const f32, place: usize) -> [[S::Register; SIDE]; SIDE] {
    // SAFETY: the caller's promise.
    unsafe {
        let mut rows = [[S::zero(); POINTS]; SIDE];
        for x in 0..POINTS {
            let mut column = [S::zero(); POINTS];
            for (y, product) in column.iter_mut().enumerate() {
                *product = S::weights(from.add((y * POINTS + x) * place));
            }
            for (row, product) in rows.iter_mut().zip(outputs_of_points::<S>(column)) {
                row[x] = product;
            }
        }
        let mut outputs = [[S::zero(); SIDE]; SIDE];
        for (outputs, row) in outputs.iter_mut().zip(rows) {
            *outputs = outputs_of_points::<S>(row);
        }
        outputs
    }
}

/// `Bᵀ d`: the polynomial that vanishes at all other finite points, its coefficients times the inputs.
///
/// # Safety
/// The CPU has the instructions of `S`.
#[inline(always)]
unsafe fn inputs_at_points<S: Float>([d0, d1, d2, d3, d4, d5]: [S::Register; POINTS]) -> [S::Register; POINTS] {
    // SAFETY: the caller's promise.
    unsafe {
        let plus = |sum, factor: &f32, number| S::multiply_add(sum, S::broadcast(factor), number);
        let (even_near, odd_near) = (plus(d4, &-2.0, d2), plus(d3, &-2.0, d1));
        let (even_far, odd_far) = (plus(d4, &-0.5, d2), plus(d3, &-0.5, d1));
        [
            plus(plus(d4, &-2.5, d2), &1.0, d0),
            plus(even_near, &NEAR, odd_near),
            plus(even_near, &-NEAR, odd_near),
            plus(even_far, &FAR, odd_far),
            plus(even_far, &-FAR, odd_far),
            plus(plus(d5, &-2.5, d3), &1.0, d1),
        ]
    }
}

/// `Aᵀ m`: each point's powers times the products there.
///
/// # Safety
/// The CPU has the instructions of `S`.
#[inline(always)]
unsafe fn outputs_of_points<S: Float>([m0, m1, m2, m3, m4, m5]: [S::Register; POINTS]) -> [S::Register; SIDE] {
    // SAFETY: the caller's promise.
    unsafe {
        let plus = |sum, factor: &f32, number| S::multiply_add(sum, S::broadcast(factor), number);
        let (even_near, odd_near) = (plus(m1, &1.0, m2), plus(m1, &-1.0, m2));
        let (even_far, odd_far) = (plus(m3, &1.0, m4), plus(m3, &-1.0, m4));
        [
            plus(plus(m0, &1.0, even_near), &1.0, even_far),
            plus(plus(S::zero(), &NEAR, odd_near), &FAR, odd_far),
            plus(plus(S::zero(), &0.5, even_near), &2.0, even_far),
            plus(plus(m5, &(0.5 * NEAR), odd_near), &(2.0 * FAR), odd_far),
        ]
    }
}

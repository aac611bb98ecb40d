//! The kernel of Geman and McClure.

/// The weight of a factor whose χ² is `square`: `(c² / (c² + χ²))²`; 1 without a kernel. `width`: c, in standard deviations.
pub(crate) fn weight(square: f64, width: Option<f64>) -> f64 {
    width.map_or(1.0, |width| {
        let share = width * width / (width * width + square);
        share * share
    })
}

/// The cost of a factor: `c² χ² / (c² + χ²)`, which is χ² for small ones and at most c²; χ² without a kernel.
pub(crate) fn cost(square: f64, width: Option<f64>) -> f64 {
    width.map_or(square, |width| width * width * square / (width * width + square))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_weight_is_the_slope_of_the_cost() {
        for width in [None, Some(0.5), Some(3.0)] {
            for square in [0.0, 0.3, 4.0, 1e4] {
                let step = 1e-6 * (1.0 + square);
                let slope = (cost(square + step, width) - cost(square, width)) / step;
                assert!((slope - weight(square, width)).abs() < 1e-5, "{width:?} {square}");
            }
        }
    }
}

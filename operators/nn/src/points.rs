//! Which points of a sweep reach the network. Points are (x, y, z, intensity), metres in one frame.

/// Whether a point lies in the upright box [x min, y min, x max, y max] of the sensor's own body, edges included.
pub fn on_own_body([x, y, ..]: [f32; 4], [x0, y0, x1, y1]: [f32; 4]) -> bool {
    (x0..=x1).contains(&x) && (y0..=y1).contains(&y)
}

/// Whether a point lies strictly inside the volume [x min, y min, z min, x max, y max, z max].
pub fn in_range([x, y, z, _]: [f32; 4], [x0, y0, z0, x1, y1, z1]: [f32; 6]) -> bool {
    x > x0 && x < x1 && y > y0 && y < y1 && z > z0 && z < z1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_belong_to_the_body_and_not_to_the_range() {
        let body = [-2.0, -1.0, 3.0, 1.0];
        assert!(on_own_body([3.0, -1.0, 99.0, 0.0], body));
        assert!(!on_own_body([3.0001, 0.0, 0.0, 0.0], body));
        assert!(!on_own_body([f32::NAN, 0.0, 0.0, 0.0], body));
        let range = [-5.0, -4.0, -2.0, 5.0, 4.0, 2.0];
        assert!(in_range([4.999, 3.9, -1.9, 0.0], range));
        assert!(!in_range([5.0, 0.0, 0.0, 0.0], range));
        assert!(!in_range([0.0, 0.0, f32::NAN, 0.0], range));
    }
}

//! A ray's way over the terrain, cell by cell.

use super::{BLOCK, BLOCKS, NODES, Terrain};

impl Terrain {
    /// The same for a ray that is flat, or for which steps do not settle.
    pub(super) fn alone(&self, origin: [f64; 3], ray: [f64; 3], lift: f64, [from, limit]: [f64; 2]) -> f64 {
        let steep = 4.0 * self.steepest;
        if ray[2] * ray[2] <= steep * steep * (ray[0] * ray[0] + ray[1] * ray[1]) {
            return self.walk(origin, ray, lift, [from, limit]).unwrap_or(f64::NAN);
        }
        let rays = ray.each_ref().map(std::array::from_ref);
        let origin = origin.each_ref().map(std::array::from_ref);
        let [t] = self.drop((origin, rays), lift, &[from], [true]);
        if t <= limit { t.max(from) } else { f64::NAN }
    }

    /// For flat rays: walks the cells where the ray is between the field's highest and lowest point.
    fn walk(&self, origin: [f64; 3], ray: [f64; 3], lift: f64, [from, limit]: [f64; 2]) -> Option<f64> {
        let down = 1.0 / ray[2];
        let mut t = ((self.highest + lift - origin[2]) * down).max(from);
        let end = ((self.lowest + lift - origin[2]) * down + 1e-6).min(limit);
        if t >= end {
            return None;
        }
        let (u0, v0) = (
            (origin[0] + self.half) * self.per_metre,
            (origin[1] + self.half) * self.per_metre,
        );
        let (du, dv) = (ray[0] * self.per_metre, ray[1] * self.per_metre);
        let (u, v) = (u0 + du * t, v0 + dv * t);
        let last = (NODES - 2) as f64;
        if !(0.0..=last).contains(&u) || !(0.0..=last).contains(&v) {
            return None;
        }
        let (step_u, step_v) = (if du < 0.0 { -1 } else { 1 }, if dv < 0.0 { -1 } else { 1 });
        let border = |cell: i32, step: i32| f64::from(if step > 0 { cell + 1 } else { cell });
        let (inv_u, inv_v) = (1.0 / du, 1.0 / dv);
        // Whole blocks are leapt over while the ray stays above their highest points.
        let (mut a, mut b) = (u as i32 / BLOCK, v as i32 / BLOCK);
        loop {
            let edge = |block: i32, step: i32| f64::from(if step > 0 { (block + 1) * BLOCK } else { block * BLOCK });
            let to_u = if du == 0.0 {
                f64::INFINITY
            } else {
                (edge(a, step_u) - u0) * inv_u
            };
            let to_v = if dv == 0.0 {
                f64::INFINITY
            } else {
                (edge(b, step_v) - v0) * inv_v
            };
            let out = to_u.min(to_v).min(end).max(t);
            if origin[2] + ray[2] * out - lift <= f64::from(self.tops[(b * BLOCKS + a) as usize]) {
                break;
            }
            if out >= end {
                return None;
            }
            t = out;
            if to_u < to_v {
                a += step_u
            } else {
                b += step_v
            }
            if a < 0 || b < 0 || a >= BLOCKS || b >= BLOCKS {
                return None;
            }
        }
        let within = |cell: f64, block: i32| (cell as i32).clamp(block * BLOCK, block * BLOCK + BLOCK - 1);
        let (mut i, mut j) = (within(u0 + du * t, a), within(v0 + dv * t, b));
        let mut next_u = if du == 0.0 {
            f64::INFINITY
        } else {
            (border(i, step_u) - u0) * inv_u
        };
        let mut next_v = if dv == 0.0 {
            f64::INFINITY
        } else {
            (border(j, step_v) - v0) * inv_v
        };
        let over =
            |i: i32, j: i32, t: f64| origin[2] + ray[2] * t - lift - self.in_cell(i, j, u0 + du * t, v0 + dv * t);
        let mut above = over(i, j, t);
        if above <= 0.0 {
            return Some(t);
        }
        loop {
            let out = next_u.min(next_v).min(end).max(t);
            let above_out = over(i, j, out);
            if above_out <= 0.0 {
                return Some(root(t, above, out, above_out, |t| over(i, j, t)));
            }
            if out >= end {
                return None;
            }
            (t, above) = (out, above_out);
            if next_u < next_v {
                i += step_u;
                next_u = (border(i, step_u) - u0) * inv_u;
            } else {
                j += step_v;
                next_v = (border(j, step_v) - v0) * inv_v;
            }
            if i < 0 || j < 0 || i > NODES as i32 - 2 || j > NODES as i32 - 2 {
                return None;
            }
        }
    }
}

/// The zero between `a` (value `fa` > 0) and `b` (value `fb` ≤ 0) of a nearly straight function.
#[inline]
fn root(a: f64, fa: f64, b: f64, fb: f64, f: impl Fn(f64) -> f64) -> f64 {
    let slope = (fb - fa) / (b - a);
    if slope >= 0.0 || slope.is_nan() {
        return b;
    }
    let guess = a - fa / slope;
    (guess - f(guess) / slope).clamp(a, b)
}

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
        let t = ((self.highest + lift - origin[2]) * down).max(from);
        let end = ((self.lowest + lift - origin[2]) * down + 1e-6).min(limit);
        if t >= end {
            return None;
        }
        let (du, dv) = (ray[0] * self.per_metre, ray[1] * self.per_metre);
        let line = Line {
            z: origin[2],
            dz: ray[2],
            lift,
            u: Axis::new((origin[0] + self.half) * self.per_metre, du),
            v: Axis::new((origin[1] + self.half) * self.per_metre, dv),
            end,
        };
        let (u, v) = (line.u.at(t), line.v.at(t));
        let last = (NODES - 2) as f64;
        if !(0.0..=last).contains(&u) || !(0.0..=last).contains(&v) {
            return None;
        }
        let (t, block) = self.leap(&line, t, [u as i32 / BLOCK, v as i32 / BLOCK])?;
        self.walk_cells(&line, t, block)
    }

    /// Leaps over whole blocks while the ray stays above their highest points: where it is then, and in which block.
    #[inline(always)]
    fn leap(&self, line: &Line, mut t: f64, [mut a, mut b]: [i32; 2]) -> Option<(f64, [i32; 2])> {
        let edge = |block: i32, step: i32| f64::from(if step > 0 { (block + 1) * BLOCK } else { block * BLOCK });
        loop {
            let to_u = line.u.reaches(edge(a, line.u.step));
            let to_v = line.v.reaches(edge(b, line.v.step));
            let out = to_u.min(to_v).min(line.end).max(t);
            if line.z + line.dz * out - line.lift <= f64::from(self.tops[(b * BLOCKS + a) as usize]) {
                return Some((t, [a, b]));
            }
            if out >= line.end {
                return None;
            }
            t = out;
            if to_u < to_v {
                a += line.u.step
            } else {
                b += line.v.step
            }
            if a < 0 || b < 0 || a >= BLOCKS || b >= BLOCKS {
                return None;
            }
        }
    }

    /// Where the ray comes down to the ground, cell by cell from a place in a block.
    #[inline(always)]
    fn walk_cells(&self, line: &Line, mut t: f64, [a, b]: [i32; 2]) -> Option<f64> {
        let border = |cell: i32, step: i32| f64::from(if step > 0 { cell + 1 } else { cell });
        let within = |cell: f64, block: i32| (cell as i32).clamp(block * BLOCK, block * BLOCK + BLOCK - 1);
        let (mut i, mut j) = (within(line.u.at(t), a), within(line.v.at(t), b));
        let mut next_u = line.u.reaches(border(i, line.u.step));
        let mut next_v = line.v.reaches(border(j, line.v.step));
        let over =
            |i: i32, j: i32, t: f64| line.z + line.dz * t - line.lift - self.in_cell(i, j, line.u.at(t), line.v.at(t));
        let mut above = over(i, j, t);
        if above <= 0.0 {
            return Some(t);
        }
        loop {
            let out = next_u.min(next_v).min(line.end).max(t);
            let above_out = over(i, j, out);
            if above_out <= 0.0 {
                return Some(root(t, above, out, above_out, |t| over(i, j, t)));
            }
            if out >= line.end {
                return None;
            }
            (t, above) = (out, above_out);
            if next_u < next_v {
                i += line.u.step;
                next_u = (border(i, line.u.step) - line.u.from) * line.u.inverse;
            } else {
                j += line.v.step;
                next_v = (border(j, line.v.step) - line.v.from) * line.v.inverse;
            }
            if i < 0 || j < 0 || i > NODES as i32 - 2 || j > NODES as i32 - 2 {
                return None;
            }
        }
    }
}

/// A ray over the terrain, along its axes in cells.
struct Line {
    z: f64,
    dz: f64,
    lift: f64,
    u: Axis,
    v: Axis,
    /// Where it is below all ground, or ends.
    end: f64,
}

/// A ray's way along one axis of the terrain.
struct Axis {
    from: f64,
    per_t: f64,
    inverse: f64,
    /// To which neighbour it goes.
    step: i32,
}

impl Axis {
    #[inline(always)]
    fn new(from: f64, per_t: f64) -> Axis {
        Axis {
            from,
            per_t,
            inverse: 1.0 / per_t,
            step: if per_t < 0.0 { -1 } else { 1 },
        }
    }

    #[inline(always)]
    fn at(&self, t: f64) -> f64 {
        self.from + self.per_t * t
    }

    /// When it reaches a border; never where it goes along it.
    #[inline(always)]
    fn reaches(&self, border: f64) -> f64 {
        match self.per_t == 0.0 {
            true => f64::INFINITY,
            false => (border - self.from) * self.inverse,
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

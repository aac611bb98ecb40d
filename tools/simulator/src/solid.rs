//! Bodies that rays can hit: a bounding box and the convex parts within it.

mod shape;

use crate::random::{mix, unit_of};
use shape::slab;
pub(crate) use shape::{Shape, prism};

/// Where and how a ray met a body.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Hit {
    /// Distance along the ray, m.
    pub t: f64,
    /// Cosine of the angle between the ray and the surface's normal.
    pub cos: f64,
    /// Diffuse reflectivity; above 1 for retro-reflectors.
    pub rho: f64,
}

/// A convex piece of a body, in the body's frame: x forward, z = 0 on the ground.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    pub shape: Shape,
    pub rho: f64,
    /// Share of the rays that go through as if nothing were there (glass).
    pub pass: f64,
}

impl Part {
    /// A piece from which every ray that meets it returns.
    pub fn solid(shape: Shape, rho: f64) -> Part {
        Part { shape, rho, pass: 0.0 }
    }

    pub fn block(low: [f64; 3], high: [f64; 3], rho: f64) -> Part {
        Part::solid(Shape::block(low, high), rho)
    }

    /// An upright round post.
    pub fn post([x, y]: [f64; 2], radius: f64, [low, high]: [f64; 2], rho: f64) -> Part {
        let shape = Shape::Post {
            x,
            y,
            radius,
            low,
            high,
            swing: 0.0,
        };
        Part::solid(shape, rho)
    }

    /// Pairs of wheels at `axles`, flush with the sides; `tread` is their width, m.
    pub fn wheels(axles: &[f64], radius: f64, half_width: f64, tread: f64, rho: f64) -> Vec<Part> {
        let sides = [[-half_width, -half_width + tread], [half_width - tread, half_width]];
        let wheel = |x: f64, [low, high]: [f64; 2]| {
            let shape = Shape::Wheel {
                x,
                z: radius,
                radius,
                low,
                high,
            };
            Part::solid(shape, rho)
        };
        axles.iter().flat_map(|x| sides.map(|side| wheel(*x, side))).collect()
    }
}

/// A body: its parts, and the box around them.
#[derive(Clone, Debug)]
pub(crate) struct Solid {
    pub low: [f64; 3],
    pub high: [f64; 3],
    parts: Vec<Part>,
    bounds: Vec<Bounds>,
}

/// What a part takes up ahead and up: [x min, −x max, z min, −z max], rounded outwards.
type Bounds = [f32; 4];

fn bounds_of(part: &Part) -> Bounds {
    let (low, high) = part.shape.bounds();
    [low[0], -high[0], low[2], -high[2]].map(|limit| limit as f32 - 1e-4)
}

impl Solid {
    /// A body in the box that its parts span.
    pub fn new(parts: Vec<Part>) -> Self {
        let mut low = [f64::INFINITY; 3];
        let mut high = [f64::NEG_INFINITY; 3];
        assert!(parts.len() <= 32, "a body has at most 32 parts");
        for (a, b) in parts.iter().map(|part| part.shape.bounds()) {
            for k in 0..3 {
                low[k] = low[k].min(a[k]);
                high[k] = high[k].max(b[k]);
            }
        }
        let bounds = parts.iter().map(bounds_of).collect();
        Solid {
            low,
            high,
            parts,
            bounds,
        }
    }

    /// [x min, x max, y min, y max] of the parts that begin below a height.
    pub fn footprint_below(&self, height: f64) -> [f64; 4] {
        let bounds = self
            .parts
            .iter()
            .map(|part| part.shape.bounds())
            .filter(|(low, _)| low[2] < height);
        bounds.fold([f64::MAX, f64::MIN, f64::MAX, f64::MIN], |f, (low, high)| {
            [f[0].min(low[0]), f[1].max(high[0]), f[2].min(low[1]), f[3].max(high[1])]
        })
    }

    /// The first thing that a ray from `origin` meets before `limit`. `chance` is the ray's own hash, which decides
    /// what passes glass and leaves; `stride` in [-1, 1] says how far the legs are apart.
    #[inline]
    pub fn cast(&self, origin: [f64; 3], ray: [f64; 3], limit: f64, chance: u64, stride: f64) -> Option<Hit> {
        let inverse = [1.0 / ray[0], 1.0 / ray[1], 1.0 / ray[2]];
        let (enter, leave, axis) = slab(&self.low, &self.high, &origin, &inverse);
        if !(enter <= leave && leave > 0.0 && enter < limit) {
            return None;
        }
        let mut best: Option<Hit> = None;
        let mut limit = limit;
        let mut left = self.on_the_way(&origin, &ray, enter.max(0.0), leave);
        while left != 0 {
            let index = left.trailing_zeros();
            left &= left - 1;
            let part = &self.parts[index as usize];
            let met = match part.shape {
                // It fills the body's box.
                Shape::Block { .. } | Shape::Facade { .. } if self.parts.len() == 1 => {
                    (enter > 0.0).then(|| (enter, ray[axis].abs()))
                }
                _ => part.shape.cast(&origin, &ray, &inverse, limit, chance, stride),
            };
            let Some((t, cos)) = met else { continue };
            let draw = || unit_of(mix(chance ^ u64::from(index + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)));
            if part.pass > 0.0 && draw() < part.pass {
                continue;
            }
            limit = t;
            best = Some(Hit { t, cos, rho: part.rho });
        }
        if let (
            Some(hit),
            [
                Part {
                    shape: Shape::Facade { .. },
                    ..
                },
            ],
        ) = (&mut best, self.parts.as_slice())
        {
            let at = [0, 1, 2].map(|k| origin[k] + ray[k] * hit.t);
            hit.rho *= window(at);
        }
        best
    }
}

impl Solid {
    /// One bit for each part that the ray can meet between two distances; most parts lie beside it.
    #[inline(always)]
    fn on_the_way(&self, origin: &[f64; 3], ray: &[f64; 3], from: f64, to: f64) -> u32 {
        if self.parts.len() == 1 {
            return 1;
        }
        let ends = |k: usize| {
            let (a, b) = ((origin[k] + ray[k] * from) as f32, (origin[k] + ray[k] * to) as f32);
            if a < b { (a, b) } else { (b, a) }
        };
        let ((x0, x1), (z0, z1)) = (ends(0), ends(2));
        let swept = [x1, -x0, z1, -z0];
        let mut mask = 0;
        for (index, bounds) in self.bounds.iter().enumerate() {
            let meets =
                (bounds[0] <= swept[0]) & (bounds[1] <= swept[1]) & (bounds[2] <= swept[2]) & (bounds[3] <= swept[3]);
            mask |= u32::from(meets) << index;
        }
        mask
    }
}

/// How much of a wall's reflectivity is left where the windows are.
fn window([x, y, z]: [f64; 3]) -> f64 {
    let along = (x + y) * (1.0 / 3.1);
    let up = z * (1.0 / 3.3);
    let inside = (fraction(along) - 0.5).abs() < 0.25 && (fraction(up) - 0.55).abs() < 0.22;
    if inside { 0.12 } else { 1.0 }
}

/// What a number exceeds the integer below it by; without a call to the C library.
#[inline]
pub(crate) fn fraction(v: f64) -> f64 {
    let rest = v - f64::from(v as i32);
    if rest < 0.0 { rest + 1.0 } else { rest }
}

#[cfg(test)]
mod tests {

    use super::*;

    fn unit(v: [f64; 3]) -> [f64; 3] {
        let n = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        v.map(|x| x / n)
    }

    #[test]
    fn each_shape_is_met_where_geometry_says() {
        let block = Shape::Block {
            low: [1.0, -1.0, 0.0],
            high: [3.0, 1.0, 2.0],
        };
        let hull = prism(&[[1.0, 0.0], [3.0, 0.0], [3.0, 2.0], [1.0, 2.0]], 1.0, 1.0);
        let post = Shape::Post {
            x: 2.0,
            y: 0.0,
            radius: 1.0,
            low: 0.0,
            high: 2.0,
            swing: 0.0,
        };
        let wheel = Shape::Wheel {
            x: 2.0,
            z: 1.0,
            radius: 1.0,
            low: -1.0,
            high: 1.0,
        };
        let ball = Shape::Ball {
            center: [2.0, 0.0, 1.0],
            radii: [1.0, 1.0, 1.0],
        };
        type Case<'a> = (&'a Shape, [f64; 3], [f64; 3], Option<(f64, f64)>);
        let cases: [Case; 10] = [
            (&block, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], Some((1.0, 1.0))),
            (&hull, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], Some((1.0, 1.0))),
            (&post, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], Some((1.0, 1.0))),
            (&wheel, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], Some((1.0, 1.0))),
            (&ball, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], Some((1.0, 1.0))),
            (&block, [2.0, 0.0, 5.0], [0.0, 0.0, -1.0], Some((3.0, 1.0))),
            (&hull, [2.0, 0.5, 5.0], [0.0, 0.0, -1.0], Some((3.0, 1.0))),
            (&block, [0.0, 0.0, 3.0], [1.0, 0.0, 0.0], None),
            (&wheel, [0.0, 1.5, 1.0], [1.0, 0.0, 0.0], None),
            (&ball, [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], None),
        ];
        for (shape, origin, ray, expected) in cases {
            let found = shape.cast(&origin, &ray, &ray.map(|r| 1.0 / r), 100.0, 0, 0.0);
            assert_eq!(found, expected, "{shape:?} from {origin:?}");
        }
        let slanted = unit([2.0, 0.3, -1.0]);
        for shape in [&block, &hull, &post, &wheel, &ball] {
            let origin = [0.0, 0.0, 2.0];
            let (t, cos) = shape
                .cast(&origin, &slanted, &slanted.map(|r| 1.0 / r), 100.0, 0, 0.0)
                .unwrap();
            let at = [0, 1, 2].map(|k| origin[k] + slanted[k] * t);
            let (low, high) = shape.bounds();
            assert!(
                (0..3).all(|k| at[k] > low[k] - 1e-9 && at[k] < high[k] + 1e-9),
                "{shape:?}"
            );
            assert!(cos > 0.0 && cos <= 1.0);
        }
    }

    #[test]
    fn glass_lets_its_share_through() {
        let glass = Part {
            shape: Shape::Block {
                low: [1.0; 3].map(|_| -1.0),
                high: [1.0; 3],
            },
            rho: 0.1,
            pass: 0.7,
        };
        let solid = Solid::new(vec![glass]);
        let hits = (0..10_000).filter(|i| {
            solid
                .cast([-5.0, 0.1, 0.2], [1.0, 0.0, 0.0], 50.0, mix(*i), 0.0)
                .is_some()
        });
        let share = hits.count() as f64 / 10_000.0;
        assert!((share - 0.3).abs() < 0.02, "{share}");
    }
}

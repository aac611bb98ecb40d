//! Bodies that rays can hit: a bounding box and the convex parts within it.

use crate::random::{mix, unit_of};

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

#[derive(Clone, Debug)]
pub(crate) enum Shape {
    Block {
        low: [f64; 3],
        high: [f64; 3],
    },
    /// Within all planes `n·p <= d`, given as [nx, ny, nz, d] with unit normals.
    Hull(Vec<[f64; 4]>),
    /// A vertical cylinder; its axis moves forward by `swing` times the body's stride.
    Post {
        x: f64,
        y: f64,
        radius: f64,
        low: f64,
        high: f64,
        swing: f64,
    },
    /// A cylinder across the body.
    Wheel {
        x: f64,
        z: f64,
        radius: f64,
        low: f64,
        high: f64,
    },
    Ball {
        center: [f64; 3],
        radii: [f64; 3],
    },
    /// A ball of leaves: a ray gets `depth` metres into it on average.
    Crown {
        center: [f64; 3],
        radii: [f64; 3],
        depth: f64,
    },
    /// A block whose sides have rows of windows.
    Facade {
        low: [f64; 3],
        high: [f64; 3],
    },
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

/// Where a ray enters and leaves a box, and the axis of the face that it enters through.
#[inline(always)]
fn slab(low: &[f64; 3], high: &[f64; 3], origin: &[f64; 3], inverse: &[f64; 3]) -> (f64, f64, usize) {
    let (mut enter, mut leave, mut axis) = (f64::NEG_INFINITY, f64::INFINITY, 0);
    for k in 0..3 {
        let a = (low[k] - origin[k]) * inverse[k];
        let b = (high[k] - origin[k]) * inverse[k];
        let (near, far) = if a < b { (a, b) } else { (b, a) };
        if near > enter {
            (enter, axis) = (near, k);
        }
        leave = if far < leave { far } else { leave };
    }
    (enter, leave, axis)
}

impl Shape {
    pub fn block(low: [f64; 3], high: [f64; 3]) -> Shape {
        Shape::Block { low, high }
    }

    /// The corners of the box around the shape.
    fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        match self {
            Shape::Block { low, high } | Shape::Facade { low, high } => (*low, *high),
            Shape::Hull(planes) => hull_bounds(planes),
            Shape::Post {
                x,
                y,
                radius,
                low,
                high,
                swing,
            } => {
                let reach = radius + swing.abs();
                ([x - reach, y - radius, *low], [x + reach, y + radius, *high])
            }
            Shape::Wheel {
                x,
                z,
                radius,
                low,
                high,
            } => ([x - radius, *low, z - radius], [x + radius, *high, z + radius]),
            Shape::Ball { center, radii } | Shape::Crown { center, radii, .. } => (
                [0, 1, 2].map(|k| center[k] - radii[k]),
                [0, 1, 2].map(|k| center[k] + radii[k]),
            ),
        }
    }

    /// Where a ray first meets the shape from outside, within (0, `limit`), and the cosine to its normal.
    #[inline]
    fn cast(
        &self,
        origin: &[f64; 3],
        ray: &[f64; 3],
        inverse: &[f64; 3],
        limit: f64,
        chance: u64,
        stride: f64,
    ) -> Option<(f64, f64)> {
        match self {
            Shape::Block { low, high } | Shape::Facade { low, high } => {
                let (enter, leave, axis) = slab(low, high, origin, inverse);
                (enter <= leave && enter > 0.0 && enter < limit).then(|| (enter, ray[axis].abs()))
            }
            Shape::Hull(planes) => cast_hull(planes, origin, ray, limit),
            Shape::Post {
                x,
                y,
                radius,
                low,
                high,
                swing,
            } => {
                let center = [x + swing * stride, *y];
                let along = [[origin[0], origin[1]], [ray[0], ray[1]]];
                cast_cylinder(center, *radius, (*low, *high), along, (origin[2], ray[2]), limit)
            }
            Shape::Wheel {
                x,
                z,
                radius,
                low,
                high,
            } => {
                let along = [[origin[0], origin[2]], [ray[0], ray[2]]];
                cast_cylinder([*x, *z], *radius, (*low, *high), along, (origin[1], ray[1]), limit)
            }
            Shape::Ball { center, radii } => {
                let (enter, _) = ball(center, radii, origin, ray)?;
                let normal: [f64; 3] =
                    [0, 1, 2].map(|k| (origin[k] + ray[k] * enter - center[k]) / (radii[k] * radii[k]));
                let length = (normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]).sqrt();
                let cos = (normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]).abs() / length;
                (enter > 0.0 && enter < limit).then_some((enter, cos))
            }
            Shape::Crown { center, radii, depth } => {
                let (enter, leave) = ball(center, radii, origin, ray)?;
                let t = enter.max(0.0) - depth * libm::log(1.0 - unit_of(mix(chance ^ 0x1eaf)));
                (t < leave && t < limit).then_some((t, 0.6))
            }
        }
    }
}

#[inline]
fn cast_hull(planes: &[[f64; 4]], origin: &[f64; 3], ray: &[f64; 3], limit: f64) -> Option<(f64, f64)> {
    let (mut enter, mut leave, mut cos) = (0.0, limit, 0.0);
    for [nx, ny, nz, d] in planes {
        let slope = nx * ray[0] + ny * ray[1] + nz * ray[2];
        let room = d - (nx * origin[0] + ny * origin[1] + nz * origin[2]);
        if slope == 0.0 {
            if room < 0.0 {
                return None;
            }
            continue;
        }
        let t = room / slope;
        if slope < 0.0 {
            if t > enter {
                (enter, cos) = (t, -slope);
            }
        } else if t < leave {
            leave = t;
        }
        if enter >= leave {
            return None;
        }
    }
    (enter > 0.0).then_some((enter, cos))
}

/// A cylinder around an axis through `center` of a plane, capped at `caps` along the axis. `along`: origin and ray
/// in the plane; `axial`: origin and ray along the axis.
#[inline]
fn cast_cylinder(
    center: [f64; 2],
    radius: f64,
    caps: (f64, f64),
    along: [[f64; 2]; 2],
    axial: (f64, f64),
    limit: f64,
) -> Option<(f64, f64)> {
    let [from, ray] = along;
    let from = [from[0] - center[0], from[1] - center[1]];
    let a = ray[0] * ray[0] + ray[1] * ray[1];
    let b = from[0] * ray[0] + from[1] * ray[1];
    let c = from[0] * from[0] + from[1] * from[1] - radius * radius;
    let discriminant = b * b - a * c;
    if discriminant <= 0.0 || a == 0.0 {
        return None;
    }
    let half = discriminant.sqrt();
    let (side_in, side_out) = ((-b - half) / a, (-b + half) / a);
    let (cap_a, cap_b) = ((caps.0 - axial.0) / axial.1, (caps.1 - axial.0) / axial.1);
    let (cap_in, cap_out) = if cap_a < cap_b { (cap_a, cap_b) } else { (cap_b, cap_a) };
    let outside = axial.1 == 0.0 && !(caps.0..=caps.1).contains(&axial.0);
    let (cap_in, cap_out) = if axial.1 == 0.0 {
        (f64::NEG_INFINITY, f64::INFINITY)
    } else {
        (cap_in, cap_out)
    };
    let enter = side_in.max(cap_in);
    if outside || enter > side_out.min(cap_out) || enter <= 0.0 || enter >= limit {
        return None;
    }
    let cos = if side_in > cap_in { half / radius } else { axial.1.abs() };
    Some((enter, cos.min(1.0)))
}

/// Where a ray enters and leaves an ellipsoid.
#[inline]
fn ball(center: &[f64; 3], radii: &[f64; 3], origin: &[f64; 3], ray: &[f64; 3]) -> Option<(f64, f64)> {
    let (mut a, mut b, mut c) = (0.0, 0.0, -1.0);
    for k in 0..3 {
        let from = (origin[k] - center[k]) / radii[k];
        let step = ray[k] / radii[k];
        a += step * step;
        b += from * step;
        c += from * from;
    }
    let discriminant = b * b - a * c;
    (discriminant > 0.0).then(|| {
        let half = discriminant.sqrt();
        ((-b - half) / a, (-b + half) / a)
    })
}

/// The box around a hull, from the corners in which three of its planes meet.
fn hull_bounds(planes: &[[f64; 4]]) -> ([f64; 3], [f64; 3]) {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    let n = planes.len();
    for i in 0..n {
        for j in i + 1..n {
            for k in j + 1..n {
                let rows = [planes[i], planes[j], planes[k]];
                let matrix = nalgebra::Matrix3::from_fn(|r, c| rows[r][c]);
                let right = nalgebra::Vector3::from_fn(|r, _| rows[r][3]);
                let Some(inverse) = matrix.try_inverse() else { continue };
                let corner = inverse * right;
                let slack = |p: &[f64; 4]| p[0] * corner[0] + p[1] * corner[1] + p[2] * corner[2] - p[3];
                if !corner.iter().all(|c| c.is_finite() && c.abs() < 1e3) || planes.iter().any(|p| slack(p) > 1e-6) {
                    continue;
                }
                for axis in 0..3 {
                    low[axis] = low[axis].min(corner[axis]);
                    high[axis] = high[axis].max(corner[axis]);
                }
            }
        }
    }
    (low, high)
}

/// A solid prism across the body: a convex outline in (x, z), counter-clockwise seen from the right side (x to the
/// right, z up), between `±half_width` at the outline's bottom and `±top` at its top.
pub(crate) fn prism(outline: &[[f64; 2]], half_width: f64, top: f64) -> Shape {
    let bottom_z = outline.iter().map(|p| p[1]).fold(f64::INFINITY, f64::min);
    let top_z = outline.iter().map(|p| p[1]).fold(f64::NEG_INFINITY, f64::max);
    let mut planes = Vec::with_capacity(outline.len() + 2);
    for (i, [x0, z0]) in outline.iter().enumerate() {
        let [x1, z1] = outline[(i + 1) % outline.len()];
        let (nx, nz) = (z1 - z0, x0 - x1);
        let length = (nx * nx + nz * nz).sqrt();
        planes.push([nx / length, 0.0, nz / length, (nx * x0 + nz * z0) / length]);
    }
    let (ny, nz) = (top_z - bottom_z, half_width - top);
    let length = (ny * ny + nz * nz).sqrt();
    let d = (ny * half_width + nz * bottom_z) / length;
    planes.push([0.0, ny / length, nz / length, d]);
    planes.push([0.0, -ny / length, nz / length, d]);
    Shape::Hull(planes)
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

//! Shapes: where a ray meets each.

use crate::random::{mix, unit_of};

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

/// Where a ray enters and leaves a box, and the axis of the face that it enters through.
#[inline(always)]
pub(super) fn slab(low: &[f64; 3], high: &[f64; 3], origin: &[f64; 3], inverse: &[f64; 3]) -> (f64, f64, usize) {
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
    pub(super) fn bounds(&self) -> ([f64; 3], [f64; 3]) {
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
    pub(super) fn cast(
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
pub(super) fn ball(center: &[f64; 3], radii: &[f64; 3], origin: &[f64; 3], ray: &[f64; 3]) -> Option<(f64, f64)> {
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

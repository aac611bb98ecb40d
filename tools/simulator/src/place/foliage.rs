//! Leaves and twigs: a medium that rays get into, and through; and what is hard among them.

use crate::path::Pose2;
use crate::random::{mix, unit_of};
use crate::solid::Hit;

/// Reflectivity of leaves in the near infrared, and the cosine that stands for leaves, which point anywhere.
const RHO: f64 = 0.45;
const COS: f64 = 0.6;
/// Min and max mean depth of a lump, of the foliage's.
const THIN: f64 = 0.3;
const THICK: f64 = 1.7;
/// Lumps along a metre.
const LUMPS: f64 = 3.3;
/// How far lumps may stand back behind the outline, m; not those of what rays get less deep into than `HARD`.
const SETBACK: f64 = 0.15;
const HARD: f64 = 0.02;
/// What is lower than twice this is looked for up to `LOW_REACH`, the rest up to `HIGH_REACH`, m.
const LOW: f64 = 1.0;
const LOW_REACH: f64 = 100.0;
const HIGH_REACH: f64 = 160.0;

/// An upright ball or block of foliage in lumps of about 0.3 m. A ray that enters returns at a depth that is
/// distributed exponentially, with a mean that differs from lump to lump, unless it has left before.
#[derive(Clone, Debug)]
pub(crate) struct Foliage {
    pub center: [f64; 3],
    /// Half the sizes along, across and up, m.
    half: [f32; 3],
    inverse: [f32; 3],
    cos_sin: [f32; 2],
    block: bool,
    /// Mean depth that a ray gets into it: one over its extinction coefficient, m.
    depth: f32,
    /// How far its lumps may stand back, m.
    back: f32,
    /// Tells its lumps from those of others.
    seed: u64,
}

/// What foliage fills, in the frame of the thing that it belongs to.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mass {
    pub center: [f64; 3],
    pub half: [f64; 3],
    pub block: bool,
    pub depth: f64,
    pub seed: u64,
}

impl Foliage {
    /// A mass of a thing that stands at a pose, with its foot at a height.
    pub fn stand(mass: &Mass, pose: Pose2, z: f64) -> Foliage {
        let (sin, cos) = libm::sincos(pose.heading);
        let [u, v, w] = mass.center;
        Foliage {
            center: [pose.x + u * cos - v * sin, pose.y + u * sin + v * cos, z + w],
            half: mass.half.map(|half| half as f32),
            inverse: mass.half.map(|half| (1.0 / half) as f32),
            cos_sin: [cos as f32, sin as f32],
            block: mass.block,
            depth: mass.depth as f32,
            back: if mass.depth < HARD { 0.0 } else { SETBACK as f32 },
            seed: mass.seed,
        }
    }

    /// The same on another day: cut, grown or thinned; `None` if it is gone. It never reaches farther aside.
    pub fn on_day(&self, place: u64, day: u64) -> Option<Foliage> {
        const GONE: f64 = 0.1;
        let draw = |k: u64| unit_of(mix(self.seed ^ mix(place ^ mix(8 * day + k))));
        if draw(0) < GONE {
            return None;
        }
        let [aside, up, dense] = [0.8 + 0.2 * draw(1), 0.85 + 0.25 * draw(2), 0.7 + 0.7 * draw(3)];
        let half = self.half.map(f64::from);
        let mut other = self.clone();
        other.half = [
            (aside * half[0]) as f32,
            (aside * half[1]) as f32,
            (up * half[2]) as f32,
        ];
        other.inverse = other.half.map(|half| 1.0 / half);
        // Its foot stays where it is.
        other.center[2] += (up - 1.0) * half[2];
        if self.depth >= HARD as f32 {
            other.depth = (self.depth * dense as f32).max(HARD as f32);
        }
        other.seed = mix(self.seed ^ mix(day));
        Some(other)
    }

    /// Radius of the circle around it, m.
    pub fn radius(&self) -> f64 {
        let [a, b, _] = self.half.map(f64::from);
        if self.block { (a * a + b * b).sqrt() } else { a.max(b) }
    }

    /// Bounds of the slope of rays that meet it from an eye `distance` away over ground, where its middle is `up` above
    /// the eye; `None` near by, where the corners of its box have to do.
    pub fn slopes(&self, distance: f64, up: f64, slack: f64) -> Option<[f64; 2]> {
        let (wide, high) = (self.radius() + slack, self.rise() + slack);
        if self.block || distance < 3.0 * wide {
            return None;
        }
        // Tangents to an ellipse: (up − m·distance)² = high² + m²·wide².
        let a = distance * distance - wide * wide;
        let root = (up * up * wide * wide + high * high * a).sqrt();
        Some([(up * distance - root) / a, (up * distance + root) / a])
    }

    /// Half its height, m.
    pub fn rise(&self) -> f64 {
        f64::from(self.half[2])
    }

    /// How far it is looked for, m.
    pub fn reach(&self) -> f64 {
        if self.rise() < LOW { LOW_REACH } else { HIGH_REACH }
    }

    /// Where rays get into it and out of it, not before their origin and not behind `limits`: origins, rays and limits
    /// by axis. Who misses it gets in no nearer than out.
    #[inline(always)]
    pub fn crossing<const N: usize>(
        &self,
        origins: &[[f64; N]; 3],
        rays: [&[f64; N]; 3],
        limits: &[f64; N],
    ) -> [[f64; N]; 2] {
        let (mut enters, mut leaves) = ([0.0; N], [0.0; N]);
        let ([x, y, z], [dx, dy, dz]) = (origins, rays);
        if self.block {
            for k in 0..N {
                let [from, step] = self.local::<true>(&[x[k], y[k], z[k]], &[dx[k], dy[k], dz[k]]);
                (enters[k], leaves[k]) = cut(in_block(&from, &step), limits[k]);
            }
        } else {
            for k in 0..N {
                let [from, step] = self.local::<false>(&[x[k], y[k], z[k]], &[dx[k], dy[k], dz[k]]);
                (enters[k], leaves[k]) = cut(in_ball(&from, &step), limits[k]);
            }
        }
        [enters, leaves]
    }

    /// A ray in its frame, in which it reaches from -1 to 1.
    #[inline(always)]
    fn local<const BLOCK: bool>(&self, origin: &[f64; 3], ray: &[f64; 3]) -> [[f64; 3]; 2] {
        let [ia, ib, ic] = self.inverse;
        let (ia, ib, ic) = (f64::from(ia), f64::from(ib), f64::from(ic));
        let (x, y) = (origin[0] - self.center[0], origin[1] - self.center[1]);
        let (mut from, mut step) = ([x, y], [ray[0], ray[1]]);
        // Balls are round from above.
        if BLOCK {
            let (cos, sin) = (f64::from(self.cos_sin[0]), f64::from(self.cos_sin[1]));
            from = [cos * x + sin * y, cos * y - sin * x];
            step = [cos * ray[0] + sin * ray[1], cos * ray[1] - sin * ray[0]];
        }
        [
            [from[0] * ia, from[1] * ib, (origin[2] - self.center[2]) * ic],
            [step[0] * ia, step[1] * ib, ray[2] * ic],
        ]
    }

    /// Where a ray returns that gets in and out at two distances; `chance` is the ray's own hash.
    #[inline]
    pub fn within(&self, origin: &[f64; 3], ray: &[f64; 3], [enter, leave]: [f64; 2], chance: u64) -> Option<Hit> {
        // Nobody needs the lump or the logarithm of a ray that is through: x <= −ln(1 − x).
        let (draw, depth) = (unit_of(mix(chance ^ self.seed)), f64::from(self.depth));
        if draw * depth * THIN > leave - enter {
            return None;
        }
        let [from, step] = match self.block {
            true => self.local::<true>(origin, ray),
            false => self.local::<false>(origin, ray),
        };
        let lump = (0..3).fold(self.seed, |hash, k| {
            let cell = ((from[k] + step[k] * enter) * f64::from(self.half[k]) * LUMPS + 4096.0) as i32 as u64;
            hash.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(cell)
        });
        let lump = mix(lump);
        let depth = depth * (THIN + (THICK - THIN) * (lump & 0xffff) as f64 * (1.0 / 65_536.0));
        let back = f64::from(self.back) * (lump >> 16 & 0xffff) as f64 * (1.0 / 65_536.0);
        if draw * depth > leave - enter {
            return None;
        }
        let t = enter + back - depth * libm::log(1.0 - draw);
        (t < leave).then_some(Hit { t, cos: COS, rho: RHO })
    }

    /// Where a ray returns before `limit`.
    #[cfg(test)]
    pub fn cast(&self, origin: &[f64; 3], ray: &[f64; 3], limit: f64, chance: u64) -> Option<Hit> {
        let [enter, leave] = self.crossing(&origin.map(|v| [v]), ray.each_ref().map(std::array::from_ref), &[limit]);
        (enter[0] < leave[0])
            .then(|| self.within(origin, ray, [enter[0], leave[0]], chance))
            .flatten()
    }
}

/// What is left of a way between the ray's origin and a limit.
#[inline(always)]
fn cut((enter, leave): (f64, f64), limit: f64) -> (f64, f64) {
    (
        if enter > 0.0 { enter } else { 0.0 },
        if leave < limit { leave } else { limit },
    )
}

/// Where a ray gets into the ball and out; if it misses it, out at -1.
#[inline(always)]
fn in_ball(from: &[f64; 3], step: &[f64; 3]) -> (f64, f64) {
    let a = step[0] * step[0] + step[1] * step[1] + step[2] * step[2];
    let b = from[0] * step[0] + from[1] * step[1] + from[2] * step[2];
    let c = from[0] * from[0] + from[1] * from[1] + from[2] * from[2] - 1.0;
    let discriminant = b * b - a * c;
    let (half, inverse) = (discriminant.sqrt(), 1.0 / a);
    let leave = (-b + half) * inverse;
    ((-b - half) * inverse, if discriminant > 0.0 { leave } else { -1.0 })
}

#[inline(always)]
fn in_block(from: &[f64; 3], step: &[f64; 3]) -> (f64, f64) {
    let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
    for k in 0..3 {
        let inverse = 1.0 / step[k];
        let (a, b) = ((-1.0 - from[k]) * inverse, (1.0 - from[k]) * inverse);
        let (near, far) = if a < b { (a, b) } else { (b, a) };
        enter = if near > enter { near } else { enter };
        leave = if far < leave { far } else { leave };
    }
    (enter, leave)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hits(block: bool, depth: f64) -> Vec<f64> {
        let mass = Mass {
            center: [10.0, 0.0, 1.0],
            half: [1.0, 3.0, 1.0],
            block,
            depth,
            seed: 5,
        };
        let pose = Pose2 {
            x: 0.0,
            y: 0.0,
            heading: 0.0,
        };
        let foliage = Foliage::stand(&mass, pose, 0.0);
        let ray = |i: u64| {
            let (y, z) = ((i % 200) as f64 * 0.01 - 1.0, (i / 200) as f64 * 0.02 + 0.5);
            foliage.cast(&[0.0, y, z], &[1.0, 0.0, 0.0], 100.0, mix(i))
        };
        (0..10_000).filter_map(ray).map(|hit| hit.t).collect()
    }

    #[test]
    fn depth_is_exponential_and_some_rays_get_through() {
        for block in [true, false] {
            let found = hits(block, 0.5);
            assert!(found.iter().all(|t| (9.0..11.0).contains(t)));
            // On average a ray gets through lumps of 0.15 to 0.85 m: a few per cent of them past 2 m.
            let through = 1.0 - found.len() as f64 / 10_000.0;
            assert!((0.005..0.15).contains(&through), "{through} got through");
            let mean = found.iter().sum::<f64>() / found.len() as f64 - 9.0;
            assert!((0.3..0.75).contains(&mean), "{mean} m deep");
        }
        assert!(hits(true, 20.0).len() < 2000, "thin foliage lets most rays through");
    }

    #[test]
    fn neighbouring_rays_differ() {
        let found = hits(true, 0.4);
        let off = found
            .windows(3)
            .filter(|t| (t[1] - 0.5 * (t[0] + t[2])).abs() > 0.1)
            .count();
        assert!(off * 2 > found.len(), "{off} of {}", found.len());
    }
}

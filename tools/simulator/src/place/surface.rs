//! What a point of the ground is, looked up: on which side of a kerb, paved or not, painted or not.
//!
//! The signed distance from the kerbs lies in the nodes of a grid and is bilinear between them: kerbs are where it is
//! zero, which for straight ones is exact. Paint is kept as strips, listed for each cell that they touch.

mod crowns;
mod digest;
mod field;
mod kerbs;
mod paint;
mod ribbon;

use super::network::{Node, Road};
use crate::random::{mix, unit_of};
pub(crate) use crowns::Crowns;
use digest::{ASPHALT, GREEN, GROUND_MIXED, PAINTED, PAVING, RAISED, RAISED_MIXED, digest};
use field::Field;
use paint::{Paint, listed, strips};

/// Spacing of the nodes that hold distances, m.
const CELL: f64 = 0.5;
/// Spacing of the nodes that tell open ground, m.
const OPEN_CELL: f64 = 2.0;
/// Distances are kept up to this, m.
const FARTHEST: f64 = 30.0;

/// What the ground is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Ground {
    Asphalt,
    Paving,
    Green,
}

/// How the ground's kinds and heights lie over a place with a network of roads.
pub(crate) struct Surface {
    /// Signed distance from the kerb, positive on the raised side, m; empty where there are no kerbs.
    kerb: Field<f32>,
    kerbs: bool,
    ground: Field<Ground>,
    /// What holds for whole cells of 1 m, so that most looks need nothing else.
    digest: Field<u8>,
    /// Distance from what is paved, m.
    open: Field<f32>,
    /// Paint by cells: `paint[starts[cell]..starts[cell + 1]]`.
    starts: Field<u32>,
    paint: Vec<Paint>,
}

impl Surface {
    /// Looks the plan over once.
    pub fn new(roads: &[Road], nodes: &[Node], kerbs: bool) -> Self {
        let bounds = bounds(roads);
        let corner = nodes.iter().map(|node| node.corner).fold(2.0, f64::max);
        let (kerb, ground) = Self::kerbs(roads, nodes, bounds, corner);
        let open = Self::open(roads, nodes, bounds);
        let (starts, paint) = listed(strips(roads, nodes), bounds);
        Surface {
            digest: digest(&kerb, &ground, &starts),
            kerb,
            kerbs,
            ground,
            open,
            starts,
            paint,
        }
    }

    /// Whether there are kerbs at all.
    #[inline(always)]
    pub fn has_kerbs(&self) -> bool {
        self.kerbs
    }

    /// Whether a point lies on the raised side of a kerb.
    #[inline]
    pub fn raised(&self, x: f64, y: f64) -> bool {
        if !self.kerbs {
            return false;
        }
        match self
            .digest
            .find(x, y)
            .map(|(i, ..)| self.digest.values[i] & RAISED_MIXED)
        {
            Some(RAISED_MIXED) => self.inside_kerb(x, y) > 0.0,
            Some(state) => state == RAISED,
            None => true,
        }
    }

    /// Distance from the kerb, positive on the raised side, m; at most 30 m. Ground far from every road is raised.
    #[inline]
    pub fn inside_kerb(&self, x: f64, y: f64) -> f64 {
        if !self.kerbs {
            return -FARTHEST;
        }
        self.kerb.at(x, y).unwrap_or(FARTHEST)
    }

    /// Distance from the edge of the carriageways, negative upon them, with kerbs or without, m.
    pub fn off_road(&self, x: f64, y: f64) -> f64 {
        self.kerb.at(x, y).unwrap_or(FARTHEST)
    }

    /// Distance of a point from roads and pavements, negative upon them, m; at most 30 m.
    pub fn open_ground(&self, x: f64, y: f64) -> f64 {
        self.open.at(x, y).unwrap_or(FARTHEST)
    }

    /// Reflectivity of the ground at a point, with a speckle of 0.2 m.
    #[inline]
    pub fn reflectivity(&self, x: f64, y: f64) -> f64 {
        let cell = |v: f64| (v * 5.0 + 8192.0) as i32 as u64;
        let hash = mix(cell(x).wrapping_mul(0x9e37_79b9).wrapping_add(cell(y) << 32));
        let speckle = 0.8 + 0.4 * unit_of(hash);
        let green = 0.3 * (2.0 * speckle - 1.0);
        let Some((i, ..)) = self.digest.find(x, y) else {
            return green;
        };
        let digest = self.digest.values[i];
        let ground = match digest & GROUND_MIXED {
            ASPHALT => Ground::Asphalt,
            PAVING => Ground::Paving,
            GREEN => Ground::Green,
            _ => self.nearest_ground(x, y),
        };
        let base = match ground {
            Ground::Asphalt if digest & PAINTED != 0 && self.painted(x, y) => 0.75,
            Ground::Asphalt => 0.14,
            Ground::Paving => 0.28,
            // Grass scatters more than anything that is laid.
            Ground::Green => return green,
        };
        base * speckle
    }

    fn nearest_ground(&self, x: f64, y: f64) -> Ground {
        let Some((i, u, v)) = self.ground.find(x, y) else {
            return Ground::Green;
        };
        self.ground.values[i + usize::from(u > 0.5) + if v > 0.5 { self.ground.columns } else { 0 }]
    }

    #[inline]
    fn painted(&self, x: f64, y: f64) -> bool {
        let Some((cell, ..)) = self.starts.find(x, y) else {
            return false;
        };
        let [from, to] = [self.starts.values[cell], self.starts.values[cell + 1]];
        self.paint[from as usize..to as usize]
            .iter()
            .any(|paint| paint.covers(x, y))
    }
}

/// [x min, y min, x max, y max] of all roads and what lies beside them.
fn bounds(roads: &[Road]) -> [f64; 4] {
    let mut bounds = [f64::MAX, f64::MAX, f64::MIN, f64::MIN];
    for road in roads {
        let reach = road.section.outer(0).max(road.section.outer(1)) + FARTHEST;
        let mut s = 0.0;
        while s <= road.line.length() {
            let pose = road.line.at(s).0;
            bounds[0] = bounds[0].min(pose.x - reach);
            bounds[1] = bounds[1].min(pose.y - reach);
            bounds[2] = bounds[2].max(pose.x + reach);
            bounds[3] = bounds[3].max(pose.y + reach);
            s += 4.0;
        }
    }
    bounds
}

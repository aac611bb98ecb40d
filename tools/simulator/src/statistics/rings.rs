//! Points by the beam that measured them.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use realo_schemas::PointCloud;

/// Step of the histogram that reports beams by their elevations, rad, and points that an occupied bin has at least.
const BIN: f64 = 0.000_35;
const OCCUPIED: usize = 4;
/// Empty bins that separate two beams.
const EMPTY: usize = 3;
/// Sectors in which beams are told apart.
const SECTORS: usize = 24;
/// Points on a ring are neighbours if no more than this lies between them, rad.
const NEIGHBOUR: f64 = 0.0105;

/// A point as its beam sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    pub index: u32,
    /// Counter-clockwise from ahead, rad.
    pub azimuth: f64,
    pub range: f64,
}

/// The points of one beam, or of a sector of its turn, by azimuth.
#[derive(Clone, Debug)]
pub(super) struct Ring {
    /// Median elevation, rad.
    pub elevation: f64,
    /// Number of the sector.
    pub sector: usize,
    pub points: Vec<Seen>,
}

/// The rings of a spinning sensor, from the lowest up; empty if the points do not lie on rings. `points` are relative
/// to the sensor. Beams are recognised by the cloud's own numbers, or by their elevations where it has none.
pub(super) fn rings(cloud: &PointCloud, points: &[[f64; 3]]) -> Vec<Ring> {
    let elevation = |p: &[f64; 3]| libm::atan2(p[2], (p[0] * p[0] + p[1] * p[1]).sqrt());
    let numbered = cloud.ring.iter().any(|ring| *ring != cloud.ring[0]);
    let mut groups: Vec<(usize, Vec<u32>)> = Vec::new();
    if numbered {
        let beams = cloud.ring.iter().max().map_or(0, |ring| usize::from(*ring) + 1);
        groups.resize(beams, (0, Vec::new()));
        for (index, ring) in cloud.ring.iter().enumerate() {
            groups[usize::from(*ring)].1.push(index as u32);
        }
    } else {
        // A cloud that was freed of its own motion has rings that rise and fall around it.
        let mut sectors = vec![Vec::new(); SECTORS];
        for (index, point) in points.iter().enumerate() {
            let turn = (libm::atan2(point[1], point[0]) + PI) / TAU;
            let sector = ((turn * SECTORS as f64) as usize).min(SECTORS - 1);
            sectors[sector].push((elevation(point), index as u32));
        }
        let by_sector = sectors.iter().enumerate();
        groups = by_sector
            .flat_map(|(sector, points)| by_elevation(points).into_iter().map(move |group| (sector, group)))
            .collect();
        let longest = groups.iter().map(|(_, group)| group.len()).max().unwrap_or(0);
        if longest * SECTORS * 4 > points.len() {
            return Vec::new();
        }
    }
    let mut rings: Vec<Ring> = groups
        .iter()
        .filter(|(_, group)| group.len() >= 8)
        .map(|(sector, group)| ring(group, *sector, points))
        .collect();
    rings.sort_by(|a, b| a.elevation.total_cmp(&b.elevation));
    rings
}

/// Groups of points of a sector whose elevations heap up; the others belong to the nearest.
fn by_elevation(sector: &[(f64, u32)]) -> Vec<Vec<u32>> {
    let bins = (PI / BIN) as usize + 1;
    let bin = |elevation: f64| ((elevation + FRAC_PI_2) / BIN) as usize;
    let mut counts = vec![0; bins];
    sector.iter().for_each(|(elevation, _)| counts[bin(*elevation)] += 1);
    let mut heaps: Vec<[usize; 2]> = Vec::new();
    for at in (0..bins).filter(|at| counts[*at] >= OCCUPIED) {
        match heaps.last_mut() {
            Some([_, to]) if at - *to <= EMPTY => *to = at,
            _ => heaps.push([at, at]),
        }
    }
    let mut groups = vec![Vec::new(); heaps.len()];
    for (elevation, index) in sector {
        let at = bin(*elevation);
        let off = |heap: usize| heaps[heap][0].saturating_sub(at).max(at.saturating_sub(heaps[heap][1]));
        let next = heaps.partition_point(|heap| heap[0] <= at);
        let near = (next.saturating_sub(1)..heaps.len().min(next + 1)).min_by_key(|heap| off(*heap));
        if let Some(near) = near.filter(|near| off(*near) <= 4 * EMPTY) {
            groups[near].push(*index);
        }
    }
    groups
}

fn ring(group: &[u32], sector: usize, points: &[[f64; 3]]) -> Ring {
    let mut elevations = Vec::with_capacity(group.len());
    let mut seen: Vec<Seen> = group
        .iter()
        .map(|index| {
            let [x, y, z] = points[*index as usize];
            let level = (x * x + y * y).sqrt();
            elevations.push(libm::atan2(z, level));
            Seen {
                index: *index,
                azimuth: libm::atan2(y, x),
                range: (level * level + z * z).sqrt(),
            }
        })
        .collect();
    elevations.sort_by(f64::total_cmp);
    seen.sort_by(|a, b| a.azimuth.total_cmp(&b.azimuth));
    Ring {
        elevation: elevations[elevations.len() / 2],
        sector,
        points: seen,
    }
}

impl Ring {
    /// How far each point lies from the mean range of its neighbours, m; 0 where one of them is missing.
    pub fn deviations(&self) -> impl Iterator<Item = (u32, f64)> + '_ {
        self.points.windows(3).filter_map(|near| {
            let [before, this, after] = near else { return None };
            let close = this.azimuth - before.azimuth < NEIGHBOUR && after.azimuth - this.azimuth < NEIGHBOUR;
            let off = (this.range - 0.5 * (before.range + after.range)).abs();
            Some((this.index, if close { off } else { 0.0 }))
        })
    }
}

/// The commonest step from one column to the next, rad; `None` without rings.
pub(super) fn column_step(rings: &[Ring]) -> Option<f64> {
    let mut steps: Vec<f64> = rings
        .iter()
        .flat_map(|ring| ring.points.windows(2).map(|pair| pair[1].azimuth - pair[0].azimuth))
        .filter(|step| *step > 1e-5)
        .collect();
    steps.sort_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied()
}

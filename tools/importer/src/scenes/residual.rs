//! How well the clouds of two agents fit each other in the map.

use std::collections::HashMap;
use std::fmt;

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use realo_schemas::PointCloud;
use serde::Serialize;

/// Points count that are so near to both sensors, m.
const REACH: f64 = 50.0;
/// Points count so high over the ground, m: the ground itself fits wherever it is flat.
const ABOVE: [f64; 2] = [0.3, 4.0];
/// Points that are looked up, at most.
const SAMPLE: usize = 2000;
/// Fewer points say nothing.
const LEAST: usize = 100;
/// Edge of a cell, m: a point farther away is not found.
const CELL: f64 = 1.0;
/// Points that are so near to one of the other agent are seen by both, m.
const FITS: f64 = 0.5;
/// Fewer points of both show no place.
const LEAST_COMMON: usize = 30;
/// The place of the poses has so many times the points of both that any other has, or another has them.
const CLEARLY: f64 = 1.2;
/// Other places that are tried: moved by so much in eight directions, m, and turned about the sensor, rad.
const MOVED: [f64; 4] = [0.75, 1.5, 3.0, 5.0];
const TURNED: [f64; 5] = [-0.35, -0.17, 0.0, 0.17, 0.35];
/// Points of the sample of which one is looked up at other places.
const THINNED: usize = 3;

/// How far the points of an agent are from those of another.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Residual {
    /// The two.
    pub agents: [String; 2],
    /// Median distance to the nearest point of the other, m; `None` where most points have none within a metre.
    pub metres: Option<f64>,
    /// Points that were looked up.
    pub points: usize,
    /// What other places of the one to the other say.
    pub fit: Fit,
    /// What to try where they do not fit, in words.
    #[serde(skip)]
    pub advice: &'static str,
}

/// Whether clouds fit best where the poses put them. A median says little of agents that see the same things from different sides.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Fit {
    /// There clearly more points are seen by both than at any other place that was tried.
    Confirmed,
    /// Too little is seen by both, or nearly as much fits elsewhere, as along a straight street.
    Unknown,
    /// Clearly more points are seen by both after a motion of the one about its sensor.
    Elsewhere,
}

impl fmt::Display for Residual {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let [a, b] = &self.agents;
        write!(f, "overlap of `{a}` with `{b}`: ")?;
        match self.metres {
            Some(metres) => write!(f, "median distance of {metres:.2} m")?,
            None => write!(f, "median distance of more than {CELL} m")?,
        }
        write!(f, " over {} points within {REACH} m of both", self.points)?;
        match self.fit {
            Fit::Elsewhere => write!(
                f,
                "; more fits elsewhere, so poses, frames, clocks or the hand are probably wrong: look at a picture of it, and {}",
                self.advice
            ),
            Fit::Confirmed => Ok(()),
            _ if self.metres.is_some_and(|metres| metres <= FITS) => Ok(()),
            Fit::Unknown => write!(
                f,
                "; this does not show whether their poses are right: look at a picture of it; if points are not on the boxes, {}",
                self.advice
            ),
        }
    }
}

/// An agent's points with where it is.
pub struct Placed<'a> {
    /// Name in the log.
    pub name: &'a str,
    /// Its cloud, in the body frame.
    pub cloud: &'a PointCloud,
    /// Where it is.
    pub map_from_body: Isometry3<f64>,
}

impl Placed<'_> {
    /// Points over the ground that are near to both, in the map.
    fn near(&self, other: &Placed) -> Vec<Vector3<f64>> {
        let sensors = [&self.map_from_body, &other.map_from_body].map(|pose| pose.translation.vector);
        let cloud = self.cloud;
        let points = cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter());
        points
            .filter(|(_, z)| (ABOVE[0]..ABOVE[1]).contains(&f64::from(**z)))
            .map(|((x, y), z)| (self.map_from_body * Point3::new(*x, *y, *z).cast::<f64>()).coords)
            .filter(|point| sensors.iter().all(|sensor| (point - sensor).norm() < REACH))
            .collect()
    }
}

/// Points of an agent by cells.
struct Cells<'a>(HashMap<[i64; 3], Vec<&'a Vector3<f64>>>);

impl<'a> Cells<'a> {
    fn new(points: &'a [Vector3<f64>]) -> Self {
        let mut cells = HashMap::<_, Vec<_>>::new();
        for point in points {
            cells.entry(cell(point)).or_default().push(point);
        }
        Cells(cells)
    }

    /// Distance to the nearest point, m; infinite where none is within a cell.
    fn nearest(&self, point: &Vector3<f64>) -> f64 {
        let [x, y, z] = cell(point);
        let around = (0..27_i64).map(|i| [x + i % 3 - 1, y + i / 3 % 3 - 1, z + i / 9 - 1]);
        let found = around.filter_map(|cell| self.0.get(&cell)).flatten();
        found.map(|other| (point - *other).norm()).fold(f64::INFINITY, f64::min)
    }

    /// Whether a point of these cells is within [`FITS`] of this one.
    fn has_near(&self, point: &Vector3<f64>) -> bool {
        let [[x0, y0, z0], [x1, y1, z1]] = [-FITS, FITS].map(|metres| cell(&point.add_scalar(metres)));
        let columns = (x0..=x1).flat_map(|x| (y0..=y1).map(move |y| [x, y]));
        let mut cells = columns.flat_map(|[x, y]| (z0..=z1).map(move |z| [x, y, z]));
        let is_near = |other: &&Vector3<f64>| (point - *other).norm() <= FITS;
        cells.any(|cell| self.0.get(&cell).is_some_and(|points| points.iter().any(is_near)))
    }

    /// What places around those of the poses say; `about` is the sensor of the points.
    fn fit(&self, points: &[Vector3<f64>], about: &Vector3<f64>) -> Fit {
        let common = |[moved, angle, turned]: [f64; 3]| {
            let shift = Vector3::new(moved * libm::cos(angle), moved * libm::sin(angle), 0.0);
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turned);
            let motion = |point: &&Vector3<f64>| self.has_near(&(about + turn * (*point - about) + shift));
            points.iter().step_by(THINNED).filter(motion).count()
        };
        let directions = (0..8).map(|i| f64::from(i) * std::f64::consts::FRAC_PI_4);
        let moves = directions
            .flat_map(|angle| MOVED.map(|moved| [moved, angle]))
            .chain([[0.0; 2]]);
        let motions = moves.flat_map(|[moved, angle]| TURNED.map(|turned| [moved, angle, turned]));
        let others = motions.filter(|[moved, _, turned]| *moved > 0.0 || *turned != 0.0);
        let most = others.map(common).max().unwrap_or_default();
        let here = common([0.0; 3]);
        match (here as f64, most as f64) {
            (here, most) if here.max(most) < LEAST_COMMON as f64 => Fit::Unknown,
            (here, most) if here >= CLEARLY * most => Fit::Confirmed,
            (here, most) if most >= CLEARLY * here => Fit::Elsewhere,
            _ => Fit::Unknown,
        }
    }
}

fn cell(point: &Vector3<f64>) -> [i64; 3] {
    [point.x, point.y, point.z].map(|metres| (metres / CELL).floor() as i64)
}

/// Compares the points of two agents; `None` where they have too little in common. `advice`: what to try where they do not fit.
pub fn residual(a: &Placed, b: &Placed, advice: &'static str) -> Option<Residual> {
    let (ours, theirs) = (a.near(b), b.near(a));
    if ours.len() < LEAST || theirs.len() < LEAST {
        return None;
    }
    let cells = Cells::new(&theirs);
    let every = ours.len().div_ceil(SAMPLE);
    let sample: Vec<Vector3<f64>> = ours.iter().step_by(every).copied().collect();
    let mut distances: Vec<f64> = sample.iter().map(|point| cells.nearest(point)).collect();
    distances.sort_by(f64::total_cmp);
    Some(Residual {
        agents: [a.name.into(), b.name.into()],
        metres: Some(distances[distances.len() / 2]).filter(|metres| *metres <= CELL),
        points: distances.len(),
        fit: cells.fit(&sample, &a.map_from_body.translation.vector),
        advice,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two walls at a right angle, and a post.
    fn walls() -> Vec<Vector3<f64>> {
        let along = (0..800).map(|i| f64::from(i) * 0.025);
        let walls = along.flat_map(|s| [Vector3::new(s, 8.0, 1.0), Vector3::new(12.0, s - 10.0, 1.5)]);
        walls.chain([Vector3::new(3.0, 2.0, 1.0); 20]).collect()
    }

    #[test]
    fn clouds_fit_best_where_their_poses_are_right() {
        let theirs = walls();
        let cells = Cells::new(&theirs);
        assert_eq!(cells.fit(&theirs, &Vector3::zeros()), Fit::Confirmed);
        // What the one sees and the other does not changes nothing.
        let far = (0..2000).map(|i| Vector3::new(-0.02 * f64::from(i), -30.0, 1.0));
        let ours: Vec<_> = theirs.iter().copied().chain(far).collect();
        assert_eq!(cells.fit(&ours, &Vector3::zeros()), Fit::Confirmed);
        let moved: Vec<_> = theirs.iter().map(|point| point + Vector3::new(3.0, 0.0, 0.0)).collect();
        let place = cells.fit(&moved, &Vector3::zeros());
        assert_eq!(place, Fit::Elsewhere);
        // Off the grid of motions, and turned.
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.15);
        let turned: Vec<_> = theirs
            .iter()
            .map(|point| turn * point + Vector3::new(0.3, -2.7, 0.0))
            .collect();
        assert_ne!(cells.fit(&turned, &Vector3::zeros()), Fit::Confirmed);
        // Along one wall nothing shows the place.
        let wall: Vec<_> = (0..4000)
            .map(|i| Vector3::new(0.05 * f64::from(i) - 100.0, 8.0, 1.0))
            .collect();
        assert_eq!(Cells::new(&wall).fit(&wall, &Vector3::zeros()), Fit::Unknown);
        assert_eq!(cells.fit(&moved[..10], &Vector3::zeros()), Fit::Unknown);
    }
}

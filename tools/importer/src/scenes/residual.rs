//! How well the clouds of two agents fit each other in the map.

use std::collections::HashMap;
use std::fmt;

use nalgebra::{Isometry3, Point3, Vector3};
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
/// Above this the clouds do not fit, m: agents see objects from different sides.
const FITS: f64 = 0.5;

/// How far the points of an agent are from those of another.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Residual {
    /// The two.
    pub agents: [String; 2],
    /// Median distance to the nearest point of the other, m; `None` where most points have none within a metre.
    pub metres: Option<f64>,
    /// Points that were looked up.
    pub points: usize,
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
        match self.metres.is_some_and(|metres| metres <= FITS) {
            true => Ok(()),
            false => write!(
                f,
                "; expected below {FITS} m where both see the same: look at a picture of it, and try --handed and --pose-key, or of bags \
                 poses, frames and clocks of the map file"
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

fn cell(point: &Vector3<f64>) -> [i64; 3] {
    [point.x, point.y, point.z].map(|metres| (metres / CELL).floor() as i64)
}

/// Compares the points of two agents; `None` where they have too little in common.
pub fn residual(a: &Placed, b: &Placed) -> Option<Residual> {
    let (ours, theirs) = (a.near(b), b.near(a));
    if ours.len() < LEAST || theirs.len() < LEAST {
        return None;
    }
    let mut cells: HashMap<[i64; 3], Vec<&Vector3<f64>>> = HashMap::new();
    for point in &theirs {
        cells.entry(cell(point)).or_default().push(point);
    }
    let nearest = |point: &Vector3<f64>| {
        let [x, y, z] = cell(point);
        let around = (0..27_i64).map(|i| [x + i % 3 - 1, y + i / 3 % 3 - 1, z + i / 9 - 1]);
        let found = around.filter_map(|cell| cells.get(&cell)).flatten();
        found.map(|other| (point - *other).norm()).fold(f64::INFINITY, f64::min)
    };
    let every = ours.len().div_ceil(SAMPLE);
    let mut distances: Vec<f64> = ours.iter().step_by(every).map(nearest).collect();
    distances.sort_by(f64::total_cmp);
    Some(Residual {
        agents: [a.name.into(), b.name.into()],
        metres: Some(distances[distances.len() / 2]).filter(|metres| *metres <= CELL),
        points: distances.len(),
    })
}

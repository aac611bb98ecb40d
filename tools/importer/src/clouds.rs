//! Clouds of a sweep, in its body frame.

use std::path::Path;

use nalgebra::{Isometry3, Point3};
use realo_schemas::{Nanos, PointCloud};

use crate::ImportError;
use crate::files::read;
use crate::pcd::{Intensities, IntensityFrom, Points, parse_points, seen};

/// Clouds of a side whose brightest intensity says how all of them are scaled, as of the sweeps of a log.
pub const LOOKED_AT: usize = 10;

/// Points of a file, in the frame of the LiDAR.
pub fn read_points(path: &Path) -> Result<Points, ImportError> {
    parse_points(&read(path)?).map_err(|reason| ImportError::content(path, reason))
}

/// A cloud in the body frame whose intensities are as the file has them.
pub struct BodyCloud {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    /// Times as offsets from the stamp, ns.
    time: Vec<i32>,
    intensity: Intensities,
    intensity_from: IntensityFrom,
}

impl BodyCloud {
    /// Brings points into the body frame.
    ///
    /// # Errors
    /// Points or times that are too far from the sensor or the sweep.
    pub fn new(points: Points, stamp: Nanos, body_from_lidar: &Isometry3<f64>) -> Result<Self, String> {
        if points.offset_ns.is_none() {
            points.no_unknown_times()?;
        }
        let n = points.x.len();
        let [mut x, mut y, mut z] = [(); 3].map(|()| Vec::with_capacity(n));
        for ((u, v), w) in points.x.iter().zip(&points.y).zip(&points.z) {
            let point = body_from_lidar * Point3::from(seen([*u, *v, *w])?);
            x.push(point.x as f32);
            y.push(point.y as f32);
            z.push(point.z as f32);
        }
        let time = match (points.offset_ns, points.timestamp) {
            (Some(offsets), _) => offsets,
            (None, None) => vec![0; n],
            (None, Some(times)) => times
                .iter()
                .map(|time| offset(*time, stamp))
                .collect::<Result<Vec<_>, _>>()?,
        };
        Ok(BodyCloud {
            x,
            y,
            z,
            time,
            intensity: points.intensity,
            intensity_from: points.intensity_from,
        })
    }

    /// As the file has them.
    pub fn intensity(&self) -> &Intensities {
        &self.intensity
    }

    /// Where they are from.
    pub fn intensity_from(&self) -> &IntensityFrom {
        &self.intensity_from
    }

    /// As a log has it, and how many intensities were limited to 0…255. `brightest`: the largest of all.
    pub fn scaled(self, brightest: f32) -> Result<(PointCloud, usize), String> {
        let scale = self.intensity.scale(brightest);
        self.scaled_by(scale)
    }

    /// The same with a scale that is known.
    pub fn scaled_by(self, scale: f32) -> Result<(PointCloud, usize), String> {
        let n = self.x.len();
        let (intensity, limited) = self.intensity.to_bytes(scale);
        let cloud = PointCloud::new(self.x, self.y, self.z, intensity, self.time, vec![0u16; n]);
        Ok((cloud.ok_or("columns of different length")?, limited))
    }
}

/// The brightest intensity of a side's first clouds, and by what rule all of them are scaled.
#[derive(Default)]
pub struct Brightest {
    /// Max finite intensity.
    pub most: f32,
    clouds: usize,
    first: Option<(Intensities, IntensityFrom)>,
    /// The largest of the sensors' scale, where it is known.
    range: Option<f32>,
}

impl Brightest {
    /// Of nothing yet; `range`: the largest of the sensors' scale, where it is known.
    pub fn of_range(range: Option<f32>) -> Self {
        Brightest {
            range,
            ..Brightest::default()
        }
    }

    /// Looks at the intensities of a cloud, if it is one of the first.
    pub fn look_at(&mut self, intensity: &Intensities, from: &IntensityFrom) {
        if self.clouds < LOOKED_AT {
            self.clouds += 1;
            self.most = self.most.max(intensity.brightest().unwrap_or(0.0));
            self.first
                .get_or_insert_with(|| (intensity.without_values(), from.clone()));
        }
    }

    /// What intensities are multiplied by.
    pub fn scale(&self, of: &Intensities) -> f32 {
        match (self.range, of) {
            (Some(range), Intensities::Others { .. }) => 255.0 / range,
            _ => of.scale(self.most),
        }
    }

    /// The rule in words.
    pub fn rule(&self) -> String {
        let Some((first, from)) = &self.first else {
            return String::new();
        };
        let rule = match (self.range, first) {
            (Some(range), Intensities::Others { kind, .. }) => format!(
                "{kind} of 0 to {range}: multiplied by {} (--intensity-range)",
                255.0 / range
            ),
            _ => first.rule(self.most, self.clouds),
        };
        match from {
            IntensityFrom::Named => rule,
            IntensityFrom::Other(words) => format!("{words}: {rule}"),
            IntensityFrom::Nothing(fields) => {
                format!("NONE, all are 0: the clouds have {fields}, and no field that is read as intensity")
            }
        }
    }
}

fn offset(time: f64, stamp: Nanos) -> Result<i32, String> {
    // Whole seconds first: the difference of seconds since the epoch would lose digits in the multiplication.
    let (seconds, nanos) = (stamp.div_euclid(1_000_000_000), stamp.rem_euclid(1_000_000_000));
    let offset = (time - seconds as f64) * 1e9 - nanos as f64;
    match offset.abs() < 1e9 {
        true => Ok(offset.round() as i32),
        false => Err(format!(
            "field `timestamp`: a point at {time} s, more than 1 s from the sweep's {stamp} ns"
        )),
    }
}

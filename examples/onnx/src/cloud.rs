//! Points as a network reads them: as they are, or in pillars.

use realo_bev::counters::{EMPTY_SWEEPS, OVER_POINTS};
use realo_methods::detect::pillars::{Dropped, Pillariser, Pillars, Points};
use realo_nn::model::Grid;
use realo_operator::{Counter, Settings};
use realo_schemas::PointCloud;
use serde::{Deserialize, Serialize};

use crate::network::{Input, Network, NetworkError, Wanted};

/// Settings of a network that reads points.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Cloud {
    /// Lower x, y, z and upper x, y, z of the network's grid, m; points outside are left out.
    #[setting(default = [-102.4, -40.0, -3.0, 102.4, 40.0, 5.0])]
    pub range: [f64; 6],
    /// Side of a pillar, m.
    #[setting(default = 0.4, range = 0.01..=10.0)]
    pub cell: f64,
    /// Points that a pillar takes, the first ones.
    #[setting(default = 32, range = 1..=256)]
    pub max_points: usize,
    /// Pillars that a sweep has at most, the first ones.
    #[setting(default = 40_000, range = 1..=1_000_000)]
    pub max_pillars: usize,
    /// Whether the network sees intensities, 0 to 1; otherwise all are 0.
    pub intensity: bool,
    /// Height of the LiDAR above the ground, m, for a network whose z counts from it.
    #[setting(range = -10.0..=10.0)]
    pub lidar_height: f64,
}

/// All points in the grid.
const POINTS: Wanted = Wanted::floats("points", &["points", "4"]).optional();
/// The points of each pillar, zeros behind the last one.
const VOXELS: Wanted = Wanted::floats("voxels", &["pillars", "max_points", "4"]).optional();
/// Where each pillar is: batch (0), z (0), row, column; or without the batch.
const VOXEL_COORDS: Wanted = Wanted::whole("voxel_coords", &["pillars", "4 or 3"]).optional();
/// How many points each pillar has.
const VOXEL_NUM_POINTS: Wanted = Wanted::whole("voxel_num_points", &["pillars"]).optional();

/// What a network may read of a sweep.
pub const INPUTS: &[Wanted] = &[POINTS, VOXELS, VOXEL_COORDS, VOXEL_NUM_POINTS];

/// Counts points outside the grid, or not finite.
pub const OUT_OF_RANGE_POINTS: Counter = Counter::plain(
    "out_of_range_points",
    "points left out: outside the network's grid, or not finite",
);
/// Counts points of pillars beyond the last.
pub const OVER_PILLARS: Counter = Counter::loss(
    "over_pillars",
    "points left out: of pillars beyond the max number of pillars",
    "points were left out, because the network takes no more pillars",
    "raise `max_pillars` if the network was exported for any number of them",
);
/// What stages that read points count.
pub const COUNTERS: &[Counter] = &[EMPTY_SWEEPS, OUT_OF_RANGE_POINTS, OVER_POINTS, OVER_PILLARS];

/// Makes inputs of sweeps.
pub struct Reader {
    settings: Cloud,
    pillariser: Pillariser,
    /// Columns of the pillars' grid.
    columns: usize,
    /// Numbers that say where a pillar is; 0: the network reads points as they are.
    coordinates: usize,
}

/// What a network is given of one sweep.
pub struct Sweep {
    /// Its inputs.
    pub inputs: Vec<(&'static str, Input)>,
    /// What of it was left out.
    pub dropped: Dropped,
    /// Whether nothing is in it.
    pub is_empty: bool,
}

impl Reader {
    /// For the inputs that a network has.
    ///
    /// # Errors
    /// Inputs that do not go together, or sizes that the file fixes and that cannot be.
    pub fn of(network: &Network, settings: Cloud) -> Result<Self, NetworkError> {
        let grid = grid(&settings).map_err(|reason| network.input_error(reason))?;
        let coordinates = coordinates(network, &settings).map_err(|reason| network.input_error(reason))?;
        Ok(Reader {
            pillariser: Pillariser::new(&grid, settings.max_points, settings.max_pillars),
            columns: grid.columns(),
            settings,
            coordinates,
        })
    }

    /// The inputs of a sweep in the body frame.
    pub fn read(&mut self, cloud: &PointCloud) -> Sweep {
        let Cloud {
            intensity,
            lidar_height,
            ..
        } = self.settings;
        let seen: Vec<f32> = match intensity {
            true => cloud.intensity.iter().map(|value| f32::from(*value) / 255.0).collect(),
            false => Vec::new(),
        };
        let lowered: Vec<f32> = match lidar_height {
            0.0 => Vec::new(),
            height => cloud.z.iter().map(|z| z - height as f32).collect(),
        };
        let points = Points {
            x: &cloud.x,
            y: &cloud.y,
            z: if lidar_height == 0.0 { &cloud.z } else { &lowered },
            intensity: intensity.then_some(&seen),
        };
        match self.coordinates {
            0 => self.as_they_are(&points),
            _ => self.in_pillars(&points),
        }
    }

    fn as_they_are(&self, points: &Points) -> Sweep {
        let [x, y, z, far_x, far_y, far_z] = self.settings.range.map(|bound| bound as f32);
        let at = |i: usize| {
            let intensity = points.intensity.map_or(0.0, |intensity| intensity[i]);
            [points.x[i], points.y[i], points.z[i], intensity]
        };
        let inside = |point: &[f32; 4]| {
            let above = [x, y, z].iter().zip(point).all(|(low, number)| number > low);
            above
                && [far_x, far_y, far_z]
                    .iter()
                    .zip(point)
                    .all(|(high, number)| number < high)
        };
        let kept: Vec<[f32; 4]> = (0..points.x.len()).map(at).filter(inside).collect();
        Sweep {
            is_empty: kept.is_empty(),
            dropped: Dropped {
                out_of_range: (points.x.len() - kept.len()) as u64,
                ..Dropped::default()
            },
            inputs: vec![(POINTS.name, Input::floats(&[kept.len(), 4], kept.into_flattened()))],
        }
    }

    fn in_pillars(&mut self, points: &Points) -> Sweep {
        let (slots, columns, coordinates) = (self.settings.max_points, self.columns, self.coordinates);
        let pillars = self.pillariser.run(points);
        let count = pillars.len();
        let (mut voxels, mut places, mut counts) = (vec![0.0; count * slots * 4], Vec::new(), Vec::new());
        for (pillar, slot) in voxels.chunks_exact_mut(slots * 4).enumerate() {
            let own = pillars.points_of(pillar).as_flattened();
            slot[..own.len()].copy_from_slice(own);
            // A pillar's points are at most as many as an i32 counts, and so are a grid's rows and columns.
            counts.push(pillars.points_of(pillar).len() as i32);
            let cell = pillars.cells[pillar] as usize;
            let place = [0, 0, (cell / columns) as i32, (cell % columns) as i32];
            places.extend(&place[4 - coordinates..]);
        }
        let Pillars { dropped, .. } = pillars;
        Sweep {
            is_empty: count == 0,
            dropped: *dropped,
            inputs: vec![
                (VOXELS.name, Input::floats(&[count, slots, 4], voxels)),
                (VOXEL_COORDS.name, Input::whole(&[count, coordinates], places)),
                (VOXEL_NUM_POINTS.name, Input::whole(&[count], counts)),
            ],
        }
    }
}

/// The grid of the settings.
fn grid(settings: &Cloud) -> Result<Grid, String> {
    let [x, y, z, far_x, far_y, far_z] = settings.range;
    let spans = [far_x - x, far_y - y, far_z - z];
    if !spans
        .iter()
        .all(|span| span.is_finite() && *span > 0.0 && *span < 10_000.0)
    {
        return Err(format!(
            "setting `range`: expected lower x, y, z and upper x, y, z, found {:?}",
            settings.range
        ));
    }
    Ok(Grid {
        x: [x, far_x],
        y: [y, far_y],
        z: [z, far_z],
        cell: settings.cell,
    })
}

/// How many numbers say where a pillar is; 0 where the network reads points as they are.
fn coordinates(network: &Network, settings: &Cloud) -> Result<usize, String> {
    let takes = |wanted: Wanted| network.takes(wanted.name);
    match (takes(POINTS), takes(VOXELS), takes(VOXEL_COORDS)) {
        (true, false, false) if !takes(VOXEL_NUM_POINTS) => {
            free(network, POINTS, 1)?;
            Ok(0)
        }
        (false, true, true) => {
            for (wanted, from_last) in [(VOXELS, 2), (VOXEL_COORDS, 1), (VOXEL_NUM_POINTS, 0)] {
                free(network, wanted, from_last)?;
            }
            if let Some(fixed) = network.fixed_input(VOXELS.name, 1)
                && fixed != settings.max_points
            {
                let asked = settings.max_points;
                return Err(format!(
                    "expected `max_points={fixed}`, as `voxels` has them, found {asked}"
                ));
            }
            match network.fixed_input(VOXEL_COORDS.name, 0) {
                None => Ok(4),
                Some(n @ 3..=4) => Ok(n),
                Some(n) => Err(format!("expected {VOXEL_COORDS}, found {n} numbers a pillar")),
            }
        }
        _ => Err(format!(
            "expected {POINTS}, or {VOXELS} and {VOXEL_COORDS}, with {VOXEL_NUM_POINTS} or without"
        )),
    }
}

/// Refuses an input that takes one number of points or pillars only.
fn free(network: &Network, wanted: Wanted, from_last: usize) -> Result<(), String> {
    match network.fixed_input(wanted.name, from_last) {
        Some(fixed) => Err(format!(
            "expected {wanted} for any number of {}, found it for {fixed}: export it with a dynamic dimension",
            wanted.dimensions[wanted.dimensions.len() - 1 - from_last]
        )),
        None => Ok(()),
    }
}

use realo_nn::canvas::Canvas;
use realo_nn::model::Grid;
use realo_nn::pillar_net::{PillarNet, decorate};
use realo_nn::pillars::{Pillariser, Pillars, Points};
use realo_nn::points::{in_range, on_own_body};

use crate::Check;
use crate::vector::{Tensors, Vector, compare, equal};

pub(crate) fn check(name: &str) -> Option<Check> {
    match name {
        "voxelize_basic" | "voxelize_point_limit" | "voxelize_voxel_limit" | "voxelize_edges" => Some(voxelize),
        "pillar_features_c8" | "pillar_features_c16" => Some(pillar_features),
        "points_to_canvas" => Some(points_to_canvas),
        _ => None,
    }
}

const CELL: f64 = 0.4;
const SLOTS: usize = 32;
const BATCH_NORM_EPS: f64 = 1e-3;

fn grid(vector: &Vector) -> Result<Grid, String> {
    let [x0, y0, z0, x1, y1, z1] = vector.setting("range")?;
    Ok(Grid {
        x: [x0, x1],
        y: [y0, y1],
        z: [z0, z1],
        cell: CELL,
    })
}

fn points(tensors: &Tensors, name: &str) -> Result<Vec<[f32; 4]>, String> {
    let single = |row: [f64; 4]| row.map(|number| number as f32);
    Ok(tensors.rows::<4>(name)?.into_iter().map(single).collect())
}

fn pillars(pillariser: &mut Pillariser, points: &[[f32; 4]]) -> Pillars {
    let column = |axis: usize| -> Vec<f32> { points.iter().map(|point| point[axis]).collect() };
    let [x, y, z, intensity] = &[0, 1, 2, 3].map(column);
    let intensity = Some(&intensity[..]);
    pillariser.run(&Points { x, y, z, intensity }).clone()
}

/// The pillars of padded voxels; `rows_columns` of each.
fn ragged(
    voxels: &[[f32; 4]],
    counts: &[f64],
    rows_columns: impl Iterator<Item = [f64; 2]>,
    grid: &Grid,
) -> Result<Pillars, String> {
    let slots = voxels.len() / counts.len().max(1);
    let mut pillars = Pillars::empty();
    for ((voxel, count), [row, column]) in voxels.chunks(slots.max(1)).zip(counts).zip(rows_columns) {
        let taken = voxel
            .get(..*count as usize)
            .ok_or_else(|| format!("a voxel of {slots} slots has {count} points"))?;
        if row >= grid.rows() as f64 || column >= grid.columns() as f64 {
            return Err(format!("voxel ({row}, {column}) lies outside the grid"));
        }
        pillars.cells.push(row as u32 * grid.columns() as u32 + column as u32);
        pillars.points.extend(taken);
        pillars.starts.push(pillars.points.len() as u32);
    }
    Ok(pillars)
}

/// The voxeliser alone, which takes points on the lower limits.
fn voxelize(vector: &Vector) -> Result<(), String> {
    let (tensors, grid) = (vector.tensors()?, grid(vector)?);
    let limit = |key: &str| vector.number(key).map(|number| number as usize);
    let (slots, most) = (limit("max_points_per_voxel")?, limit("max_voxels")?);
    let mut pillariser = Pillariser::new(&grid, slots, most).with_lower_limits();
    let found = pillars(&mut pillariser, &points(&tensors, "in.points")?);
    let coordinates = tensors.rows::<3>("out.coords_zyx")?;
    let places = coordinates.iter().map(|[_, row, column]| [*row, *column]);
    let counts = tensors.numbers("out.num_points")?;
    let expected = ragged(&points(&tensors, "out.voxels")?, &counts, places, &grid)?;
    equal("cells", &found.cells, &expected.cells)?;
    equal("starts", &found.starts, &expected.starts)?;
    equal("points", &found.points, &expected.points)
}

fn net(tensors: &Tensors, grid: &Grid) -> Result<PillarNet, String> {
    let part = |name: &str| tensors.numbers(&format!("param.pfn_layers.0.{name}"));
    let affine = part("norm.weight")?.into_iter().zip(part("norm.bias")?);
    let statistics = part("norm.running_mean")?.into_iter().zip(part("norm.running_var")?);
    let fold = |((weight, bias), (mean, variance)): ((f64, f64), (f64, f64))| {
        let factor = weight / (variance + BATCH_NORM_EPS).sqrt();
        [factor, bias - mean * factor]
    };
    let norm: Vec<[f64; 2]> = affine.zip(statistics).map(fold).collect();
    let linear = tensors.singles("param.pfn_layers.0.linear.weight")?;
    if linear.len() != norm.len() * 10 {
        return Err(format!(
            "the linear layer has {} weights for {} channels",
            linear.len(),
            norm.len()
        ));
    }
    Ok(PillarNet::new(grid, &linear, &norm, Some(SLOTS), true))
}

fn wide(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().copied().map(f64::from).collect()
}

fn pillar_features(vector: &Vector) -> Result<(), String> {
    let (tensors, grid, t) = (vector.tensors()?, grid(vector)?, vector.tolerance()?);
    let counts = tensors.numbers("in.num_points")?;
    let coordinates = tensors.rows::<4>("in.coords_bzyx")?;
    let places = coordinates.iter().map(|[_, _, row, column]| [*row, *column]);
    let pillars = ragged(&points(&tensors, "in.voxels")?, &counts, places, &grid)?;

    let decorated = decorate(&grid, &pillars, true);
    let expected = tensors.rows::<10>("mid.decorated_first16")?;
    for (pillar, slots) in expected.chunks(SLOTS).enumerate().take(pillars.len()) {
        let own = pillars.starts[pillar] as usize..pillars.starts[pillar + 1] as usize;
        let expected = &slots[..own.len()];
        let found = wide(decorated[own].as_flattened());
        compare(
            &format!("features of the points of pillar {pillar}"),
            &found,
            expected.as_flattened(),
            t,
        )?;
    }

    let mut net = net(&tensors, &grid)?;
    let mut canvas = Canvas::new(grid.rows(), grid.columns(), net.channels());
    net.run(&pillars, &mut canvas);
    let cells = pillars.cells.iter().map(|cell| *cell as usize);
    let found = cells.flat_map(|cell| canvas.cell(cell / grid.columns(), cell % grid.columns()));
    compare(
        "pillar_features",
        &wide(&found.copied().collect::<Vec<_>>()),
        &tensors.numbers("out.pillar_features")?,
        t,
    )
}

fn points_to_canvas(vector: &Vector) -> Result<(), String> {
    let (tensors, grid) = (vector.tensors()?, grid(vector)?);
    let matrix = tensors.singles("mid.matrix_agent_to_ego")?;
    if matrix.len() != 16 {
        return Err("the matrix is not 4×4".into());
    }
    let project = |[x, y, z, intensity]: [f32; 4]| {
        let row = |r: usize| matrix[4 * r] * x + matrix[4 * r + 1] * y + matrix[4 * r + 2] * z + matrix[4 * r + 3];
        [row(0), row(1), row(2), intensity]
    };
    let sensor = points(&tensors, "in.points_sensor")?;
    let not_own = |point: &[f32; 4]| !on_own_body(*point, [-1.95, -1.1, 2.95, 1.1]);
    let projected: Vec<[f32; 4]> = sensor.into_iter().filter(not_own).map(project).collect();
    let range = vector.setting::<6>("range")?.map(|limit| limit as f32);
    let within: Vec<[f32; 4]> = projected
        .iter()
        .copied()
        .filter(|point| in_range(*point, range))
        .collect();
    compare(
        "points_in_range",
        &wide(within.as_flattened()),
        &tensors.numbers("mid.points_in_range")?,
        vector.tolerance()?,
    )?;

    // The pillar step masks the range by itself.
    let pillars = pillars(&mut Pillariser::new(&grid, SLOTS, 640_000), &projected);
    let mut net = net(&tensors, &grid)?;
    let mut canvas = Canvas::new(grid.rows(), grid.columns(), net.channels());
    net.run(&pillars, &mut canvas);
    let cells = (0..grid.rows()).flat_map(|row| (0..grid.columns()).map(move |column| (row, column)));
    let found: Vec<f32> = cells
        .flat_map(|(row, column)| canvas.cell(row, column))
        .copied()
        .collect();
    let (expected, _) = tensors.channels_last("out.canvas")?;
    compare("canvas", &wide(&found), &wide(&expected), vector.tolerance()?)
}

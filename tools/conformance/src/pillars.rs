use realo_kernels::canvas::Canvas;
use realo_methods::Model;
use realo_methods::Pillarer;
use realo_methods::detect::pillar_net::{PillarNet, decorate};
use realo_methods::detect::pillars::{Pillariser, Pillars, Points};
use realo_nn::layers::POINT_FEATURES;
use realo_nn::model::Grid;
use realo_nn::weights::Weights;
use realo_schemas::geometry::transform_cloud;

use crate::Kind;
use crate::boxes::without_own_body;
use crate::network::weights_of;
use crate::reference::{SLOTS, any_backbone, grid_of, model_of, transform_of};
use crate::vector::{Tensors, Vector, compare, equal};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(
        &["in.points", "out.voxels", "out.coords_zyx", "out.num_points"],
        voxelize,
    ),
    Kind::new(
        &["in.voxels", "out.pillar_features", "mid.decorated_first16"],
        pillar_features,
    ),
    Kind::new(
        &["in.points_sensor", "mid.matrix_agent_to_ego", "out.canvas"],
        points_to_canvas,
    ),
];

/// The reference's own body: x min, y min, x max, y max, m.
pub(crate) const OWN_BODY: [f32; 4] = [-1.95, -1.1, 2.95, 1.1];

pub(crate) fn points(tensors: &Tensors, name: &str) -> Result<Vec<[f32; 4]>, String> {
    let single = |row: [f64; 4]| row.map(|number| number as f32);
    Ok(tensors.rows::<4>(name)?.into_iter().map(single).collect())
}

pub(crate) fn points_of(pillariser: &mut Pillariser, points: &[[f32; 4]]) -> Pillars {
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

/// The voxeliser behind the range mask: points exactly on the lower limits, which the voxeliser alone takes, are not
/// there.
fn voxelize(vector: &Vector) -> Result<(), String> {
    let (tensors, grid) = (vector.tensors()?, grid_of(vector.setting("range")?));
    let limit = |key: &str| vector.number(key).map(|number| number as usize);
    let (slots, most) = (limit("max_points_per_voxel")?, limit("max_voxels")?);
    let given = points(&tensors, "in.points")?;
    let found = points_of(&mut Pillariser::new(&grid, slots, most), &given);
    let coordinates = tensors.rows::<3>("out.coords_zyx")?;
    let places = coordinates.iter().map(|[_, row, column]| [*row, *column]);
    let counts = tensors.numbers("out.num_points")?;
    let expected = ragged(&points(&tensors, "out.voxels")?, &counts, places, &grid)?;
    let expected = masked(&expected, &grid, &given);
    equal("cells", &found.cells, &expected.cells)?;
    equal("starts", &found.starts, &expected.starts)?;
    equal("points", &found.points, &expected.points)
}

/// Pillars without the points on the grid's lower limits, in the order in which the remaining points touch them.
fn masked(pillars: &Pillars, grid: &Grid, given: &[[f32; 4]]) -> Pillars {
    let lower = [grid.x, grid.y, grid.z].map(|[from, _]| from as f32);
    let inside = |point: &&[f32; 4]| point.iter().zip(lower).all(|(value, limit)| *value > limit);
    let mut left: Vec<(usize, u32, Vec<[f32; 4]>)> = Vec::new();
    for (index, cell) in pillars.cells.iter().enumerate() {
        let points: Vec<[f32; 4]> = pillars.points_of(index).iter().filter(inside).copied().collect();
        if let Some(first) = points.first() {
            let touched = given.iter().position(|point| point == first).unwrap_or(usize::MAX);
            left.push((touched, *cell, points));
        }
    }
    left.sort_by_key(|(touched, ..)| *touched);
    let mut masked = Pillars::empty();
    for (_, cell, points) in left {
        masked.cells.push(cell);
        masked.points.extend(points);
        masked.starts.push(masked.points.len() as u32);
    }
    masked
}

/// A model and weights whose first layer is the vector's.
fn first_layer(vector: &Vector, tensors: &Tensors) -> Result<(Model, Weights), String> {
    let channels = tensors.numbers("param.pfn_layers.0.norm.bias")?.len();
    let model = model_of(grid_of(vector.setting("range")?), channels, any_backbone(1))?;
    let weights = weights_of(&model, tensors, |key| key.strip_prefix("pillar_vfe."))?;
    Ok((model, weights))
}

fn wide(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().copied().map(f64::from).collect()
}

fn pillar_features(vector: &Vector) -> Result<(), String> {
    let (tensors, t) = (vector.tensors()?, vector.tolerance()?);
    let (model, weights) = first_layer(vector, &tensors)?;
    let grid = model.grid;
    let counts = tensors.numbers("in.num_points")?;
    let coordinates = tensors.rows::<4>("in.coords_bzyx")?;
    let places = coordinates.iter().map(|[_, _, row, column]| [*row, *column]);
    let pillars = ragged(&points(&tensors, "in.voxels")?, &counts, places, &grid)?;

    let decorated = decorate(&grid, &pillars, true);
    let expected = tensors.rows::<POINT_FEATURES>("mid.decorated_first16")?;
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

    let net = PillarNet::of(&model, &weights);
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

/// What a sender does before its backbone: own body, transform to the ego's frame, pillars, first layer.
fn points_to_canvas(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (model, weights) = first_layer(vector, &tensors)?;
    let ego_from_agent = transform_of(&tensors.numbers("mid.matrix_agent_to_ego")?)?;
    let given = points(&tensors, "in.points_sensor")?;
    let cloud = transform_cloud(&ego_from_agent, &without_own_body(&given, OWN_BODY)?);
    let intensity: Vec<f32> = cloud.time.iter().map(|index| given[*index as usize][3]).collect();
    let mut pillarer = Pillarer::new(&model, &weights);
    let (canvas, dropped) = pillarer.run(&Points {
        x: &cloud.x,
        y: &cloud.y,
        z: &cloud.z,
        intensity: Some(&intensity),
    });
    let in_range = cloud.len() - dropped.out_of_range as usize;
    equal(
        "number of points in range",
        &[in_range],
        &tensors.shape("mid.points_in_range")?[..1],
    )?;
    let cells = (0..canvas.rows()).flat_map(|row| (0..canvas.columns()).map(move |column| (row, column)));
    let found: Vec<f32> = cells
        .flat_map(|(row, column)| canvas.cell(row, column))
        .copied()
        .collect();
    let (expected, _) = tensors.channels_last("out.canvas")?;
    compare("canvas", &wide(&found), &wide(&expected), vector.tolerance()?)
}

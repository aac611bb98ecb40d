//! BEV maps as networks read and give them: channel by channel, in place of cell by cell.

use arrow_buffer::Buffer;
use realo_fusion::Maps;
use realo_schemas::{DType, FeatureMap};

use crate::network::{Input, Network, NetworkError, Wanted};

/// A map that a network gives, of the ego or of what is fused.
pub const FEATURES: Wanted = Wanted::floats("features", &["1", "channels", "rows", "columns"]);
/// The maps of all agents in the ego's cells, the ego's first.
pub const MAPS: Wanted = Wanted::floats("maps", &["agents", "channels", "rows", "columns"]);
/// 1 where an agent's map has a cell there, else 0.
pub const MASK: Wanted = Wanted::whole("mask", &["agents", "rows", "columns"]).optional();

/// Numbers `[rows, columns, channels]` as `[channels, rows, columns]`.
pub fn planes(cells: &[f32], [rows, columns, channels]: [usize; 3]) -> Vec<f32> {
    turned(cells, rows * columns, channels)
}

/// Numbers `[channels, rows, columns]` as `[rows, columns, channels]`.
pub fn cells(planes: &[f32], [channels, rows, columns]: [usize; 3]) -> Vec<f32> {
    turned(planes, channels, rows * columns)
}

/// A matrix of so many rows and columns, turned; by blocks that stay in the caches.
fn turned(from: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    const BLOCK: usize = 32;
    let mut to = vec![0.0; from.len()];
    for first_row in (0..rows).step_by(BLOCK) {
        for first_column in (0..columns).step_by(BLOCK) {
            for column in first_column..columns.min(first_column + BLOCK) {
                for row in first_row..rows.min(first_row + BLOCK) {
                    to[column * rows + row] = from[row * columns + column];
                }
            }
        }
    }
    to
}

/// The map that a network gives of a sweep, over the range of its grid (m).
///
/// # Errors
/// Cells that are not square.
pub fn of_sweep(
    network: &Network,
    size @ [_, rows, columns]: [usize; 3],
    planes: &[f32],
    range: [f64; 6],
) -> Result<FeatureMap, NetworkError> {
    let [x, y, _, far_x, far_y, _] = range;
    let (along_x, along_y) = ((far_x - x) / columns as f64, (far_y - y) / rows as f64);
    if (along_x - along_y).abs() > 1e-6 * along_x.abs() {
        return Err(network.output_error(format!(
            "expected a map whose cells are square, found {rows} rows over {} m and {columns} columns over {} m: correct the setting \
             `range`",
            far_y - y,
            far_x - x
        )));
    }
    let [channels, rows, columns] = size.map(|n| n as u32);
    Ok(FeatureMap {
        rows,
        columns,
        channels,
        cell: along_x,
        origin: [x, y],
        dtype: DType::F32,
        data: Buffer::from_vec(cells(planes, size)),
        model: network.identity().into(),
        confidence: None,
    })
}

/// Maps of the ego and of collaborators, and where they are there, for so many agents; behind the last one are zeros.
pub fn placed(maps: &Maps, agents: usize) -> [(&'static str, Input); 2] {
    let [rows, columns, channels] = maps.size;
    let (mut numbers, mut mask) = (planes(&maps.ego, maps.size), vec![1; rows * columns]);
    let mut theirs = vec![0.0; maps.ego.len()];
    for map in &maps.others {
        for (cell, to) in theirs.chunks_exact_mut(channels).enumerate() {
            mask.push(i32::from(map.features_at(cell / columns, cell % columns, to)));
        }
        numbers.extend(planes(&theirs, maps.size));
    }
    numbers.resize(agents * maps.ego.len(), 0.0);
    mask.resize(agents * rows * columns, 0);
    [
        (MAPS.name, Input::floats(&[agents, channels, rows, columns], numbers)),
        (MASK.name, Input::whole(&[agents, rows, columns], mask)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_become_planes_and_cells_again() {
        let size = [37, 41, 5];
        let numbers: Vec<f32> = (0..size.iter().product()).map(|at: usize| at as f32).collect();
        let turned = planes(&numbers, size);
        let [rows, columns, channels] = size;
        assert_eq!(
            turned[2 * rows * columns + 3 * columns + 4],
            numbers[(3 * columns + 4) * channels + 2]
        );
        assert_eq!(cells(&turned, [channels, rows, columns]), numbers);
    }
}

//! Warps alone: maps and regions of interest that matrices move.

use realo_kernels::agents::{Agent, placed};
use realo_kernels::bev::BevView;
use realo_kernels::warp::Warp;

use crate::Kind;
use crate::network::{compare_map, wide};
use crate::reference::{cell_of, centered, moved};
use crate::vector::{Tensors, Vector, compare};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["in.x", "in.matrices", "out.warp_bilinear"], warps),
    Kind::new(&["in.agent_mask", "in.matrices", "out.mask_bhw1l"], regions),
    Kind::new(&["in.x_blhwc", "in.matrices", "out.y_blhwc"], corrected),
];

/// Nearer than this to the middle between two cells, in cells, rounding decides which of them is nearest.
const HALF_WAY: f64 = 1e-3;

/// Maps of samples of agents, features last.
pub(crate) struct Maps {
    /// Samples, agents, rows, columns, channels.
    pub shape: [usize; 5],
    data: Vec<f32>,
}

impl Maps {
    pub fn read(tensors: &Tensors, name: &str) -> Result<Maps, String> {
        let found = tensors.shape(name)?;
        let shape = <[usize; 5]>::try_from(&found[..])
            .ok()
            .filter(|sizes| !sizes.contains(&0));
        Ok(Maps {
            shape: shape.ok_or_else(|| format!("`{name}` has shape {found:?}, not five sizes above 0"))?,
            data: tensors.singles(name)?,
        })
    }

    /// The maps, one agent after the other, one sample after the other.
    pub fn views(&self) -> impl Iterator<Item = BevView<'_>> {
        let [_, _, rows, columns, channels] = self.shape;
        let maps = self.data.chunks_exact(rows * columns * channels);
        maps.map(move |data| BevView {
            rows,
            columns,
            channels,
            data,
        })
    }

    /// Compares maps of these sizes with those that were expected.
    pub fn compare(&self, vector: &Vector, tensors: &Tensors, name: &str, found: &[f32]) -> Result<(), String> {
        let expected = tensors.shaped(name, &self.shape)?;
        compare(name, &wide(found), &expected, vector.tolerance()?)
    }
}

/// A map that lies elsewhere than the ego's.
fn lying(map: BevView<'_>, warp: Warp) -> Agent<'_> {
    Agent {
        warp,
        ..Agent::beside(map)
    }
}

/// A region that is 1 where the map of an agent covers cells of its size.
fn region(warp: Warp, [rows, columns]: [usize; 2]) -> Vec<f64> {
    let ones = vec![1.0; rows * columns];
    let map = BevView {
        rows,
        columns,
        channels: 1,
        data: &ones,
    };
    let (_, covered) = placed(&lying(map, warp), [rows, columns]);
    covered
        .into_iter()
        .map(|covered| f64::from(u8::from(covered)))
        .collect()
}

/// The map's cells that are nearest to the ego's, zeros where there is none.
fn nearest(agent: &Agent) -> Vec<f32> {
    let BevView {
        rows,
        columns,
        channels,
        data,
    } = agent.map;
    let none = vec![0.0; channels];
    let cell = |[column, row]: [usize; 2]| &data[(row * columns + column) * channels..][..channels];
    let cells =
        (0..rows * columns).map(|index| agent.nearest(index % columns, index / columns).map_or(&none[..], cell));
    cells.flatten().copied().collect()
}

/// Takes what was expected where rounding decides.
fn allow_half_way<T: Copy>(warp: &Warp, columns: usize, found: &mut [T], expected: &[T], channels: usize) {
    let cells = found.chunks_exact_mut(channels).zip(expected.chunks_exact(channels));
    for (index, (found, expected)) in cells.enumerate() {
        let place = warp.at(index % columns, index / columns);
        if place.iter().any(|at| ((at - at.floor()) - 0.5).abs() < HALF_WAY) {
            found.copy_from_slice(expected);
        }
    }
}

/// Maps as warps about their middle and about their first cell place them, bilinear and nearest, and the regions they cover.
fn warps(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [maps, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let matrices = matrices(&tensors, maps)?;
    let cell = cell_of(&vector.entry.config)?;
    let size = [rows, columns];
    let forward: Vec<Warp> = matrices.iter().map(|matrix| centered(matrix, cell, size)).collect();
    let rows_of = |warps: &[Warp]| warps.iter().flat_map(|warp| warp.0.concat()).collect::<Vec<f64>>();
    let plain: Vec<Warp> = matrices.iter().map(|matrix| moved(matrix, cell)).collect();
    for (name, warps) in [("mid.discretized", &plain), ("mid.centered", &forward)] {
        if vector.entry.has(name) {
            compare(name, &rows_of(warps), &tensors.numbers(name)?, vector.tolerance()?)?;
        }
    }
    let views: Vec<BevView> = crate::fusion::views(&cells, [rows, columns, channels]);
    let agents = |warps: &[Warp]| -> Vec<Agent> {
        let agents = views.iter().zip(warps);
        agents.map(|(map, warp)| lying(*map, warp.inverse())).collect()
    };
    let bilinear = |agents: &[Agent]| -> Vec<f32> {
        let maps = agents.iter().map(|agent| placed(agent, size).0.data);
        maps.flatten().collect()
    };
    let about_middle = agents(&forward);
    compare_map(vector, &tensors, "out.warp_bilinear", &bilinear(&about_middle))?;
    if vector.entry.has("out.warp_bilinear_uncentered") {
        let found = bilinear(&agents(&plain));
        compare_map(vector, &tensors, "out.warp_bilinear_uncentered", &found)?;
    }
    let length = rows * columns;
    if vector.entry.has("out.warp_nearest") {
        let (expected, _) = tensors.channels_last("out.warp_nearest")?;
        let mut found: Vec<f32> = about_middle.iter().flat_map(nearest).collect();
        let pairs = found
            .chunks_exact_mut(length * channels)
            .zip(expected.chunks_exact(length * channels));
        for ((found, expected), agent) in pairs.zip(&about_middle) {
            allow_half_way(&agent.warp, columns, found, expected, channels);
        }
        compare("out.warp_nearest", &wide(&found), &wide(&expected), vector.tolerance()?)?;
    }
    if vector.entry.has("out.roi_mask") {
        let expected = tensors.numbers("out.roi_mask")?;
        let mut found = Vec::new();
        for (agent, expected) in about_middle.iter().zip(expected.chunks_exact(length)) {
            let mut region = region(agent.warp, size);
            allow_half_way(&agent.warp, columns, &mut region, expected, 1);
            found.extend(region);
        }
        compare("out.roi_mask", &found, &expected, vector.tolerance()?)?;
    }
    Ok(())
}

/// `count` matrices of 4x4.
fn matrices(tensors: &Tensors, count: usize) -> Result<Vec<[f64; 16]>, String> {
    let matrices = tensors.rows::<16>("in.matrices")?;
    match matrices.len() == count {
        true => Ok(matrices),
        false => Err(format!(
            "`in.matrices`: expected {count} matrices, found {}",
            matrices.len()
        )),
    }
}

/// Where agents that are there can be asked.
fn regions(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let shape = tensors.shape("out.mask_bhw1l")?;
    let [samples, rows, columns, 1, agents] = shape[..] else {
        return Err(format!(
            "`out.mask_bhw1l` has shape {shape:?}, not samples, rows, columns, 1, agents"
        ));
    };
    let there = tensors.shaped("in.agent_mask", &[samples, agents])?;
    let expected = tensors.numbers("out.mask_bhw1l")?;
    let mut found = vec![0.0; expected.len()];
    let cell = cell_of(&vector.entry.config)?;
    for (index, matrix) in matrices(&tensors, samples * agents)?.iter().enumerate() {
        let (sample, agent) = (index / agents, index % agents);
        let warp = centered(matrix, cell, [rows, columns]).inverse();
        let places = (0..rows * columns).map(|cell| (sample * rows * columns + cell) * agents + agent);
        let wanted: Vec<f64> = places.clone().map(|place| expected[place]).collect();
        let mut region: Vec<f64> = region(warp, [rows, columns])
            .iter()
            .map(|one| one * there[index])
            .collect();
        allow_half_way(&warp, columns, &mut region, &wanted, 1);
        places.zip(region).for_each(|(place, one)| found[place] = one);
    }
    compare("out.mask_bhw1l", &found, &expected, vector.tolerance()?)
}

/// Maps of agents corrected by their matrices; the ego's, the first of each sample, stays.
fn corrected(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let maps = Maps::read(&tensors, "in.x_blhwc")?;
    let [samples, agents, rows, columns, _] = maps.shape;
    let cell = cell_of(&vector.entry.config)?;
    let matrices = matrices(&tensors, samples * agents)?;
    let mut found = Vec::new();
    for (index, (map, matrix)) in maps.views().zip(&matrices).enumerate() {
        let warp = match index % agents {
            0 => Warp::IDENTITY,
            _ => centered(matrix, cell, [rows, columns]).inverse(),
        };
        found.extend(placed(&lying(map, warp), [rows, columns]).0.data);
    }
    maps.compare(vector, &tensors, "out.y_blhwc", &found)
}

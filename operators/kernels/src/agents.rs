//! Agents' maps, brought to the cells of the ego's.

use crate::bev::{BevMap, BevView};
use crate::conv::{Pool, split};
use crate::simd::dispatch;
use crate::warp::{Warp, nearest};

/// An agent's part of a fusion.
#[derive(Clone, Copy, Debug)]
pub struct Agent<'a> {
    /// Its map.
    pub map: BevView<'a>,
    /// How sure it is of each cell, `[rows, columns]`: it takes no part where it is 0. `None`: all cells are there.
    pub confidence: Option<&'a [f32]>,
    /// From the ego's cells to the map's.
    pub warp: Warp,
    /// Whether it is a roadside unit, not a vehicle.
    pub roadside: bool,
    /// How old its map is beside the ego's, in frames of 0.1 s.
    pub delay: usize,
}

impl<'a> Agent<'a> {
    /// A vehicle whose map lies as the ego's does, of the same time.
    pub fn beside(map: impl Into<BevView<'a>>) -> Self {
        Agent {
            map: map.into(),
            confidence: None,
            warp: Warp::IDENTITY,
            roadside: false,
            delay: 0,
        }
    }

    /// The same agent with another map.
    pub fn with<'b>(&self, map: &'b BevMap) -> Agent<'b>
    where
        'a: 'b,
    {
        Agent {
            map: map.into(),
            ..*self
        }
    }

    /// Column and row of its map's cell that is nearest to a cell of the ego's: the one that says whether the map covers it.
    pub fn nearest(&self, column: usize, row: usize) -> Option<[usize; 2]> {
        nearest(self.warp.at(column, row), [self.map.columns, self.map.rows])
    }
}

/// An agent's map in the ego's cells, `[rows, columns]` of them, as every fusion takes it; and which of them it covers.
pub fn placed(agent: &Agent, size: [usize; 2]) -> (BevMap, Vec<bool>) {
    let mut placer = Placer::new(1);
    placer.place(agent, size);
    (placer.map, placer.covered)
}

/// One agent's map after the other in the ego's cells, in the same memory.
pub struct Placer {
    pool: Pool,
    map: BevMap,
    covered: Vec<bool>,
}

impl Placer {
    /// With so many threads, the caller's included.
    pub fn new(threads: usize) -> Self {
        Placer {
            pool: Pool::new(threads),
            map: BevMap {
                rows: 0,
                columns: 0,
                channels: 0,
                data: Vec::new(),
            },
            covered: Vec::new(),
        }
    }

    /// An agent's map in `[rows, columns]` cells of the ego, and which of them it covers.
    pub fn place(&mut self, agent: &Agent, size: [usize; 2]) -> (&BevMap, &[bool]) {
        let map = &mut self.map;
        ([map.rows, map.columns], map.channels) = (size, agent.map.channels);
        place(agent, size, None, &mut map.data, &mut self.covered, &mut self.pool);
        (&self.map, &self.covered)
    }
}

/// Takes an agent's map in `[rows, columns]` cells of the ego; `added` is added to each of the map's own cells.
pub fn place(
    agent: &Agent,
    [rows, columns]: [usize; 2],
    added: Option<&[f32]>,
    map: &mut Vec<f32>,
    covered: &mut Vec<bool>,
    pool: &mut Pool,
) {
    let length = columns * agent.map.channels;
    map.resize(rows * length, 0.0);
    covered.resize(rows * columns, false);
    let maps = split(map, length, rows, pool.threads(), 1);
    let covers = split(covered, columns, rows, pool.threads(), 1);
    pool.each(maps.into_iter().zip(covers).collect(), |(map, covers)| {
        let rows = map
            .data
            .chunks_exact_mut(length)
            .zip(covers.data.chunks_exact_mut(columns));
        for (row, (to, covered)) in map.range.zip(rows) {
            place_row(agent, row, added, to, covered);
        }
    });
}

dispatch! {
    fn place_row(agent: &Agent, row: usize, added: Option<&[f32]>, to: &mut [f32], covered: &mut [bool]) {
        let cells = to.chunks_exact_mut(agent.map.channels).zip(covered);
        for (column, (to, covered)) in cells.enumerate() {
            *covered = sample(agent, column, row, added, to);
        }
    }
}

/// The features of an agent's map at a cell of the ego's, bilinear between the four cells around, zeros outside the map;
/// `added` is added to each of the map's cells. Whether the map covers the cell: the nearest of its own is one. Of a map that
/// has not all of its cells those that are there are weighed, and there are zeros where it does not cover.
#[inline(always)]
pub fn sample(agent: &Agent, column: usize, row: usize, added: Option<&[f32]>, to: &mut [f32]) -> bool {
    let (map, channels) = (agent.map, to.len());
    let place = agent.warp.at(column, row);
    let size = [map.columns, map.rows];
    let is_there = |column: usize, row: usize| {
        let confidence = agent.confidence;
        confidence.is_none_or(|confidence| confidence[row * map.columns + column] > 0.0)
    };
    let near = |axis: usize| (-1.0..size[axis] as f64).contains(&place[axis]);
    let covered = nearest(place, size).is_some_and(|[column, row]| is_there(column, row));
    if !(near(0) && near(1)) || (agent.confidence.is_some() && !covered) {
        to.fill(0.0);
        return false;
    }
    let corners = corners(place, size).map(|corner| {
        let (column, row, weight) = corner.filter(|(column, row, _)| is_there(*column, *row))?;
        Some((&map.data[(row * map.columns + column) * channels..][..channels], weight))
    });
    match (corners, added) {
        ([Some(a), Some(b), Some(c), Some(d)], None) => {
            let numbers = a.0.iter().zip(b.0).zip(c.0).zip(d.0);
            for ((((from_a, from_b), from_c), from_d), to) in numbers.zip(to) {
                *to = from_a * a.1 + from_b * b.1 + from_c * c.1 + from_d * d.1;
            }
        }
        ([Some(a), Some(b), Some(c), Some(d)], Some(added)) => {
            let numbers = a.0.iter().zip(b.0).zip(c.0).zip(d.0).zip(added);
            for (((((from_a, from_b), from_c), from_d), added), to) in numbers.zip(to) {
                let [from_a, from_b, from_c, from_d] = [from_a, from_b, from_c, from_d].map(|from| from + added);
                *to = from_a * a.1 + from_b * b.1 + from_c * c.1 + from_d * d.1;
            }
        }
        (corners, added) => {
            to.fill(0.0);
            for (from, weight) in corners.into_iter().flatten() {
                match added {
                    Some(added) => {
                        let numbers = to.iter_mut().zip(from).zip(added);
                        numbers.for_each(|((to, from), added)| *to += (from + added) * weight);
                    }
                    None => to.iter_mut().zip(from).for_each(|(to, from)| *to += from * weight),
                }
            }
            if agent.confidence.is_some() {
                let there: f32 = corners.iter().flatten().map(|(_, weight)| weight).sum();
                to.iter_mut().for_each(|to| *to *= 1.0 / there);
            }
        }
    }
    covered
}

/// The cells of a map of `[columns, rows]` around a place near it, as column, row and bilinear weight; those that count.
#[inline(always)]
fn corners(place: [f64; 2], size: [usize; 2]) -> [Option<(usize, usize, f32)>; 4] {
    let first = place.map(f64::floor);
    let part = [0, 1].map(|axis| (place[axis] - first[axis]) as f32);
    CORNERS.map(|corner| {
        let weight = |axis: usize| match corner[axis] {
            1 => part[axis],
            _ => 1.0 - part[axis],
        };
        let cell = [0, 1].map(|axis| first[axis] as isize + corner[axis]);
        let inside = |axis: usize| usize::try_from(cell[axis]).ok().filter(|cell| *cell < size[axis]);
        let (column, row) = (inside(0)?, inside(1)?);
        let weight = weight(0) * weight(1);
        (weight != 0.0).then_some((column, row, weight))
    })
}

/// Leads the gradient of what [`sample`] gave for each of the ego's cells, `[rows, columns, channels]`, back to the cells of an
/// agent's map, of which all are there: adds it to `to`.
pub fn lead_back(agent: &Agent, columns: usize, gradient: &[f32], to: &mut [f32]) {
    let (map, channels) = (agent.map, agent.map.channels);
    let size = [map.columns, map.rows];
    for (index, gradient) in gradient.chunks_exact(channels).enumerate() {
        let place = agent.warp.at(index % columns, index / columns);
        let near = |axis: usize| (-1.0..size[axis] as f64).contains(&place[axis]);
        if !(near(0) && near(1)) {
            continue;
        }
        for (column, row, weight) in corners(place, size).into_iter().flatten() {
            let to = &mut to[(row * map.columns + column) * channels..][..channels];
            to.iter_mut()
                .zip(gradient)
                .for_each(|(to, gradient)| *to += gradient * weight);
        }
    }
}

/// The cells around a place, as columns and rows from the first.
const CORNERS: [[isize; 2]; 4] = [[0, 0], [1, 0], [0, 1], [1, 1]];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn between_the_outermost_cells_and_nowhere_a_map_fades_and_half_a_cell_further_it_does_not_count() {
        let ones = BevMap {
            rows: 3,
            columns: 4,
            channels: 1,
            data: vec![1.0; 12],
        };
        let at = |shift: f64| {
            let agent = Agent {
                warp: Warp([[1.0, 0.0, shift], [0.0, 1.0, 0.0]]),
                ..Agent::beside(&ones)
            };
            let mut to = [9.0];
            (sample(&agent, 0, 1, Some(&[1.0]), &mut to), to[0])
        };
        assert_eq!([at(0.0), at(3.0), at(1.5)], [(true, 2.0); 3]);
        assert_eq!([at(-0.25), at(3.25)], [(true, 1.5); 2]);
        assert_eq!([at(-0.75), at(3.75)], [(false, 0.5); 2]);
        assert_eq!([at(-1.5), at(4.0), at(f64::NAN)], [(false, 0.0); 3]);
    }
}

//! A block: attention over agents, then within windows; workers take bands of the map through it, tile by tile.

use realo_kernels::cells::line;
use realo_kernels::conv::Map;
use realo_kernels::number::Number;

use super::agents::OverAgents;
use super::forward::Forward;
use super::state::{Asked, State};
use super::tiles::{Crew, Tile, Tiles, Worker};
use super::windows::{OverWindows, add_counted, sum_up};

pub struct Block<E> {
    pub agents: OverAgents<E>,
    pub windows: OverWindows<E>,
}

/// Rows of a tile's height of all agents' maps.
struct Band<'a, E> {
    asking: Vec<Asking<'a, E>>,
    others: Vec<Answering<'a>>,
}

/// An agent that asks, and is asked.
struct Asking<'a, E> {
    kind: usize,
    map: &'a mut [f32],
    covered: &'a [bool],
    /// By size of windows: what attention gave, `[rows, columns, stored]`.
    made: Vec<&'a mut [E]>,
    /// By channel: all that was made, added up.
    sums: Vec<f32>,
}

/// An agent that is asked only.
struct Answering<'a> {
    kind: usize,
    map: &'a [f32],
    covered: &'a [bool],
}

impl<E: Number> Block<E> {
    /// Adds what attention gives to the maps of those who ask, the first ones, and then what the feed-forward makes of them, if
    /// one follows. `made` has maps for each of those who ask and each size of windows.
    pub fn run(
        &self,
        tiles: Tiles,
        states: &mut [State],
        made: &mut [Vec<Vec<E>>],
        forward: Option<&Forward<E>>,
        crew: &mut Crew<E>,
    ) {
        let means = self.attend(tiles, states, made, crew);
        let counts: Vec<Vec<f32>> = means.iter().map(|mean| self.windows.split.counts(mean)).collect();
        self.conclude(tiles, states, made, (&counts, forward), crew);
    }

    /// Adds attention over agents, and writes what windows of each size give to `made`. Returns the mean over the map of all
    /// that they gave, by who asks.
    pub fn attend(
        &self,
        tiles: Tiles,
        states: &mut [State],
        made: &mut [Vec<Vec<E>>],
        crew: &mut Crew<E>,
    ) -> Vec<Vec<f32>> {
        let asking = 0..made.len();
        let mut bands = bands(tiles, states, made);
        crew.each(&mut bands, |band, worker| {
            tiles.across().for_each(|tile| band.attend(self, tile, worker));
        });
        // A sum for each band, so that threads change no order.
        let means = asking.map(|asks| {
            let sums: Vec<&[f32]> = bands.iter().map(|band| &band.asking[asks].sums[..]).collect();
            mean(&sums, tiles.cells())
        });
        means.collect()
    }

    /// Adds what windows gave, by how much each size counts, and what the feed-forward makes of it.
    pub fn conclude(
        &self,
        tiles: Tiles,
        states: &mut [State],
        made: &mut [Vec<Vec<E>>],
        (counts, forward): (&[Vec<f32>], Option<&Forward<E>>),
        crew: &mut Crew<E>,
    ) {
        crew.each(&mut bands(tiles, states, made), |band, worker| {
            tiles
                .across()
                .for_each(|tile| band.conclude(tile, counts, forward, worker));
        });
    }
}

fn bands<'a, E: Number>(tiles: Tiles, states: &'a mut [State], made: &'a mut [Vec<Vec<E>>]) -> Vec<Band<'a, E>> {
    let count = tiles.bands();
    let empty = || Band {
        asking: Vec::new(),
        others: Vec::new(),
    };
    let mut bands: Vec<Band<E>> = std::iter::repeat_with(empty).take(count).collect();
    let (asking, others) = states.split_at_mut(made.len());
    for (index, (state, made)) in asking.iter_mut().zip(made).enumerate() {
        let (length, channels) = (state.map.len() / count, state.map.len() / tiles.cells());
        let covered = state.covered.chunks_exact(state.covered.len() / count);
        for (band, (map, covered)) in bands.iter_mut().zip(state.map.chunks_exact_mut(length).zip(covered)) {
            band.asking.push(Asking {
                kind: state.kind,
                map,
                covered,
                made: Vec::new(),
                sums: vec![0.0; channels],
            });
        }
        for made in made {
            let length = made.len() / count;
            for (band, made) in bands.iter_mut().zip(made.chunks_exact_mut(length)) {
                band.asking[index].made.push(made);
            }
        }
    }
    for state in others {
        let maps = state.map.chunks_exact(state.map.len() / count);
        let parts = maps.zip(state.covered.chunks_exact(state.covered.len() / count));
        for (band, (map, covered)) in bands.iter_mut().zip(parts) {
            band.others.push(Answering {
                kind: state.kind,
                map,
                covered,
            });
        }
    }
    bands
}

impl<E: Number> Band<'_, E> {
    /// Adds attention over agents, and makes what windows give.
    fn attend(&mut self, block: &Block<E>, tile: Tile, worker: &mut Worker<E>) {
        let asking = self.asking.iter().map(|agent| (agent.kind, agent.covered));
        let all = asking.chain(self.others.iter().map(|agent| (agent.kind, agent.covered)));
        let covers = all.map(|(kind, covered)| (kind, tile.lines(covered, 1).flatten().copied().collect()));
        let covers: Vec<(usize, Vec<bool>)> = covers.collect();
        let asked = covers.iter().map(|(kind, covered)| Asked { kind: *kind, covered });
        let asked: Vec<Asked> = asked.collect();

        let asking = self.asking.iter().map(|agent| &*agent.map);
        let maps = asking.chain(self.others.iter().map(|agent| agent.map));
        let normed: Vec<Map<E>> = maps.map(|map| block.agents.norm.run(tile, map, worker)).collect();
        for (asks, agent) in self.asking.iter_mut().enumerate() {
            let given = block.agents.ask(&asked, &normed, asks, worker);
            tile.add(line(&given), given.channels, agent.map);
            worker.keep_single([given]);
        }
        worker.keep_own(normed);
        for agent in &mut self.asking {
            let given = block.windows.run(tile, agent.map, worker);
            for (given, to) in given.iter().zip(&mut agent.made) {
                let lines = line(given).chunks_exact(tile.columns * given.stored);
                lines
                    .zip(tile.lines_mut(to, given.stored))
                    .for_each(|(given, to)| to.copy_from_slice(given));
                sum_up(line(given), given.stored, &mut agent.sums);
            }
            worker.keep_own(given);
        }
    }

    /// Adds what windows gave, each by how much it counts, then feed-forward.
    fn conclude(&mut self, tile: Tile, counts: &[Vec<f32>], forward: Option<&Forward<E>>, worker: &mut Worker<E>) {
        for (agent, counts) in self.asking.iter_mut().zip(counts) {
            let channels = agent.sums.len();
            let stored = channels.next_multiple_of(E::PER_UNIT);
            for (made, counts) in agent.made.iter().zip(counts.chunks_exact(channels)) {
                for (made, to) in tile.lines(made, stored).zip(tile.lines_mut(agent.map, channels)) {
                    add_counted(made, stored, counts, to);
                }
            }
            if let Some(forward) = forward {
                let given = forward.run(tile, agent.map, worker);
                tile.add(line(&given), channels, agent.map);
                worker.keep_single([given]);
            }
        }
    }
}

/// The mean over cells, from sums over some of them each.
pub fn mean(sums: &[&[f32]], cells: usize) -> Vec<f32> {
    let mut mean = vec![0.0f32; sums[0].len()];
    for sums in sums {
        mean.iter_mut().zip(*sums).for_each(|(mean, sum)| *mean += sum);
    }
    mean.iter_mut().for_each(|mean| *mean /= cells as f32);
    mean
}

//! The fusion of V2VNet: agents send each other messages for some rounds, and a gated unit takes them in.
//!
//! The unit forgets everything between rounds, so of its weights only those on its inputs count; in the last round only the
//! ego listens.

use realo_kernels::agents::{Agent, sample};
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::cells::{Linear, cells, each_cell, packed, run};
use realo_kernels::conv::{Isa, Map, Pool, Rows, split};
use realo_kernels::number::Number;
use realo_nn::weights::Weights;

use super::keys::{NET, UNIT};
use super::unit::{GatedUnitTensors, Unit};
use crate::method::Fuse;

/// A fusion that is ready to run; maps are computed in `E`, what is added up in f32.
pub struct Messages<E> {
    rounds: usize,
    channels: usize,
    /// Of the sender's map and the receiver's.
    message: Linear<E>,
    /// Takes the receiver's map and the mean message.
    unit: Unit<E>,
    output: Linear<E>,
}

impl<E: Number> Messages<E> {
    /// The messages on maps of so many channels.
    pub fn new(rounds: usize, channels: usize, weights: &Weights, isa: Isa) -> Self {
        let bias = |key: &str| weights.tensor(&format!("{key}.bias")).to_vec();
        let kernels = |key: &str| weights.tensor(&format!("{key}.weight"));
        let message = format!("{NET}.msg_cnn");
        let [gates, candidate] = ["conv_gates", "conv_can"].map(|layer| {
            let key = format!("{UNIT}.{layer}");
            [kernels(&key), weights.tensor(&format!("{key}.bias"))]
        });
        let unit = GatedUnitTensors {
            inputs: 2 * channels,
            channels,
            kernel: 3,
            gates,
            candidate,
        };
        let mlp = format!("{NET}.mlp");
        Messages {
            rounds,
            channels,
            message: packed(kernels(&message).to_vec(), bias(&message), [2 * channels, 3], isa),
            unit: Unit::forgetful(&unit, isa),
            output: packed(kernels(&mlp).to_vec(), bias(&mlp), [channels, 1], isa),
        }
    }

    /// An agent's map after the messages of all, its own among them.
    fn listen(&self, agents: &[Agent], index: usize, pool: &mut Pool) -> BevMap {
        let (own, channels) = (agents[index].map, self.channels);
        let (rows, columns) = (own.rows, own.columns);
        let mut mean: Map<f32> = Map::new(rows, columns, channels);
        let to_ego = agents[index].warp.inverse();
        for agent in agents {
            let sender = Agent {
                warp: agent.warp.after(&to_ego),
                ..*agent
            };
            let (both, covered) = self.beside(&sender, own, pool);
            let message = run(&self.message, &both, channels, pool);
            let (message, share) = (message.view(), 1.0 / agents.len() as f32);
            each_cell(&mut mean, 1, pool, |row, to| {
                let from = cells(&message, row).chunks_exact(channels);
                let covered = &covered[row * columns..];
                for ((from, to), covered) in from.zip(to.chunks_exact_mut(channels)).zip(covered) {
                    if *covered {
                        to.iter_mut().zip(from).for_each(|(to, from)| *to += from * share);
                    }
                }
            });
        }
        let mut inputs: Map<E> = Map::new(rows, columns, 2 * channels);
        let (stored, view) = (inputs.stored, mean.view());
        each_cell(&mut inputs, 1, pool, |row, to| {
            let own = own.data[row * columns * channels..].chunks_exact(channels);
            let mean = cells(&view, row).chunks_exact(channels);
            for ((own, mean), to) in own.zip(mean).zip(to.chunks_exact_mut(stored)) {
                let from = own.iter().chain(mean);
                from.zip(to).for_each(|(from, to)| *to = E::from_f32(*from));
            }
        });
        let taken = self.unit.run(&inputs, None, pool);
        BevMap {
            rows,
            columns,
            channels,
            data: taken.to_f32(pool),
        }
    }

    /// A sender's map in the receiver's cells, and the receiver's; where the sender's reaches.
    fn beside(&self, sender: &Agent, own: BevView, pool: &mut Pool) -> (Map<E>, Vec<bool>) {
        let (rows, columns, channels) = (own.rows, own.columns, self.channels);
        let mut both: Map<E> = Map::new(rows, columns, 2 * channels);
        let mut covered = vec![false; rows * columns];
        let (stored, length) = (both.stored, both.row_length());
        let covers = split(&mut covered, columns, rows, pool.threads(), 1);
        let shares = both.shares(pool.threads(), 1).into_iter().zip(covers);
        pool.each(shares.collect(), |(Rows { range, data }, covers)| {
            let mut cell = vec![0.0; channels];
            let rows = data.chunks_exact_mut(length).zip(covers.data.chunks_exact_mut(columns));
            for (row, (to, covered)) in range.zip(rows) {
                let own = own.data[row * columns * channels..].chunks_exact(channels);
                let cells = to[stored..].chunks_exact_mut(stored).zip(own).zip(covered);
                for (column, ((to, own), covered)) in cells.enumerate() {
                    *covered = sample(sender, column, row, None, &mut cell);
                    let from = cell.iter().chain(own);
                    from.zip(to).for_each(|(from, to)| *to = E::from_f32(*from));
                }
            }
        });
        (both, covered)
    }
}

impl<E: Number> Fuse for Messages<E> {
    fn run(&self, agents: &[Agent], pool: &mut Pool) -> Vec<f32> {
        let mut maps: Vec<BevMap> = Vec::new();
        for round in 0..self.rounds {
            let now: Vec<Agent> = match maps.is_empty() {
                true => agents.to_vec(),
                false => agents.iter().zip(&maps).map(|(agent, map)| agent.with(map)).collect(),
            };
            let listening = if round + 1 == self.rounds { 1 } else { now.len() };
            maps = (0..listening).map(|index| self.listen(&now, index, pool)).collect();
        }
        let ego = &maps[0];
        let mut map: Map<E> = Map::new(ego.rows, ego.columns, self.channels);
        map.fill_with(pool, &ego.data);
        run(&self.output, &map, self.channels, pool).to_f32(pool)
    }
}

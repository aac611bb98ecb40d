//! Attention over agents, each cell by itself.

use super::{Asked, Norm, State};
use crate::cells::{Linear, add, cells, each_cell, run};
use crate::conv::{Map, Pool};
use crate::math::{exp, product};
use crate::part::Number;
use crate::simd::dispatch;

pub(super) struct OverAgents<E> {
    pub norm: Norm,
    pub heads: usize,
    /// By kind of who asks.
    pub queries: Vec<Linear<E>>,
    /// By kind of who asks, then of who is asked: keys and values, as the relation of both changes them.
    pub answers: Vec<Vec<Linear<E>>>,
    /// By kind of who asks.
    pub outputs: Vec<Linear<E>>,
}

impl<E: Number> OverAgents<E> {
    /// Attention of the first `asking` agents; what it gives is added to their maps.
    pub fn run(&self, states: &mut [State], asking: usize, pool: &mut Pool) {
        let normed: Vec<Map<E>> = states.iter().map(|state| self.norm.run(&state.map, pool)).collect();
        let asked: Vec<Asked> = states.iter().map(State::asked).collect();
        let given: Vec<Map<f32>> = (0..asking).map(|asks| self.ask(&asked, &normed, asks, pool)).collect();
        for (state, given) in states.iter_mut().zip(&given) {
            add(&mut state.map, given, pool);
        }
    }

    /// What one of the agents is given for its questions to all; without norm and sum.
    pub fn ask(&self, asked: &[Asked], normed: &[Map<E>], asks: usize, pool: &mut Pool) -> Map<f32> {
        let own = &normed[asks];
        let (kind, channels, columns) = (asked[asks].kind, own.channels, own.columns);
        let queries = run(&self.queries[kind], own, channels, pool);
        let mut sums: Map<f32> = Map::new(own.rows, columns, channels);
        // For each head the greatest score so far, and the sum of weights.
        let mut weighed: Map<f32> = Map::new(own.rows, columns, 2 * self.heads);
        each_cell(&mut weighed, 1, pool, |_, cells| {
            cells
                .as_chunks_mut::<2>()
                .0
                .iter_mut()
                .for_each(|head| *head = [f32::NEG_INFINITY, 0.0]);
        });
        for (agent, normed) in asked.iter().zip(normed) {
            let answers = run(&self.answers[kind][agent.kind], normed, 2 * channels, pool);
            let (queries, answers) = (queries.view(), answers.view());
            let shares = sums
                .shares(pool.threads(), 1)
                .into_iter()
                .zip(weighed.shares(pool.threads(), 1));
            let (length, weighed_length) = ((columns + 2) * channels, (columns + 2) * 2 * self.heads);
            pool.each(shares.collect(), |(sums, weighed)| {
                let rows = sums
                    .data
                    .chunks_exact_mut(length)
                    .zip(weighed.data.chunks_exact_mut(weighed_length));
                for (row, (sums, weighed)) in sums.range.zip(rows) {
                    let covered = &agent.covered[row * columns..][..columns];
                    let asked = (cells(&queries, row), cells(&answers, row));
                    let sums = &mut sums[channels..(columns + 1) * channels];
                    let weighed = &mut weighed[2 * self.heads..(columns + 1) * 2 * self.heads];
                    weigh(asked, covered, self.heads, sums, weighed);
                }
            });
        }
        let mut mean: Map<E> = Map::new(own.rows, columns, channels);
        let (sums, weighed, stored, width) = (sums.view(), weighed.view(), mean.stored, channels / self.heads);
        each_cell(&mut mean, 1, pool, |row, to| {
            let from = cells(&sums, row).chunks_exact(channels);
            let weighed = cells(&weighed, row).chunks_exact(2 * self.heads);
            for ((from, weighed), to) in from.zip(weighed).zip(to.chunks_exact_mut(stored)) {
                for (index, (from, to)) in from.iter().zip(to).enumerate() {
                    *to = E::from_f32(from / weighed[index / width * 2 + 1]);
                }
            }
        });
        run(&self.outputs[kind], &mean, channels, pool)
    }
}

dispatch! {
    /// Takes one agent's answers to the queries of a row into the sums; `weighed` has two numbers for each head.
    fn weigh(asked: (&[f32], &[f32]), covered: &[bool], heads: usize, sums: &mut [f32], weighed: &mut [f32]) {
        let channels = sums.len() / covered.len();
        let width = channels / heads;
        let scale = 1.0 / (width as f32).sqrt();
        let cells = asked.0.chunks_exact(channels).zip(asked.1.chunks_exact(2 * channels)).zip(covered);
        let to = sums.chunks_exact_mut(channels).zip(weighed.chunks_exact_mut(2 * heads));
        for (((query, answer), covered), (sums, weighed)) in cells.zip(to) {
            if !covered {
                continue;
            }
            let (keys, values) = answer.split_at(channels);
            let of_heads = query.chunks_exact(width).zip(keys.chunks_exact(width)).zip(values.chunks_exact(width));
            let to = sums.chunks_exact_mut(width).zip(weighed.as_chunks_mut::<2>().0);
            for (((query, key), value), (sums, [greatest, sum])) in of_heads.zip(to) {
                let score = product(query, key) * scale;
                // What was summed before a greater score came is made smaller.
                let (before, now) = match score > *greatest {
                    true => (exp(*greatest - score), 1.0),
                    false => (1.0, exp(score - *greatest)),
                };
                *greatest = greatest.max(score);
                *sum = *sum * before + now;
                for (sum, value) in sums.iter_mut().zip(value) {
                    *sum = *sum * before + value * now;
                }
            }
        }
    }
}

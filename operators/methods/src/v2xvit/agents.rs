//! Attention over agents, each cell by itself.

use realo_kernels::cells::{Linear, line, line_mut};
use realo_kernels::conv::Map;
use realo_kernels::math::{exp, product};
use realo_kernels::number::Number;
use realo_kernels::simd::dispatch;

use super::norm::Norm;
use super::state::Asked;
use super::tiles::Worker;

pub struct OverAgents<E> {
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
    /// What one of the agents is given for its questions to all; without norm and sum.
    pub fn ask(&self, asked: &[Asked], normed: &[Map<E>], asks: usize, worker: &mut Worker<E>) -> Map<f32> {
        let own = &normed[asks];
        let (kind, cells, channels) = (asked[asks].kind, own.columns, own.channels);
        let queries = worker.run(&self.queries[kind], own);
        let mut summed = Summed::new(self.heads, [cells, channels], worker);
        for (agent, normed) in asked.iter().zip(normed) {
            let answers = worker.run(&self.answers[kind][agent.kind], normed);
            summed.add(&queries, &answers, agent.covered);
            worker.keep_single([answers]);
        }
        let mean = summed.mean(worker);
        let given = worker.run(&self.outputs[kind], &mean);
        worker.keep_single([queries, summed.sums, summed.weighed]);
        worker.keep_own([mean]);
        given
    }
}

/// What agents answered so far.
pub struct Summed {
    heads: usize,
    pub sums: Map<f32>,
    /// For each cell the heads' largest scores, then their sums of weights.
    pub weighed: Map<f32>,
}

impl Summed {
    pub fn new<E: Number>(heads: usize, [cells, channels]: [usize; 2], worker: &mut Worker<E>) -> Self {
        let (mut sums, mut weighed) = (worker.single(cells, channels), worker.single(cells, 2 * heads));
        line_mut(&mut sums).fill(0.0);
        let of_heads = line_mut(&mut weighed).chunks_exact_mut(heads);
        of_heads
            .zip([f32::NEG_INFINITY, 0.0].into_iter().cycle())
            .for_each(|(of_heads, start)| of_heads.fill(start));
        Summed { heads, sums, weighed }
    }

    /// Takes one agent's answers to queries.
    pub fn add(&mut self, queries: &Map<f32>, answers: &Map<f32>, covered: &[bool]) {
        let asked = [line(queries), line(answers)];
        let (sums, weighed) = (line_mut(&mut self.sums), line_mut(&mut self.weighed));
        weigh(asked, covered, self.heads, sums, weighed);
    }

    /// The answers of all, by how much they count.
    pub fn mean<E: Number>(&self, worker: &mut Worker<E>) -> Map<E> {
        let channels = self.sums.channels;
        let mut mean = worker.own(self.sums.columns, channels);
        let stored = mean.stored;
        divide(
            [line(&self.sums), line(&self.weighed)],
            self.heads,
            [channels, stored],
            line_mut(&mut mean),
        );
        mean
    }
}

dispatch! {
    /// Takes one agent's answers to queries into the sums. `weighed` has for each cell the heads' largest scores so far, then
    /// their sums of weights.
    fn weigh(asked: [&[f32]; 2], covered: &[bool], heads: usize, sums: &mut [f32], weighed: &mut [f32]) {
        let channels = sums.len() / covered.len();
        let width = channels / heads;
        let scale = 1.0 / (width as f32).sqrt();
        let mut factors = vec![0.0f32; 2 * heads];
        let (before, now) = factors.split_at_mut(heads);
        let cells = asked[0].chunks_exact(channels).zip(asked[1].chunks_exact(2 * channels)).zip(covered);
        let to = sums.chunks_exact_mut(channels).zip(weighed.chunks_exact_mut(2 * heads));
        for (((query, answer), covered), (sums, weighed)) in cells.zip(to) {
            if !covered {
                continue;
            }
            let (keys, values) = answer.split_at(channels);
            for ((query, key), score) in query.chunks_exact(width).zip(keys.chunks_exact(width)).zip(&mut *now) {
                *score = product(query, key) * scale;
            }
            // What was summed before a greater score came is made smaller.
            let (max, weights) = weighed.split_at_mut(heads);
            for (((max, weight), before), now) in max.iter_mut().zip(weights).zip(&mut *before).zip(&mut *now) {
                let most = max.max(*now);
                *before = exp(*max - most);
                *now = exp(*now - most);
                *weight = *weight * *before + *now;
                *max = most;
            }
            let of_heads = sums.chunks_exact_mut(width).zip(values.chunks_exact(width));
            for ((sums, values), (before, now)) in of_heads.zip(before.iter().zip(&*now)) {
                for (sum, value) in sums.iter_mut().zip(values) {
                    *sum = *sum * before + value * now;
                }
            }
        }
    }
}

dispatch! {
    /// Sums over the sums of weights that stand behind the largest scores in `weighed`.
    fn divide<E: Number>(summed: [&[f32]; 2], heads: usize, cell: [usize; 2], to: &mut [E]) {
        let [channels, stored] = cell;
        let width = channels / heads;
        let from = summed[0].chunks_exact(channels).zip(summed[1].chunks_exact(2 * heads));
        for ((sums, weighed), to) in from.zip(to.chunks_exact_mut(stored)) {
            for ((sums, weight), to) in sums.chunks_exact(width).zip(&weighed[heads..]).zip(to.chunks_exact_mut(width)) {
                sums.iter().zip(to).for_each(|(sum, to)| *to = E::from_f32(sum / weight));
            }
        }
    }
}

//! The way back through attention over agents.

use realo_kernels::cells::{line, line_mut};
use realo_kernels::conv::Map;
use realo_kernels::math::{exp, product};
use realo_kernels::simd::dispatch;

use super::super::agents::{OverAgents, Summed};
use super::super::state::Asked;
use super::super::tiles::Worker;
use super::layer::{LinearBack, NormBack};
use super::sums::Sums;

/// As [`OverAgents`].
pub struct AgentsBack {
    pub norm: NormBack,
    pub queries: Vec<LinearBack>,
    pub answers: Vec<Vec<LinearBack>>,
    pub outputs: Vec<LinearBack>,
}

/// A tile of all agents, with gradients.
pub struct Tiled<'a> {
    pub asked: &'a [Asked<'a>],
    pub normed: &'a [Map<f32>],
    /// What is found.
    pub of_normed: &'a mut [Map<f32>],
}

impl AgentsBack {
    /// Adds the gradients of the normed maps from that of what one of the agents is given.
    pub fn run(
        &self,
        attention: &OverAgents<f32>,
        tiled: &mut Tiled,
        (asks, gradient): (usize, &Map<f32>),
        sums: &mut Sums,
        worker: &mut Worker<f32>,
    ) {
        let (own, kind) = (&tiled.normed[asks], tiled.asked[asks].kind);
        let size = [own.columns, own.channels];
        let queries = worker.run(&attention.queries[kind], own);
        let mut summed = Summed::new(attention.heads, size, worker);
        let mut answers = Vec::new();
        for (agent, normed) in tiled.asked.iter().zip(tiled.normed) {
            let answer = worker.run(&attention.answers[kind][agent.kind], normed);
            summed.add(&queries, &answer, agent.covered);
            answers.push(answer);
        }
        let mean = summed.mean(worker);
        let of_mean = self.outputs[kind].run(&mean, gradient, sums, worker);
        let mut of_queries = worker.single(size[0], size[1]);
        line_mut(&mut of_queries).fill(0.0);
        for (index, agent) in tiled.asked.iter().enumerate() {
            let mut of_answers = worker.single(size[0], 2 * size[1]);
            lead_to_answers(
                [&queries, &answers[index], &summed.weighed, &mean, &of_mean].map(line),
                agent.covered,
                attention.heads,
                line_mut(&mut of_queries),
                line_mut(&mut of_answers),
            );
            let layer = &self.answers[kind][agent.kind];
            let found = layer.run(&tiled.normed[index], &of_answers, sums, worker);
            add(&found, &mut tiled.of_normed[index]);
            worker.keep_single([of_answers, found]);
        }
        let found = self.queries[kind].run(own, &of_queries, sums, worker);
        add(&found, &mut tiled.of_normed[asks]);
        worker.keep_single([queries, summed.sums, summed.weighed, of_mean, of_queries, found]);
        worker.keep_single(answers);
        worker.keep_own([mean]);
    }
}

/// Adds a tile to another.
pub fn add(from: &Map<f32>, to: &mut Map<f32>) {
    let numbers = line_mut(to).iter_mut().zip(line(from));
    numbers.for_each(|(to, from)| *to += from);
}

dispatch! {
    /// Leads the gradient of the mean of all answers to those of one agent, and adds that of the queries. `read`: queries,
    /// answers, largest scores and sums of weights, the mean, and its gradient.
    fn lead_to_answers(
        read: [&[f32]; 5], covered: &[bool], heads: usize, of_queries: &mut [f32], of_answers: &mut [f32],
    ) {
        let [queries, answers, weighed, mean, of_mean] = read;
        let channels = queries.len() / covered.len();
        let width = channels / heads;
        let scale = 1.0 / (width as f32).sqrt();
        of_answers.fill(0.0);
        for cell in (0..covered.len()).filter(|cell| covered[*cell]) {
            for head in 0..heads {
                let [own, at] = [channels, 2 * channels].map(|numbers| cell * numbers + head * width);
                let (query, key, value) = (&queries[own..][..width], &answers[at..][..width], &answers[at + channels..][..width]);
                let (mean, of_mean) = (&mean[own..][..width], &of_mean[own..][..width]);
                let [max, all] = [0, heads].map(|part| weighed[cell * 2 * heads + part + head]);
                let share = exp(product(query, key) * scale - max) / all;
                let of_score = share * (product(of_mean, value) - product(of_mean, mean)) * scale;
                let (of_keys, of_values) = of_answers[at..].split_at_mut(channels);
                let numbers = of_values.iter_mut().zip(of_mean);
                numbers.for_each(|(to, of_mean)| *to = share * of_mean);
                let numbers = of_keys.iter_mut().zip(query).zip(&mut of_queries[own..]).zip(key);
                for (((of_key, query), of_query), key) in numbers {
                    *of_key = of_score * query;
                    *of_query += of_score * key;
                }
            }
        }
    }
}

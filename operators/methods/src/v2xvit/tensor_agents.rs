//! Attention over agents on tensors, each cell by itself.

use candle_core::{D, Result, Tensor};

use super::keys::KINDS;
use super::tensor_parts::{State, Transformer};
use crate::tensors::ops::softmax;

impl Transformer<'_> {
    /// What the first `asking` agents are given for their questions to all.
    pub fn over_agents(&self, key: &str, states: &[State], asking: usize) -> Result<Vec<Tensor>> {
        let norm = |state: &State| self.norm(&format!("{key}.norm"), &state.map);
        let normed = states.iter().map(norm).collect::<Result<Vec<Tensor>>>()?;
        let mut given: Vec<Option<Tensor>> = vec![None; asking];
        for kind in 0..KINDS {
            let asks = |index: &usize| states[*index].kind == kind;
            let askers: Vec<usize> = (0..asking).filter(asks).collect();
            if askers.is_empty() {
                continue;
            }
            let answers = states.iter().zip(&normed);
            let answers = answers.map(|(state, normed)| self.answers(key, [kind, state.kind], normed));
            let answers = answers.collect::<Result<Vec<_>>>()?;
            for index in askers {
                let query = self
                    .tensors
                    .linear(&format!("{key}.fn.q_linears.{kind}"), &normed[index])?;
                let mean = self.mean(&query, &answers, states)?;
                given[index] = Some(self.tensors.linear(&format!("{key}.fn.a_linears.{kind}"), &mean)?);
            }
        }
        Ok(given.into_iter().flatten().collect())
    }

    /// The values of all agents, by how well their keys answer to the query.
    fn mean(&self, query: &Tensor, answers: &[[Tensor; 2]], states: &[State]) -> Result<Tensor> {
        let query = (self.of_heads(query)? / (self.settings.head_width as f64).sqrt())?;
        let score =
            |([key, _], state): (&[Tensor; 2], &State)| query.mul(key)?.sum(D::Minus1)?.broadcast_add(&state.absence);
        let scores = answers.iter().zip(states).map(score).collect::<Result<Vec<Tensor>>>()?;
        let weights = softmax(&Tensor::stack(&scores, 0)?, 0)?;
        let mut mean = query.zeros_like()?;
        for (index, [_, value]) in answers.iter().enumerate() {
            mean = (mean + value.broadcast_mul(&weights.get(index)?.unsqueeze(D::Minus1)?)?)?;
        }
        mean.flatten_from(1)
    }

    /// An agent's keys and values, as the relation of who asks and who is asked changes them, `[cells, heads, width]` each.
    fn answers(&self, key: &str, [asks, asked]: [usize; 2], normed: &Tensor) -> Result<[Tensor; 2]> {
        let (heads, width) = (self.settings.heads, self.settings.head_width);
        let relation = |name: &str| self.tensors.get(&format!("{key}.fn.{name}"))?.get(asks * KINDS + asked);
        // The relation's matrix becomes part of the layer: weights are fewer than cells.
        let answer = |part: &str, matrix: Tensor| {
            let linear = format!("{key}.fn.{part}_linears.{asked}");
            let [weight, bias] = ["weight", "bias"].map(|name| {
                let tensor = self.tensors.get(&format!("{linear}.{name}"))?;
                matrix.matmul(&tensor.reshape((heads, width, ()))?)
            });
            let weight = weight?.reshape((heads * width, ()))?;
            self.of_heads(&self.tensors.product(normed, &weight, Some(&bias?.flatten_all()?))?)
        };
        let keys = answer("k", relation("relation_att")?)?;
        let values = answer("v", relation("relation_msg")?.t()?.contiguous()?)?;
        Ok([keys, values])
    }

    fn of_heads(&self, map: &Tensor) -> Result<Tensor> {
        map.reshape(((), self.settings.heads, self.settings.head_width))
    }
}

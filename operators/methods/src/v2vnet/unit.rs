//! The convolutional gated recurrent unit (Cho et al. 2014; Ballas et al. 2016).
//!
//! `r, u = sigmoid(gates * [x, h])`, `c = tanh(candidate * [x, r h])`, `h' = (1 - u) h + u c`. Without a state h nothing that is
//! multiplied by it is computed: `h' = u c`.

use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::cells::{Linear, add, cells, each_cell, packed, run};
use realo_kernels::conv::{Isa, Map, Pool};
use realo_kernels::math::exp;
use realo_kernels::number::Number;
use realo_kernels::simd::dispatch;

/// The weights of a unit, each with its biases, as a state dict has them: kernels are
/// `[outputs, inputs + channels, kernel, kernel]`.
#[derive(Clone, Copy, Debug)]
pub struct GatedUnitTensors<'a> {
    /// Channels of the inputs x.
    pub inputs: usize,
    /// Channels of the state h.
    pub channels: usize,
    /// Side of the kernels, 1 or 3.
    pub kernel: usize,
    /// Of `2 channels` outputs: those of r, then those of u.
    pub gates: [&'a [f32]; 2],
    /// Of `channels` outputs.
    pub candidate: [&'a [f32]; 2],
}

/// A unit that is ready to run; maps are computed in `E`, what is added up in f32.
pub struct Unit<E> {
    update: Linear<E>,
    candidate: Linear<E>,
    memory: Option<Memory<E>>,
    channels: usize,
}

/// What a unit does with its state.
struct Memory<E> {
    /// Of the inputs.
    reset: Linear<E>,
    /// Of the state: for the update, and for the reset.
    update_of_state: Linear<E>,
    reset_of_state: Linear<E>,
    /// Of the state as far as it is not reset.
    candidate_of_state: Linear<E>,
}

impl GatedUnitTensors<'_> {
    /// The layer of some outputs on the inputs or, without biases, on the state.
    fn layer<E: Number>(&self, [weights, bias]: [&[f32]; 2], of_state: bool, isa: Isa) -> Linear<E> {
        let taps = self.kernel * self.kernel;
        let (inputs, all) = (self.inputs * taps, (self.inputs + self.channels) * taps);
        let (part, channels, bias) = match of_state {
            true => (inputs..all, self.channels, vec![0.0; bias.len()]),
            false => (0..inputs, self.inputs, bias.to_vec()),
        };
        let outputs = weights.chunks_exact(all);
        let weights = outputs.flat_map(|output| &output[part.clone()]).copied().collect();
        packed(weights, bias, [channels, self.kernel], isa)
    }

    fn reset_and_update(&self) -> [[&[f32]; 2]; 2] {
        let [weights, bias] = self.gates;
        let (of_reset, of_update) = weights.split_at(weights.len() / 2);
        let (reset_bias, update_bias) = bias.split_at(self.channels);
        [[of_reset, reset_bias], [of_update, update_bias]]
    }
}

impl<E: Number> Unit<E> {
    /// A unit that never has a state.
    pub fn forgetful(tensors: &GatedUnitTensors, isa: Isa) -> Self {
        let [_, update] = tensors.reset_and_update();
        Unit {
            update: tensors.layer(update, false, isa),
            candidate: tensors.layer(tensors.candidate, false, isa),
            memory: None,
            channels: tensors.channels,
        }
    }

    /// A unit that may have a state.
    fn remembering(tensors: &GatedUnitTensors, isa: Isa) -> Self {
        let [reset, update] = tensors.reset_and_update();
        let memory = Memory {
            reset: tensors.layer(reset, false, isa),
            update_of_state: tensors.layer(update, true, isa),
            reset_of_state: tensors.layer(reset, true, isa),
            candidate_of_state: tensors.layer(tensors.candidate, true, isa),
        };
        Unit {
            memory: Some(memory),
            ..Unit::forgetful(tensors, isa)
        }
    }

    /// The next state. A forgetful unit takes no notice of the last one.
    pub fn run(&self, inputs: &Map<E>, state: Option<&Map<f32>>, pool: &mut Pool) -> Map<f32> {
        let mut taken = run(&self.update, inputs, self.channels, pool);
        let mut candidate = run(&self.candidate, inputs, self.channels, pool);
        let Some((memory, state)) = self.memory.as_ref().zip(state) else {
            let view = candidate.view();
            each_cell(&mut taken, 1, pool, |row, to| gated(cells(&view, row), to));
            return taken;
        };
        let mut remembered: Map<E> = Map::new(state.rows, state.columns, self.channels);
        remembered.fill_from_view(pool, state.view());
        add(
            &mut taken,
            &run(&memory.update_of_state, &remembered, self.channels, pool),
            pool,
        );
        let mut reset = run(&memory.reset, inputs, self.channels, pool);
        add(
            &mut reset,
            &run(&memory.reset_of_state, &remembered, self.channels, pool),
            pool,
        );
        let (view, stored) = (reset.view(), remembered.stored);
        let last = state.view();
        each_cell(&mut remembered, 1, pool, |row, to| {
            let from = cells(&view, row).chunks_exact(self.channels);
            let last = cells(&last, row).chunks_exact(self.channels);
            for ((reset, last), to) in from.zip(last).zip(to.chunks_exact_mut(stored)) {
                let kept = reset.iter().zip(last).map(|(reset, last)| last / (1.0 + exp(-reset)));
                kept.zip(to).for_each(|(kept, to)| *to = E::from_f32(kept));
            }
        });
        add(
            &mut candidate,
            &run(&memory.candidate_of_state, &remembered, self.channels, pool),
            pool,
        );
        let view = candidate.view();
        each_cell(&mut taken, 1, pool, |row, to| {
            let update: Vec<f32> = to.iter().map(|update| 1.0 / (1.0 + exp(-update))).collect();
            gated(cells(&view, row), to);
            let kept = update.iter().zip(cells(&last, row));
            kept.zip(to)
                .for_each(|((update, last), to)| *to += (1.0 - update) * last);
        });
        taken
    }
}

dispatch! {
    /// The sigmoid of `to` times the hyperbolic tangent of the candidate.
    fn gated(candidate: &[f32], to: &mut [f32]) {
        for (to, candidate) in to.iter_mut().zip(candidate) {
            let tangent = 2.0 / (1.0 + exp(-2.0 * candidate)) - 1.0;
            *to = tangent / (1.0 + exp(-*to));
        }
    }
}

/// A unit by itself, in f32, with a state.
pub struct GatedUnit {
    unit: Unit<f32>,
    pool: Pool,
}

impl GatedUnit {
    /// The instructions must be there.
    ///
    /// # Panics
    /// If numbers of weights do not fit the channels.
    pub fn new(tensors: &GatedUnitTensors, isa: Isa, threads: usize) -> Self {
        GatedUnit {
            unit: Unit::remembering(tensors, isa),
            pool: Pool::new(threads),
        }
    }

    /// The next state, of the channels of `state`; both maps have the same rows and columns.
    pub fn run(&mut self, inputs: BevView, state: BevView) -> BevMap {
        let mut filled = |view: BevView| {
            let mut map = Map::new(view.rows, view.columns, view.channels);
            map.fill_with(&mut self.pool, view.data);
            map
        };
        let (inputs, state) = (filled(inputs), filled(state));
        let next = self.unit.run(&inputs, Some(&state), &mut self.pool);
        BevMap {
            rows: next.rows,
            columns: next.columns,
            channels: next.channels,
            data: next.to_f32(&mut self.pool),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use realo_nn::filler::Numbers;

    const SIZE: [usize; 2] = [3, 4];

    #[test]
    fn without_a_state_it_is_what_it_is_with_one_of_zeros() {
        let (inputs, channels) = (5, 3);
        let numbers = |seed, count| Numbers::new(seed).list(count);
        let outputs = |seed, outputs: usize| {
            (
                numbers(seed, outputs * (inputs + channels) * 9),
                numbers(seed + 1, outputs),
            )
        };
        let (gates, candidate) = (outputs(1, 2 * channels), outputs(3, channels));
        let tensors = GatedUnitTensors {
            inputs,
            channels,
            kernel: 3,
            gates: [&gates.0, &gates.1],
            candidate: [&candidate.0, &candidate.1],
        };
        let mut pool = Pool::new(2);
        let mut map = Map::new(SIZE[0], SIZE[1], inputs);
        map.fill_with(&mut pool, &numbers(7, SIZE[0] * SIZE[1] * inputs));
        let zeros = Map::new(SIZE[0], SIZE[1], channels);
        let [forgetful, remembering] = [
            Unit::<f32>::forgetful(&tensors, Isa::Portable),
            Unit::remembering(&tensors, Isa::Portable),
        ];
        let mut run = |unit: &Unit<f32>, state| unit.run(&map, state, &mut pool).to_f32(&mut Pool::new(1));
        let (without, of_zeros) = (run(&forgetful, None), run(&remembering, Some(&zeros)));
        assert_eq!(without, run(&remembering, None));
        assert!(without.iter().zip(&of_zeros).all(|(a, b)| (a - b).abs() < 1e-6));
        let mut state = Map::new(SIZE[0], SIZE[1], channels);
        state.fill_with(&mut Pool::new(1), &vec![0.5; SIZE[0] * SIZE[1] * channels]);
        let remembered = run(&remembering, Some(&state));
        assert!(without.iter().zip(&remembered).any(|(a, b)| (a - b).abs() > 0.05));
    }
}

//! A pass over the layers.

use std::collections::HashMap;
use std::sync::Arc;

use candle_core::Tensor;
use rayon::prelude::*;
use realo_nn::layers::{ConvLayer, MapId, PointLayer, Role, Step, norm_key};

use super::{Network, norm_keys};
use crate::layers::{
    Bias, Conv, Moments, Norm, PillarBatch, PillarLayer, Pointwise, Statistics, WeightOrder, with_numbers,
};
use crate::tape::Tape;

/// The maps of a forward pass; one that nobody reads any more is let go.
pub(super) struct Maps {
    pub made: HashMap<MapId, Tensor>,
    readers: HashMap<MapId, usize>,
}

impl Maps {
    pub(super) fn of(order: &[&Step]) -> Self {
        let mut readers = HashMap::new();
        for map in order.iter().flat_map(|step| &step.from) {
            *readers.entry(*map).or_default() += 1;
        }
        Maps {
            made: HashMap::new(),
            readers,
        }
    }

    pub(super) fn read(&mut self, map: MapId) -> Tensor {
        let left = self.readers.entry(map).or_default();
        *left = left.saturating_sub(1);
        let made = match left {
            0 => self.made.remove(&map),
            _ => self.made.get(&map).cloned(),
        };
        made.expect("steps in an order in which they can be computed")
    }
}

/// A forward pass.
pub(super) struct Run<'a> {
    pub network: &'a Network,
    pub tape: &'a mut Tape,
    /// Whether batch norms take the batch's statistics.
    pub by_batch: bool,
    pub statistics: Vec<(String, Statistics)>,
}

impl Run<'_> {
    pub(super) fn statistics(&mut self, norm: &str) -> candle_core::Result<Statistics> {
        let statistics = if self.by_batch {
            Statistics::batch()
        } else {
            let [mean, variance] = [Role::RunningMean, Role::RunningVariance].map(|part| {
                let value = self.network.value(&norm_key(norm, part));
                with_numbers(value, |values| Ok(values.to_vec()))
            });
            Statistics::Running(Moments {
                mean: mean?,
                variance: variance?,
                count: 1,
            })
        };
        self.statistics.push((norm.to_string(), statistics.clone()));
        Ok(statistics)
    }

    pub(super) fn points(&mut self, layer: &PointLayer, batch: &Arc<PillarBatch>) -> candle_core::Result<Tensor> {
        let op = PillarLayer::new(batch.clone(), self.statistics(&layer.norm)?);
        let network = self.network;
        let [weight, bias] = norm_keys(&layer.norm).map(|key| network.value(&key));
        self.tape.apply3(op, network.value(&layer.weight_key()), weight, bias)
    }

    pub(super) fn convolution(&mut self, layer: &ConvLayer, map: &Tensor) -> candle_core::Result<Tensor> {
        let network = self.network;
        let weight = network.value(&layer.weight_key());
        let made = match (layer.transposed, layer.kernel) {
            (true, _) => self.pointwise(WeightOrder::Transposed, map, weight),
            (false, 1) if layer.stride == 1 => self.pointwise(WeightOrder::Plain, map, weight),
            (false, 3) => {
                let (stride, arithmetic) = (layer.stride, network.arithmetic);
                self.tape.apply2(Conv { stride, arithmetic }, map, weight)
            }
            (false, kernel) => candle_core::bail!(
                "`{}`: there is no training for a kernel of {kernel} at stride {}",
                layer.key,
                layer.stride
            ),
        }?;
        let biased = match layer.bias_key() {
            Some(key) => {
                let relu = layer.relu && layer.norm.is_none();
                self.tape.apply2(Bias { relu }, &made, network.value(&key))?
            }
            None => made,
        };
        match &layer.norm {
            Some(norm) if layer.relu => self.norm(norm, &biased),
            None if layer.bias || !layer.relu => Ok(biased),
            _ => candle_core::bail!(
                "`{}`: there is no training for a ReLU without bias or a norm without ReLU",
                layer.key
            ),
        }
    }

    fn pointwise(&mut self, order: WeightOrder, map: &Tensor, weight: &Tensor) -> candle_core::Result<Tensor> {
        let arithmetic = self.network.arithmetic;
        self.tape.apply2(Pointwise { order, arithmetic }, map, weight)
    }

    /// Batch norm and ReLU.
    pub(super) fn norm(&mut self, norm: &str, map: &Tensor) -> candle_core::Result<Tensor> {
        let op = Norm {
            statistics: self.statistics(norm)?,
        };
        let network = self.network;
        let [weight, bias] = norm_keys(norm).map(|key| network.value(&key));
        self.tape.apply3(op, map, weight, bias)
    }
}

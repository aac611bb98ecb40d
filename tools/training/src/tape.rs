//! Records a forward pass of custom operations and leads gradients back through it.
//!
//! Unlike candle's own backward pass, which adds every gradient to a map of zeros, a gradient that comes from one
//! consumer is handed on as it is, and a map is dropped as soon as nobody needs it.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use candle_core::{CustomOp2, CustomOp3, Result, Tensor, TensorId};

use crate::layers::{join, split};

/// Gradients by what they are of.
pub(crate) type Gradients = Vec<(TensorId, Tensor)>;
type Backward = Box<dyn FnOnce(&Tensor) -> Result<Gradients>>;

/// The operations of a forward pass, in order.
#[derive(Default)]
pub struct Tape {
    steps: Vec<(TensorId, Backward)>,
    /// Whether the operations are only applied.
    forward_only: bool,
    /// Whether the next ones are, since nothing learns from their gradients.
    paused: bool,
}

impl Tape {
    /// A tape for training.
    pub fn new() -> Self {
        Tape::default()
    }

    /// A tape that keeps nothing.
    pub fn forward_only() -> Self {
        Tape {
            forward_only: true,
            ..Tape::default()
        }
    }

    /// Whether the next operations are only applied.
    pub(crate) fn pause(&mut self, paused: bool) {
        self.paused = paused;
    }

    /// Whether gradients are led back through the next operation.
    pub(crate) fn records(&self) -> bool {
        !(self.forward_only || self.paused)
    }

    /// Takes note of how an operation's gradients follow from that of what it made.
    pub(crate) fn record(&mut self, out: &Tensor, backward: impl FnOnce(&Tensor) -> Result<Gradients> + 'static) {
        if self.records() {
            self.steps.push((out.id(), Box::new(backward)));
        }
    }

    /// Applies an operation on two tensors.
    ///
    /// # Errors
    /// The operation's.
    pub fn apply2(&mut self, op: impl CustomOp2 + 'static, a: &Tensor, b: &Tensor) -> Result<Tensor> {
        let out = a.apply_op2_no_bwd(b, &op)?;
        let (a, b, result) = (a.clone(), b.clone(), out.clone());
        self.record(&out, move |grad| {
            let (da, db) = op.bwd(&a, &b, &result, grad)?;
            Ok([(a.id(), da), (b.id(), db)]
                .into_iter()
                .filter_map(|(id, grad)| Some((id, grad?)))
                .collect())
        });
        Ok(out)
    }

    /// Applies an operation on three tensors.
    ///
    /// # Errors
    /// The operation's.
    pub fn apply3(&mut self, op: impl CustomOp3 + 'static, a: &Tensor, b: &Tensor, c: &Tensor) -> Result<Tensor> {
        let out = a.apply_op3_no_bwd(b, c, &op)?;
        let (a, b, c, result) = (a.clone(), b.clone(), c.clone(), out.clone());
        self.record(&out, move |grad| {
            let (da, db, dc) = op.bwd(&a, &b, &c, &result, grad)?;
            let all = [(a.id(), da), (b.id(), db), (c.id(), dc)];
            Ok(all.into_iter().filter_map(|(id, grad)| Some((id, grad?))).collect())
        });
        Ok(out)
    }

    /// Joins maps in their channels.
    ///
    /// # Errors
    /// As [`join`].
    pub fn join(&mut self, maps: &[Tensor]) -> Result<Tensor> {
        let out = join(maps)?;
        let parts: Vec<(TensorId, usize)> = maps
            .iter()
            .map(|map| Ok((map.id(), map.dim(3)?)))
            .collect::<Result<_>>()?;
        self.record(&out, move |grad| {
            let channels: Vec<usize> = parts.iter().map(|(_, channels)| *channels).collect();
            let ids = parts.iter().map(|(id, _)| *id);
            Ok(ids.zip(split(grad, &channels)?).collect())
        });
        Ok(out)
    }

    /// Of each image the first map's or the second's, `[images, ..]`, as `second` says.
    ///
    /// # Errors
    /// Those of candle, for maps of other sizes.
    pub(crate) fn choose(&mut self, maps: [&Tensor; 2], second: &[bool]) -> Result<Tensor> {
        let images = second.iter().enumerate();
        let chosen = images.map(|(image, second)| maps[usize::from(*second)].narrow(0, image, 1));
        let out = Tensor::cat(&chosen.collect::<Result<Vec<_>>>()?, 0)?;
        let (ids, second) = (maps.map(Tensor::id), second.to_vec());
        self.record(&out, move |grad| {
            let part = |of_second: bool| {
                let images = second.iter().enumerate().map(|(image, second)| {
                    let grad = grad.narrow(0, image, 1)?;
                    if *second == of_second {
                        Ok(grad)
                    } else {
                        grad.zeros_like()
                    }
                });
                Tensor::cat(&images.collect::<Result<Vec<_>>>()?, 0)
            };
            Ok(vec![(ids[0], part(false)?), (ids[1], part(true)?)])
        });
        Ok(out)
    }

    /// The gradients of everything that went in and did not come out of the tape, from those of its results.
    ///
    /// # Errors
    /// Those of the operations.
    pub fn backward(self, of_results: Vec<(TensorId, Tensor)>) -> Result<HashMap<TensorId, Tensor>> {
        let mut known = HashMap::new();
        for (id, grad) in of_results {
            add(&mut known, id, grad)?;
        }
        for (out, backward) in self.steps.into_iter().rev() {
            if let Some(grad) = known.remove(&out) {
                for (id, grad) in backward(&grad)? {
                    add(&mut known, id, grad)?;
                }
            }
        }
        Ok(known)
    }
}

fn add(known: &mut HashMap<TensorId, Tensor>, id: TensorId, grad: Tensor) -> Result<()> {
    match known.entry(id) {
        Entry::Vacant(place) => {
            place.insert(grad);
        }
        Entry::Occupied(mut place) => {
            let sum = place.get().add(&grad)?;
            place.insert(sum);
        }
    }
    Ok(())
}

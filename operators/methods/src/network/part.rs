//! A part of a network, from one map to another, ready to run: convolutions with batch norm folded in, packed for the
//! instructions, and the maps between them.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use realo_kernels::conv::{Bf16, Convolution, Isa, Map, Packed, Pool, Steps, U8, View};
use realo_kernels::number::{Copied, Number};
use realo_nn::layers::{ConvLayer, Layer, Layers, MapId, MapSize, Step};
use realo_nn::weights::Weights;

/// In which numbers the last map is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// In those of the network, to be read by layers.
    Own,
    /// In f32.
    Single,
}

/// The layers of a part. Maps that nobody reads any more make room for later ones.
pub(crate) struct Part<E> {
    rooms: Vec<MapSize>,
    steps: Vec<PartStep<E>>,
    /// Where the result is; in the map of f32 if `None`.
    result: Option<usize>,
    size: MapSize,
    needs_border: bool,
    /// What 1 stands for in the part's input.
    step: f32,
}

struct PartStep<E> {
    /// The room that is read; the part's input if `None`.
    from: Option<usize>,
    /// First channel written.
    first: usize,
    run: Run<E>,
}

enum Run<E> {
    /// Into a room.
    Own(Packed<E>, usize),
    /// Into the map of f32.
    Single(Packed<E, f32>),
}

/// The maps of a part, made when it first runs.
pub(crate) struct Rooms<E> {
    copy: Option<Copied<E>>,
    own: Vec<Map<E>>,
    single: Option<Map<f32>>,
}

/// What a part has computed.
pub(crate) enum Made<'a> {
    Single(&'a Map<f32>),
    Half(&'a Map<Bf16>),
}

impl Made<'_> {
    /// `[rows, columns, channels]`.
    pub fn to_f32(&self, pool: &mut Pool) -> Vec<f32> {
        match self {
            Made::Single(map) => map.to_f32(pool),
            Made::Half(map) => map.to_f32(pool),
        }
    }
}

/// A part with its maps.
pub(crate) trait Runner: Send {
    fn run(&mut self, pool: &mut Pool, input: View<f32>) -> Made<'_>;
}

pub(crate) struct Running<E> {
    part: Arc<Part<E>>,
    rooms: Option<Rooms<E>>,
}

impl<E> Running<E> {
    pub fn new(part: Arc<Part<E>>) -> Self {
        Running { part, rooms: None }
    }
}

macro_rules! runner {
    ($element:ty, $made:path) => {
        impl Runner for Running<$element> {
            fn run(&mut self, pool: &mut Pool, input: View<f32>) -> Made<'_> {
                let rooms = self.rooms.get_or_insert_with(|| self.part.rooms());
                self.part.run(rooms, pool, input);
                match self.part.result {
                    Some(room) => $made(&rooms.own[room]),
                    None => Made::Single(rooms.single.as_ref().expect("a map of f32")),
                }
            }
        }
    };
}
runner!(f32, Made::Single);
runner!(Bf16, Made::Half);
runner!(U8, never);

fn never(_: &Map<U8>) -> Made<'_> {
    unreachable!("parts of bytes end in f32");
}

impl<E: Number> Part<E> {
    /// The layers from one map to another; `step_of`: what 1 stands for in a map of this type.
    ///
    /// # Panics
    /// If the one does not follow from the other by convolutions alone.
    pub fn new(
        layers: &Layers,
        weights: &Weights,
        isa: Isa,
        [from, to]: [MapId; 2],
        outcome: Outcome,
        step_of: impl Fn(MapId) -> f32,
    ) -> Self {
        let order = layers.between(&[from], &[to]);
        let homes = homes(&order);
        let home = |map: MapId| homes.get(&map).copied().unwrap_or((map, 0));
        let mut last_reader = HashMap::new();
        for (index, step) in order.iter().enumerate() {
            let convolution = matches!(step.layer, Layer::Convolution(_));
            step.from.iter().filter(|_| convolution).for_each(|map| {
                assert_eq!(home(*map).1, 0, "a map that is part of another is read as a whole");
                last_reader.insert(home(*map).0, index);
            });
        }
        last_reader.insert(home(to).0, usize::MAX);

        let mut part = Part {
            rooms: Vec::new(),
            steps: Vec::new(),
            result: None,
            size: layers.size(to),
            needs_border: false,
            step: step_of(from),
        };
        let (mut places, mut free) = (BTreeMap::new(), Vec::new());
        for (index, together) in groups(&order, &homes) {
            let (target, first) = home(together[0].1.to);
            let source = together[0].1.from[0];
            let numbers = joined(&together, weights);
            let room = (outcome == Outcome::Own || target != home(to).0).then(|| {
                *places.entry(target).or_insert_with(|| {
                    let size = layers.size(target);
                    let fitting = free.iter().position(|room: &usize| part.rooms[*room] == size);
                    fitting.map(|at| free.swap_remove(at)).unwrap_or_else(|| {
                        part.rooms.push(size);
                        part.rooms.len() - 1
                    })
                })
            });
            let input = step_of(home(source).0);
            let steps = |output| Steps { input, output };
            let run = match room {
                Some(room) => Run::Own(Packed::new(&numbers, isa, steps(step_of(target))), room),
                None => Run::Single(Packed::new(&numbers, isa, steps(1.0))),
            };
            let from = (source != from).then(|| places[&home(source).0]);
            part.needs_border |= from.is_none() && run.needs_border();
            part.steps.push(PartStep { from, first, run });
            places.retain(|map, room| {
                let is_read = last_reader.get(map).is_some_and(|last| *last > index);
                if !is_read {
                    free.push(*room);
                }
                is_read
            });
        }
        part.result = places.get(&home(to).0).copied();
        part
    }

    fn rooms(&self) -> Rooms<E> {
        let [rows, columns, channels] = self.size;
        Rooms {
            copy: None,
            // Layers know the steps of what they read and write here.
            own: self
                .rooms
                .iter()
                .map(|[rows, columns, channels]| Map::new(*rows, *columns, *channels))
                .collect(),
            single: self.result.is_none().then(|| Map::new(rows, columns, channels)),
        }
    }

    fn run(&self, rooms: &mut Rooms<E>, pool: &mut Pool, input: View<f32>) {
        let Rooms { copy, own, single } = rooms;
        let input = E::take(input, self.needs_border, self.step, copy, pool);
        for step in &self.steps {
            match &step.run {
                Run::Own(layer, room) => {
                    let (from, to) = match step.from {
                        None => (input, &mut own[*room]),
                        Some(from) => {
                            let (from, to) = two(own, from, *room);
                            (from.view(), to)
                        }
                    };
                    layer.run(pool, from, to, step.first);
                }
                Run::Single(layer) => {
                    let from = step.from.map_or(input, |from| own[from].view());
                    layer.run(pool, from, single.as_mut().expect("a map of f32"), step.first);
                }
            }
        }
    }
}

impl<E: Number> Run<E> {
    fn needs_border(&self) -> bool {
        match self {
            Run::Own(layer, _) => layer.needs_border(),
            Run::Single(layer) => layer.needs_border(),
        }
    }
}

/// Two different elements, the second to be written.
fn two<T>(list: &mut [T], read: usize, write: usize) -> (&T, &mut T) {
    let [read, write] = list
        .get_disjoint_mut([read, write])
        .expect("a layer reads one map and writes another");
    (read, write)
}

/// For maps that are joined, the map that they are part of and their first channel there.
fn homes(order: &[&Step]) -> HashMap<MapId, (MapId, usize)> {
    let mut homes = HashMap::new();
    // Joins of joins: the last one first.
    for step in order.iter().rev().filter(|step| step.layer == Layer::Join) {
        let (target, mut first) = homes.get(&step.to).copied().unwrap_or((step.to, 0));
        for map in &step.from {
            homes.insert(*map, (target, first));
            first += channels_of(order, *map);
        }
    }
    homes
}

fn channels_of(order: &[&Step], map: MapId) -> usize {
    let maker = order.iter().find(|step| step.to == map);
    match maker.map(|step| (&step.layer, &step.from)) {
        Some((Layer::Convolution(layer), _)) => layer.outputs,
        Some((Layer::Join, from)) => from.iter().map(|map| channels_of(order, *map)).sum(),
        _ => panic!("a join reads what convolutions of the same part make"),
    }
}

/// Convolutions that read one map alike and write side by side.
type Together<'a> = Vec<(&'a ConvLayer, &'a Step)>;

/// The convolutions in order, those together that can run as one; each with its place in the order.
fn groups<'a>(order: &[&'a Step], homes: &HashMap<MapId, (MapId, usize)>) -> Vec<(usize, Together<'a>)> {
    let home = |step: &Step| homes.get(&step.to).copied().unwrap_or((step.to, 0));
    let mut groups: Vec<(usize, Together)> = Vec::new();
    for (index, step) in order.iter().enumerate() {
        let layer = match &step.layer {
            Layer::Convolution(layer) => layer,
            Layer::Join => continue,
            Layer::Points(_) => panic!("points are no map that a part begins with"),
            Layer::Fuse(_) => panic!("maps of several agents are not made by one part"),
        };
        if let Some((last, together)) = groups.last_mut()
            && side_by_side(together, (layer, step), home)
        {
            together.push((layer, step));
            together.sort_by_key(|(_, step)| home(step).1);
            *last = index;
            continue;
        }
        groups.push((index, vec![(layer, step)]));
    }
    groups
}

/// Whether a convolution reads what those of a group read, in the same way, and writes next to them.
fn side_by_side(
    together: &Together,
    (layer, step): (&ConvLayer, &Step),
    home: impl Fn(&Step) -> (MapId, usize),
) -> bool {
    let alike = |layer: &ConvLayer| (layer.kernel, layer.stride, layer.relu, layer.transposed);
    let (map, first) = home(step);
    let (begin, end) = (
        home(together[0].1).1,
        together.iter().map(|(other, of)| home(of).1 + other.outputs).max(),
    );
    let same = together
        .iter()
        .all(|(other, of)| alike(other) == alike(layer) && of.from == step.from && home(of).0 == map);
    same && !layer.transposed && (first + layer.outputs == begin || Some(first) == end)
}

/// Convolutions whose outputs lie side by side, as one.
fn joined(together: &Together, weights: &Weights) -> Convolution {
    let mut all = together.iter().map(|(layer, _)| numbers(layer, weights));
    let first = all.next().expect("at least one");
    all.fold(first, |mut sum, next| {
        sum.outputs += next.outputs;
        sum.weights.extend(next.weights);
        sum.bias.extend(next.bias);
        sum
    })
}

/// The numbers of a layer, batch norm folded in.
pub(crate) fn numbers(layer: &ConvLayer, weights: &Weights) -> Convolution {
    let convolution = Convolution {
        inputs: layer.inputs,
        outputs: layer.outputs,
        kernel: layer.kernel,
        stride: layer.stride,
        transposed: layer.transposed,
        relu: layer.relu,
        weights: weights.tensor(&layer.weight_key()).to_vec(),
        bias: match layer.bias_key() {
            Some(key) => weights.tensor(&key).to_vec(),
            None => vec![0.0; layer.outputs],
        },
    };
    match &layer.norm {
        Some(norm) => folded(convolution, &weights.batch_norm(norm)),
        None => convolution,
    }
}

/// The convolution with its batch norm as weights and bias; computed in f64.
fn folded(mut layer: Convolution, norm: &[[f64; 2]]) -> Convolution {
    let taps = layer.kernel * layer.kernel;
    // Weights of one output lie together, or of one input and output if transposed.
    let (run, outputs) = match layer.transposed {
        true => (taps, layer.outputs),
        false => (taps * layer.inputs, layer.outputs),
    };
    for (index, weights) in layer.weights.chunks_exact_mut(run).enumerate() {
        let [factor, _] = norm[index % outputs];
        weights
            .iter_mut()
            .for_each(|weight| *weight = (f64::from(*weight) * factor) as f32);
    }
    for (bias, [factor, summand]) in layer.bias.iter_mut().zip(norm) {
        *bias = (f64::from(*bias) * factor + summand) as f32;
    }
    layer
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arch::Model;
    use crate::testing::{lite, random_tensors, small};

    fn part(model: &Model, ends: impl Fn(&Layers) -> [MapId; 2], outcome: Outcome) -> Part<f32> {
        let layers = Layers::of(model);
        let weights = Weights::new(model, random_tensors(model, 1)).unwrap();
        Part::new(&layers, &weights, Isa::Portable, ends(&layers), outcome, |_| 1.0)
    }

    #[test]
    fn maps_make_room_for_later_ones_of_the_same_size() {
        let encode = part(&lite(), |layers| [layers.canvas, layers.features], Outcome::Own);
        // A block goes to and fro between two maps; the first to be made is in the first room.
        let expected = [
            [100, 256, 32],
            [100, 256, 32],
            [100, 256, 192],
            [50, 128, 64],
            [50, 128, 64],
            [25, 64, 128],
            [25, 64, 128],
            [100, 256, 64],
        ];
        assert_eq!((&encode.rooms[..], encode.result), (&expected[..], Some(7)));
        assert!(encode.needs_border);
    }

    #[test]
    fn both_heads_run_as_one_layer_that_reads_the_map_where_it_lies() {
        let heads = part(&lite(), |layers| [layers.features, layers.heads], Outcome::Single);
        assert_eq!(
            (heads.rooms.len(), heads.steps.len(), heads.needs_border),
            (0, 1, false)
        );
        assert!(matches!(
            heads.steps[0],
            PartStep {
                from: None,
                first: 0,
                run: Run::Single(_)
            }
        ));
        assert_eq!(heads.size, [100, 256, 60]);
    }

    #[test]
    #[should_panic(expected = "points are no map")]
    fn a_part_begins_with_a_map() {
        let model = small(8, 8, false);
        part(&model, |layers| [layers.features, layers.canvas], Outcome::Own);
    }
}

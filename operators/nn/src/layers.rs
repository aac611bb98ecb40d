//! A network as a list of layers: the one description that its weights, inference and training read.
//!
//! A layer knows its tensors; a step says which maps the layer reads and which one it makes. What is computed before
//! what follows from that alone ([`Layers::between`]).

use crate::tensors::{Role, TensorSpec};

/// Numbers that describe a point of a pillar: x, y, z, intensity, offsets to the pillar's mean and to its centre.
pub const POINT_FEATURES: usize = 10;

/// A map of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct MapId(usize);

/// Rows (along y), columns (along x) and channels of a map.
pub type MapSize = [usize; 3];

/// The layers of a network.
#[derive(Clone, Debug, PartialEq)]
pub struct Layers {
    maps: Vec<MapSize>,
    steps: Vec<Step>,
    /// The pillars' features.
    pub canvas: MapId,
    /// An agent's BEV map, before a compressor.
    pub own: MapId,
    /// What an agent keeps of it for its own fusion: all of it, or what it shares.
    pub kept: MapId,
    /// What agents share: that map, compressed if the model compresses.
    pub features: MapId,
    /// What is fused: the shared map, restored if the model compresses.
    pub restored: MapId,
    /// The map that the heads read: the shared one where nothing is fused.
    pub fused: MapId,
    /// Logits, `anchors * classes` for each cell.
    pub scores: MapId,
    /// Boxes as deltas to their anchors, `anchors * 7` for each cell.
    pub deltas: MapId,
    /// `scores`, then `deltas`.
    pub heads: MapId,
}

/// A layer and its place in the network.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// What is computed.
    pub layer: Layer,
    /// Maps that it reads; the pillar layer reads points instead.
    pub from: Vec<MapId>,
    /// The map that it makes.
    pub to: MapId,
}

/// What a step computes.
#[derive(Clone, Debug, PartialEq)]
pub enum Layer {
    /// From points to the features of pillars.
    Points(PointLayer),
    /// A convolution of one map.
    Convolution(ConvLayer),
    /// Several maps side by side in their channels.
    Join,
    /// Maps of several agents become one. Where it reads two maps, the second is the one that the ego has kept of its own.
    Fuse(FuseLayer),
}

/// The fusion of the maps of several agents, brought to the ego's place, as one of the same size.
#[derive(Clone, Debug, PartialEq)]
pub struct FuseLayer {
    /// Channels of the maps.
    pub channels: usize,
    /// Channels of the backbone's last block, for which a fusion may scale its products.
    pub width: usize,
    /// Its tensors, in the order of the state dict.
    pub tensors: Vec<TensorSpec>,
}

/// A linear layer with batch norm and ReLU on every point, and the maximum over a pillar's points.
#[derive(Clone, Debug, PartialEq)]
pub struct PointLayer {
    /// Key of the linear layer.
    pub key: String,
    /// Key of the batch norm.
    pub norm: String,
    /// Features that it gives.
    pub channels: usize,
}

/// A convolution: 1x1 or 3x3 with zeros around the map, or transposed with a kernel as wide as its stride.
#[derive(Clone, Debug, PartialEq)]
pub struct ConvLayer {
    /// Key.
    pub key: String,
    /// Channels that it reads.
    pub inputs: usize,
    /// Channels that it gives.
    pub outputs: usize,
    /// Side of the kernel.
    pub kernel: usize,
    /// Cells from one window to the next, or the factor of enlargement.
    pub stride: usize,
    /// Whether it enlarges the map.
    pub transposed: bool,
    /// Whether it has biases.
    pub bias: bool,
    /// Key of the batch norm after it.
    pub norm: Option<String>,
    /// Whether negative results become zero.
    pub relu: bool,
}

impl PointLayer {
    /// Key of the linear layer's weights, `[channels, 10]`.
    pub fn weight_key(&self) -> String {
        format!("{}.weight", self.key)
    }

    fn tensors(&self) -> Vec<TensorSpec> {
        let weight = TensorSpec {
            key: self.weight_key(),
            shape: vec![self.channels, POINT_FEATURES],
            role: Role::Weight { fan_in: POINT_FEATURES },
        };
        std::iter::once(weight)
            .chain(TensorSpec::norm(&self.norm, self.channels))
            .collect()
    }
}

impl ConvLayer {
    /// Key of the weights: `[outputs, inputs, kernel, kernel]`, `[inputs, outputs, kernel, kernel]` if transposed.
    pub fn weight_key(&self) -> String {
        format!("{}.weight", self.key)
    }

    /// Key of the biases, if there are any.
    pub fn bias_key(&self) -> Option<String> {
        self.bias.then(|| format!("{}.bias", self.key))
    }

    /// Size of the map that it makes.
    pub fn size(&self, [rows, columns, _]: MapSize) -> MapSize {
        let along = |cells: usize| match self.transposed {
            true => cells * self.stride,
            false => cells.div_ceil(self.stride),
        };
        [along(rows), along(columns), self.outputs]
    }

    /// Multiplications and additions on a map of this size.
    pub fn operations(&self, from: MapSize) -> f64 {
        let [rows, columns, _] = if self.transposed { from } else { self.size(from) };
        2.0 * (rows * columns * self.kernel * self.kernel * self.inputs * self.outputs) as f64
    }

    fn tensors(&self) -> Vec<TensorSpec> {
        let (taps, side) = (self.kernel * self.kernel, self.kernel);
        // Every output of a transposed convolution sees one cell of the input.
        let (shape, fan_in) = match self.transposed {
            true => (vec![self.inputs, self.outputs, side, side], self.inputs),
            false => (vec![self.outputs, self.inputs, side, side], self.inputs * taps),
        };
        let weight = TensorSpec {
            key: self.weight_key(),
            shape,
            role: Role::Weight { fan_in },
        };
        let bias = self.bias_key().map(|key| TensorSpec {
            key,
            shape: vec![self.outputs],
            role: Role::Bias,
        });
        let norm = self.norm.iter().flat_map(|key| TensorSpec::norm(key, self.outputs));
        std::iter::once(weight).chain(bias).chain(norm).collect()
    }
}

impl Layer {
    /// Its tensors, in the order of the state dict.
    pub fn tensors(&self) -> Vec<TensorSpec> {
        match self {
            Layer::Points(layer) => layer.tensors(),
            Layer::Convolution(layer) => layer.tensors(),
            Layer::Join => Vec::new(),
            Layer::Fuse(layer) => layer.tensors.clone(),
        }
    }
}

impl Layers {
    /// Size of a map.
    pub fn size(&self, map: MapId) -> MapSize {
        self.maps[map.0]
    }

    /// All steps, in the order of the state dict.
    pub fn steps(&self) -> &[Step] {
        &self.steps
    }

    /// All tensors, in the order of the state dict.
    pub fn tensors(&self) -> impl Iterator<Item = TensorSpec> {
        self.steps.iter().flat_map(|step| step.layer.tensors())
    }

    /// The layer that reads points.
    pub fn points(&self) -> Option<&PointLayer> {
        self.steps.iter().find_map(|step| match &step.layer {
            Layer::Points(layer) => Some(layer),
            _ => None,
        })
    }

    /// The map that the maker of another reads first.
    pub fn before(&self, map: MapId) -> Option<MapId> {
        let maker = self.steps.iter().find(|step| step.to == map);
        maker.and_then(|step| step.from.first().copied())
    }

    /// How the network fuses, if it does.
    pub fn fusion(&self) -> Option<&FuseLayer> {
        self.steps.iter().find_map(|step| match &step.layer {
            Layer::Fuse(layer) => Some(layer),
            _ => None,
        })
    }

    /// The maps of one agent that convolutions read, up to the one that is fused, each with the key of the layer that makes
    /// it: what a network of bytes keeps in bytes. A map of others side by side is each of them.
    pub fn read_in_bytes(&self) -> Vec<(String, MapId)> {
        let encode = self.between(&[self.canvas], &[self.features]);
        let restore = self.between(&[self.features], &[self.restored]);
        let convolutions = |step: &&Step| matches!(step.layer, Layer::Convolution(_));
        let read = encode.iter().chain(&restore).copied().filter(convolutions);
        let mut maps: Vec<MapId> = read.flat_map(|step| self.members(step.from[0])).collect();
        maps.sort();
        maps.dedup();
        maps.into_iter().map(|map| (self.key(map), map)).collect()
    }

    /// Products of a sum of each convolution that reads bytes, by its key.
    pub fn products_in_bytes(&self) -> Vec<(String, usize)> {
        let parts = [[self.canvas, self.features], [self.features, self.restored]];
        let steps = parts.into_iter().flat_map(|[from, to]| self.between(&[from], &[to]));
        steps
            .filter_map(|step| match &step.layer {
                Layer::Convolution(layer) => Some((layer.key.clone(), layer.inputs * layer.kernel * layer.kernel)),
                _ => None,
            })
            .collect()
    }

    /// The maps that a map of others side by side is made of; of every other map, itself.
    pub fn members(&self, map: MapId) -> Vec<MapId> {
        match self.steps.iter().find(|step| step.to == map) {
            Some(Step {
                layer: Layer::Join,
                from,
                ..
            }) => from.iter().flat_map(|map| self.members(*map)).collect(),
            _ => vec![map],
        }
    }

    /// Key of the layer that makes a map; empty if it has none.
    pub fn key(&self, map: MapId) -> String {
        let maker = self.steps.iter().find(|step| step.to == map);
        match maker.map(|step| &step.layer) {
            Some(Layer::Points(layer)) => layer.key.clone(),
            Some(Layer::Convolution(layer)) => layer.key.clone(),
            _ => String::new(),
        }
    }

    /// Numbers of all maps together.
    pub fn numbers(&self) -> usize {
        let each = self.maps.iter().map(|size| size.iter().product());
        each.fold(0, usize::saturating_add)
    }

    /// The tensors that lead from points to an agent's own map.
    pub fn encoder(&self) -> impl Iterator<Item = TensorSpec> {
        let steps = self.between(&[], &[self.own]);
        steps.into_iter().flat_map(|step| step.layer.tensors())
    }

    /// The tensors that lead from an agent's own map over what crosses to what is fused.
    pub fn compressor(&self) -> impl Iterator<Item = TensorSpec> {
        let steps = self.between(&[self.own], &[self.restored]);
        steps.into_iter().flat_map(|step| step.layer.tensors())
    }

    /// The steps that lead from the given maps to the wanted ones, in an order in which they can be computed: of those
    /// that could be next, the one listed last, so that a map is read while it is in the caches.
    ///
    /// # Panics
    /// If a wanted map does not follow from the given ones.
    pub fn between(&self, given: &[MapId], wanted: &[MapId]) -> Vec<&Step> {
        let mut is_there = vec![false; self.maps.len()];
        given.iter().for_each(|map| is_there[map.0] = true);
        let mut is_needed = vec![false; self.maps.len()];
        wanted.iter().for_each(|map| is_needed[map.0] = !is_there[map.0]);
        // A step reads only maps of steps before it.
        let mut left: Vec<&Step> = Vec::new();
        for step in self.steps.iter().rev().filter(|step| !is_there[step.to.0]) {
            if is_needed[step.to.0] {
                step.from.iter().for_each(|map| is_needed[map.0] |= !is_there[map.0]);
                left.push(step);
            }
        }
        let mut order = Vec::with_capacity(left.len());
        while !left.is_empty() {
            let ready = |step: &&Step| step.from.iter().all(|map| is_there[map.0]);
            let next = left
                .iter()
                .position(ready)
                .expect("a map that follows from the given ones");
            let step = left.remove(next);
            is_there[step.to.0] = true;
            order.push(step);
        }
        order
    }
}

/// Puts layers together; every map comes from a step before it.
#[derive(Debug, Default)]
pub struct Builder {
    maps: Vec<MapSize>,
    steps: Vec<Step>,
}

impl Builder {
    /// Adds the layer that reads points, and the canvas that it fills.
    pub fn points(&mut self, layer: PointLayer, [rows, columns]: [usize; 2]) -> MapId {
        let size = [rows, columns, layer.channels];
        self.step(Layer::Points(layer), Vec::new(), size)
    }

    /// Adds a convolution.
    ///
    /// # Panics
    /// If it reads another number of channels than the map has.
    pub fn convolution(&mut self, layer: ConvLayer, from: MapId) -> MapId {
        let size = self.size(from);
        assert_eq!(size[2], layer.inputs, "channels that `{}` reads", layer.key);
        let made = layer.size(size);
        self.step(Layer::Convolution(layer), vec![from], made)
    }

    /// Adds a map of others side by side; nobody else may read them but a training's loss.
    ///
    /// # Panics
    /// If there are none, or their rows and columns differ.
    pub fn join(&mut self, from: Vec<MapId>) -> MapId {
        let [rows, columns, _] = self.size(from[0]);
        let sizes = from.iter().map(|map| self.size(*map));
        let channels = sizes
            .map(|size| {
                assert_eq!([size[0], size[1]], [rows, columns], "rows and columns of joined maps");
                size[2]
            })
            .sum();
        self.step(Layer::Join, from, [rows, columns, channels])
    }

    /// Adds the fusion of several agents' maps, and of the one that the ego has kept if it is another.
    ///
    /// # Panics
    /// If there are none, or it fuses another number of channels than a map has.
    pub fn fuse(&mut self, layer: FuseLayer, from: Vec<MapId>) -> MapId {
        let size = self.size(from[0]);
        for map in &from {
            assert_eq!(
                self.size(*map),
                [size[0], size[1], layer.channels],
                "maps that are fused"
            );
        }
        self.step(Layer::Fuse(layer), from, size)
    }

    /// Size of a map so far.
    pub fn size(&self, map: MapId) -> MapSize {
        self.maps[map.0]
    }

    /// The network of one agent, from `canvas` over `features` to its heads.
    pub fn finish(self, canvas: MapId, features: MapId, heads: [MapId; 2]) -> Layers {
        self.finish_fused(canvas, [features; 5], heads)
    }

    /// The network from `canvas` to an agent's own map, to what it keeps of it, to what agents share of it, to the same restored, to the
    /// fused one, to its heads.
    pub fn finish_fused(
        mut self,
        canvas: MapId,
        [own, kept, features, restored, fused]: [MapId; 5],
        [scores, deltas]: [MapId; 2],
    ) -> Layers {
        let heads = self.join(vec![scores, deltas]);
        Layers {
            maps: self.maps,
            steps: self.steps,
            canvas,
            own,
            kept,
            features,
            restored,
            fused,
            scores,
            deltas,
            heads,
        }
    }

    fn step(&mut self, layer: Layer, from: Vec<MapId>, size: MapSize) -> MapId {
        let to = MapId(self.maps.len());
        self.maps.push(size);
        self.steps.push(Step { layer, from, to });
        to
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{lite, small};

    #[test]
    fn steps_run_as_soon_as_their_maps_are_there_and_the_last_listed_first() {
        let layers = Layers::of(&small(8, 12, false));
        let names = |steps: Vec<&Step>| -> Vec<String> {
            let name = |step: &Step| match &step.layer {
                Layer::Points(layer) => layer.key.clone(),
                Layer::Convolution(layer) => layer.key.replace("backbone.", ""),
                Layer::Join => "join".into(),
                Layer::Fuse(_) => "fuse".into(),
            };
            steps.into_iter().map(name).collect()
        };
        let encode = names(layers.between(&[layers.canvas], &[layers.features]));
        assert_eq!(
            encode,
            [
                "blocks.0.1",
                "blocks.0.4",
                "deblocks.0.0",
                "blocks.1.1",
                "blocks.1.4",
                "blocks.1.7",
                "deblocks.1.0",
                "join",
                "shrink_conv.layers.0.double_conv.0",
                "shrink_conv.layers.0.double_conv.2",
            ]
        );
        let mut all = names(layers.between(&[], &[layers.scores, layers.deltas]));
        assert_eq!(all.remove(0), "pillar_vfe.pfn_layers.0.linear");
        assert_eq!(all[..encode.len()], encode[..]);
        all[encode.len()..].sort();
        assert_eq!(all[encode.len()..], ["cls_head", "reg_head"]);
        assert!(layers.between(&[layers.features], &[layers.features]).is_empty());
    }

    #[test]
    fn the_model_that_ships_has_its_maps_and_tensors() {
        let layers = Layers::of(&lite());
        assert_eq!(layers.size(layers.canvas), [200, 512, 32]);
        assert_eq!(layers.size(layers.features), [100, 256, 64]);
        assert_eq!(layers.size(layers.heads), [100, 256, 60]);
        assert_eq!(layers.tensors().map(|tensor| tensor.count()).sum::<usize>(), 991_164);
        assert_eq!(layers.points().unwrap().channels, 32);
    }

    #[test]
    #[should_panic(expected = "a map that follows from the given ones")]
    fn a_map_from_nowhere_is_a_bug() {
        let layers = Layers::of(&lite());
        let mut cut = layers.clone();
        cut.steps.remove(1);
        cut.between(&[layers.canvas], &[layers.features]);
    }
}

//! PointPillars as V2X-Real builds it: pillar layer, backbone, shrink layers, heads. Keys are those of its state dict.

use super::architecture::Architecture;
use super::problems::Problems;
use super::settings::{Backbone, Model, Shrink};
use crate::layers::{Builder, ConvLayer, FuseLayer, Layers, MapId, PointLayer};

impl Layers {
    /// The layers of a model that fits together, in the order of the state dict.
    pub fn of<A: Architecture>(model: &Model<A>) -> Layers {
        let mut builder = Builder::default();
        let canvas = pillars(&mut builder, model);
        let joined = backbone(&mut builder, &model.backbone, canvas);
        let features = convolutions(&mut builder, SHRINK, &model.shrink, joined);
        let Some(sharing) = model.arch.sharing() else {
            let outputs = refined_heads(&mut builder, model, features);
            return builder.finish(canvas, features, outputs);
        };
        let crossed = sharing.compress(&mut builder, features);
        let restored = sharing.restore(&mut builder, crossed);
        let channels = builder.size(restored)[2];
        let layer = FuseLayer {
            channels,
            width: model.backbone.channels.last().copied().unwrap_or(1),
            tensors: model.arch.tensors(channels),
        };
        let kept = if sharing.keeps_own() { features } else { crossed };
        let mut read = vec![restored];
        read.extend(sharing.keeps_own().then_some(features));
        let fused = builder.fuse(layer, read);
        let outputs = refined_heads(&mut builder, model, fused);
        builder.finish_fused(canvas, [features, kept, crossed, restored, fused], outputs)
    }
}

impl<A: Architecture> Model<A> {
    /// Rows (along y) and columns (along x) of the BEV map and the heads.
    pub fn map_size(&self) -> [usize; 2] {
        let layers = Layers::of(self);
        let [rows, columns, _] = layers.size(layers.features);
        [rows, columns]
    }

    /// Channels of the BEV map that agents share.
    pub fn map_channels(&self) -> usize {
        let layers = Layers::of(self);
        layers.size(layers.features)[2]
    }
}

/// Notes what of a model, whose parts are within their bounds, does not fit together: every block's enlarged map has the size of
/// the first's, and what is fused fits the map.
pub(super) fn check<A: Architecture>(model: &Model<A>, problems: &mut Problems) {
    let Backbone {
        strides, up_strides, ..
    } = &model.backbone;
    problems.require(strides[0] % up_strides[0] == 0, || {
        format!(
            "backbone: expected strides[0] to be a multiple of up_strides[0], found {} and {}",
            strides[0], up_strides[0]
        )
    });
    let mut size = [model.grid.rows(), model.grid.columns()];
    let mut first = None;
    for (block, (stride, up)) in strides.iter().zip(up_strides).enumerate() {
        size = size.map(|cells| cells.div_ceil(*stride));
        let found = size.map(|cells| cells * up);
        let expected = *first.get_or_insert(found);
        problems.require(found == expected, || {
            format!(
                "backbone block {block}: expected a map of {}x{} after enlarging, found {}x{}",
                expected[0], expected[1], found[0], found[1]
            )
        });
    }
    if let Some(sharing) = model.arch.sharing() {
        sharing.check(channels(model), problems);
        model.arch.check(map(model), problems);
    }
}

/// Rows, columns and channels of the map after the shrink layers.
fn map<A: Architecture>(model: &Model<A>) -> [usize; 3] {
    let first = |cells: usize| cells.div_ceil(model.backbone.strides[0]) * model.backbone.up_strides[0];
    [first(model.grid.rows()), first(model.grid.columns()), channels(model)]
}

/// Channels of the map after the shrink layers.
fn channels<A: Architecture>(model: &Model<A>) -> usize {
    let joined = || model.backbone.up_channels.iter().sum();
    model.shrink.last().map_or_else(joined, |shrink| shrink.channels)
}

/// The pillar layer and its canvas.
fn pillars<A: Architecture>(builder: &mut Builder, model: &Model<A>) -> MapId {
    let layer = PointLayer {
        key: "pillar_vfe.pfn_layers.0.linear".into(),
        norm: "pillar_vfe.pfn_layers.0.norm".into(),
        channels: model.pillars.channels,
    };
    builder.points(layer, [model.grid.rows(), model.grid.columns()])
}

/// Blocks of 3x3 convolutions, each enlarged to one size, side by side.
fn backbone(builder: &mut Builder, settings: &Backbone, canvas: MapId) -> MapId {
    let key = |part: &str, block: usize, index: usize| format!("backbone.{part}.{block}.{index}");
    let mut map = canvas;
    let mut made = Vec::new();
    for (block, outputs) in settings.channels.iter().enumerate() {
        for layer in 0..=settings.layers[block] {
            let convolution = ConvLayer {
                // Index 0 of a block is padding, every third after it a ReLU.
                key: key("blocks", block, 1 + 3 * layer),
                inputs: builder.size(map)[2],
                outputs: *outputs,
                kernel: 3,
                stride: if layer == 0 { settings.strides[block] } else { 1 },
                transposed: false,
                bias: false,
                norm: Some(key("blocks", block, 2 + 3 * layer)),
                relu: true,
            };
            map = builder.convolution(convolution, map);
        }
        made.push(map);
    }
    let enlarged = made.into_iter().enumerate().map(|(block, map)| {
        let convolution = ConvLayer {
            key: key("deblocks", block, 0),
            inputs: builder.size(map)[2],
            outputs: settings.up_channels[block],
            kernel: settings.up_strides[block],
            stride: settings.up_strides[block],
            transposed: true,
            bias: false,
            norm: Some(key("deblocks", block, 1)),
            relu: true,
        };
        builder.convolution(convolution, map)
    });
    let enlarged = enlarged.collect();
    builder.join(enlarged)
}

/// Keys of the convolutions after the backbone.
const SHRINK: &str = "shrink_conv.layers.0.double_conv";
/// The key before those of the convolutions between the fused map and the heads, which V2X-Real does not have.
pub const REFINE: &str = "refine_conv";

/// Convolutions with bias and ReLU, one after the other.
fn convolutions(builder: &mut Builder, key: &str, layers: &[Shrink], from: MapId) -> MapId {
    layers.iter().enumerate().fold(from, |map, (index, layer)| {
        let convolution = ConvLayer {
            // Every second entry of the list is a ReLU.
            key: format!("{key}.{}", 2 * index),
            inputs: builder.size(map)[2],
            outputs: layer.channels,
            kernel: layer.kernel,
            stride: 1,
            transposed: false,
            bias: true,
            norm: None,
            relu: true,
        };
        builder.convolution(convolution, map)
    })
}

/// Scores and deltas of the fused map.
fn refined_heads<A: Architecture>(builder: &mut Builder, model: &Model<A>, fused: MapId) -> [MapId; 2] {
    let refined = convolutions(builder, REFINE, &model.refine, fused);
    heads(builder, model, refined)
}

/// Scores and deltas.
pub fn heads<A: Architecture>(builder: &mut Builder, model: &Model<A>, features: MapId) -> [MapId; 2] {
    let anchors = model.anchors();
    [("cls_head", anchors * model.classes.len()), ("reg_head", anchors * 7)].map(|(key, outputs)| {
        let convolution = ConvLayer {
            key: key.into(),
            inputs: builder.size(features)[2],
            outputs,
            kernel: 1,
            stride: 1,
            transposed: false,
            bias: true,
            norm: None,
            relu: false,
        };
        builder.convolution(convolution, features)
    })
}

//! PointPillars as V2X-Real builds it: pillar layer, backbone, shrink layers, heads. Keys are those of its state dict.

use crate::layers::{Builder, ConvLayer, Layers, MapId, PointLayer};
use crate::model::{Backbone, Model, Problems};

/// The layers in the order of the state dict.
pub fn layers(model: &Model) -> Layers {
    let mut builder = Builder::default();
    let canvas = pillars(&mut builder, model);
    let joined = backbone(&mut builder, &model.backbone, canvas);
    let features = shrink(&mut builder, model, joined);
    let outputs = heads(&mut builder, model, features);
    builder.finish(canvas, features, outputs)
}

/// Every block's enlarged map has the size of the first's.
pub fn check(model: &Model, problems: &mut Problems) {
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
}

/// Rows, columns and channels of the map after the shrink layers.
pub fn map(model: &Model) -> [usize; 3] {
    let first = |cells: usize| cells.div_ceil(model.backbone.strides[0]) * model.backbone.up_strides[0];
    [first(model.grid.rows()), first(model.grid.columns()), channels(model)]
}

/// Channels of the map after the shrink layers.
pub fn channels(model: &Model) -> usize {
    let joined = || model.backbone.up_channels.iter().sum();
    model.shrink.last().map_or_else(joined, |shrink| shrink.channels)
}

/// The pillar layer and its canvas.
pub fn pillars(builder: &mut Builder, model: &Model) -> MapId {
    let layer = PointLayer {
        key: "pillar_vfe.pfn_layers.0.linear".into(),
        norm: "pillar_vfe.pfn_layers.0.norm".into(),
        channels: model.pillars.channels,
    };
    builder.points(layer, [model.grid.rows(), model.grid.columns()])
}

/// Blocks of 3x3 convolutions, each enlarged to one size, side by side.
pub fn backbone(builder: &mut Builder, settings: &Backbone, canvas: MapId) -> MapId {
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

/// The convolutions after the backbone.
pub fn shrink(builder: &mut Builder, model: &Model, joined: MapId) -> MapId {
    let layers = model.shrink.iter().enumerate();
    layers.fold(joined, |map, (index, shrink)| {
        let convolution = ConvLayer {
            // Every second entry of the list is a ReLU.
            key: format!("shrink_conv.layers.0.double_conv.{}", 2 * index),
            inputs: builder.size(map)[2],
            outputs: shrink.channels,
            kernel: shrink.kernel,
            stride: 1,
            transposed: false,
            bias: true,
            norm: None,
            relu: true,
        };
        builder.convolution(convolution, map)
    })
}

/// Scores and deltas.
pub fn heads(builder: &mut Builder, model: &Model, features: MapId) -> [MapId; 2] {
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

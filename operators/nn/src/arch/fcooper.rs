//! F-Cooper: the largest of each feature (Chen et al. 2019), as V2X-Real builds it.

use super::pointpillars::{backbone, heads, pillars, shrink};
use super::sharing::Sharing;
use crate::layers::{Builder, Fusion, Layers};
use crate::model::Model;

/// The layers in the order of the state dict.
pub fn layers(model: &Model, sharing: &Sharing) -> Layers {
    let mut builder = Builder::default();
    let canvas = pillars(&mut builder, model);
    let joined = backbone(&mut builder, &model.backbone, canvas);
    let features = shrink(&mut builder, model, joined);
    let crossed = sharing.compress(&mut builder, features);
    let restored = sharing.restore(&mut builder, crossed);
    let fused = builder.fuse(Fusion::Max, restored);
    let outputs = heads(&mut builder, model, fused);
    builder.finish_fused(canvas, [crossed, restored, fused], outputs)
}

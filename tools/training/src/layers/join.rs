//! Maps side by side in their channels.

use candle_core::{Result, Tensor, bail};

use super::map::{MapShape, buffer, tensor, with_numbers};

/// The maps' channels one after the other; all maps have one size.
///
/// # Errors
/// If there is no map, or sizes differ.
pub fn join(maps: &[Tensor]) -> Result<Tensor> {
    let shapes: Vec<MapShape> = maps
        .iter()
        .map(|map| MapShape::of(map.shape()))
        .collect::<Result<_>>()?;
    let Some(first) = shapes.first() else {
        bail!("no maps to join");
    };
    if let Some(other) = shapes
        .iter()
        .find(|other| other.with_channels(first.channels) != *first)
    {
        bail!("maps of different sizes cannot be joined: {first:?} and {other:?}");
    }
    let all = first.with_channels(shapes.iter().map(|shape| shape.channels).sum());
    let mut out = buffer(all.len());
    let mut offset = 0;
    for (map, shape) in maps.iter().zip(&shapes) {
        with_numbers(map, |from| {
            copy_channels(&mut out, &all, offset, from, shape);
            Ok(())
        })?;
        offset += shape.channels;
    }
    tensor(out, all.dims())
}

/// The maps that [`join`] joined, or their gradients, by their numbers of channels.
///
/// # Errors
/// If the map has not as many channels as all of them together.
pub fn split(map: &Tensor, channels: &[usize]) -> Result<Vec<Tensor>> {
    let all = MapShape::of(map.shape())?;
    if channels.iter().sum::<usize>() != all.channels {
        bail!("{} channels cannot be split into {channels:?}", all.channels);
    }
    let mut offset = 0;
    let part = |&channels: &usize| {
        let shape = all.with_channels(channels);
        let mut out = buffer(shape.len());
        with_numbers(map, |from| {
            shape.fill_rows(&mut out, |image, row, cells| {
                let from = all.row(from, image, row).chunks_exact(all.channels);
                for (out, from) in cells.chunks_exact_mut(channels).zip(from) {
                    out.copy_from_slice(&from[offset..offset + channels]);
                }
            });
            Ok(())
        })?;
        offset += channels;
        tensor(out, shape.dims())
    };
    channels.iter().map(part).collect()
}

fn copy_channels(out: &mut [f32], all: &MapShape, offset: usize, from: &[f32], shape: &MapShape) {
    use rayon::prelude::*;
    out.par_chunks_mut(all.pitch())
        .zip(from.par_chunks(shape.pitch()))
        .for_each(|(out, from)| {
            let cells = out
                .chunks_exact_mut(all.channels)
                .zip(from.chunks_exact(shape.channels));
            for (out, from) in cells {
                out[offset..offset + shape.channels].copy_from_slice(from);
            }
        });
}

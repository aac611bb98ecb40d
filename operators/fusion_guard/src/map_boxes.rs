//! The boxes of a BEV map: those that the heads of its model find in it alone.

use std::path::Path;

use nalgebra::Vector2;
use realo_bev::{Computing, Decoded, Decoder, Engine, Maps};
use realo_nn::anchors::Anchors;
use realo_nn::layers::Layers;
use realo_operator::{Error, Steps};
use realo_schemas::geometry::{Footprint, detection_fault, iou_exceeds};
use realo_schemas::{Box3, Elements, FeatureMap};

/// A box is a duplicate if it overlaps more than this with a better one.
const DUPLICATE: f64 = 0.15;
/// How far outside its map the centre of a found box may be, m.
const MAX_OUTSIDE_M: f64 = 10.0;
/// Features of a box lie in cells around it, too, m.
const AROUND_M: f64 = 0.8;

/// What the heads of the model find in a map.
#[derive(Debug)]
pub(crate) struct MapContent {
    /// Boxes in it, best first.
    pub boxes: Vec<Box3>,
    /// Found boxes of impossible size, or farther outside the map than [`MAX_OUTSIDE_M`]. An encoder's map has none; noise has many.
    pub impossible: usize,
}

/// Finds boxes in maps of one model.
pub(crate) struct MapDetector {
    engine: Engine,
    decoder: Decoder,
    maps: Maps,
    /// Rows, columns and channels of the maps that an agent keeps for its own fusion, and of those that agents share.
    sizes: [[usize; 3]; 2],
    max_boxes: usize,
}

impl MapDetector {
    /// For the maps of a model file; at most the best `max_boxes` of each.
    ///
    /// # Errors
    /// A file that is not a model, or kernels that this machine or the model does not have.
    pub fn new(model: &Path, computing: &Computing, max_boxes: usize) -> Result<Self, Error> {
        let loaded = computing.load(model)?;
        let layers = Layers::of(&loaded.model);
        Ok(MapDetector {
            decoder: Decoder::new(Anchors::of(&loaded.model), loaded.model.score_threshold),
            maps: Maps::of(&loaded),
            sizes: [layers.kept, layers.features].map(|map| layers.size(map)),
            engine: Engine::new(loaded, computing.device, Elements::F32)?,
            max_boxes,
        })
    }

    /// Name and digest of the model.
    pub fn identity(&self) -> &str {
        &self.maps.identity
    }

    /// Returns what a map shows. `None` if the map does not fit the model or has values that are not finite or beyond 1e15;
    /// fusions reject such maps.
    ///
    /// # Errors
    /// Those of the device.
    pub fn boxes(&mut self, map: &FeatureMap, steps: &mut Steps) -> Result<Option<MapContent>, Error> {
        let read = self.maps.read(map).ok();
        let Some(map) = read.filter(|map| self.sizes.contains(&map.size()) && map.is_sound()) else {
            return Ok(None);
        };
        let [rows, columns, _] = map.size();
        let area = Area::of(&self.maps, rows, columns);
        let heads = self.engine.heads_alone(map.view(), steps)?;
        let Decoded {
            boxes: found, invalid, ..
        } = self.decoder.decode(&heads.scores, &heads.deltas);
        let mut kept: Vec<(Footprint, Box3)> = Vec::new();
        let all = found.len();
        let possible = |object: &Box3| detection_fault(object).is_none() && area.has(object);
        let sound: Vec<Box3> = found.into_iter().filter(possible).collect();
        let impossible = all - sound.len() + usize::try_from(invalid).unwrap_or(usize::MAX);
        for object in sound {
            let ground = Footprint::of(&object);
            if kept.len() < self.max_boxes && !kept.iter().any(|(better, _)| iou_exceeds(better, &ground, DUPLICATE)) {
                kept.push((ground, object));
            }
        }
        Ok(Some(MapContent {
            boxes: kept.into_iter().map(|(_, object)| object).collect(),
            impossible,
        }))
    }
}

/// Ground that a map covers, m.
struct Area {
    min: [f64; 2],
    max: [f64; 2],
}

impl Area {
    fn of(maps: &Maps, rows: usize, columns: usize) -> Self {
        let cells = [columns, rows].map(|cells| cells as f64 * maps.cell);
        let [x, y] = maps.origin;
        Area {
            min: [x, y],
            max: [x + cells[0], y + cells[1]],
        }
    }

    fn has(&self, object: &Box3) -> bool {
        (0..2).all(|axis| {
            let [min, max] = [self.min[axis] - MAX_OUTSIDE_M, self.max[axis] + MAX_OUTSIDE_M];
            (min..=max).contains(&object.center[axis])
        })
    }
}

/// A map of f32 without the cells of some boxes: their features are 0, and the sender takes no part in what is said of them.
pub(crate) fn without_cells_of(boxes: &[&Box3], map: &FeatureMap) -> FeatureMap {
    let (false, Ok(numbers)) = (boxes.is_empty(), map.numbers()) else {
        return map.clone();
    };
    let (columns, channels) = (map.columns as usize, map.channels as usize);
    let mut numbers = numbers.into_owned();
    let mut confidence = match &map.confidence {
        Some(confidence) => confidence.to_vec(),
        None => vec![1.0; map.rows as usize * columns],
    };
    for (at, (confidence, features)) in confidence
        .iter_mut()
        .zip(numbers.chunks_exact_mut(channels))
        .enumerate()
    {
        let center = |cell: usize, axis: usize| map.origin[axis] + (cell as f64 + 0.5) * map.cell;
        let place = Vector2::new(center(at % columns, 0), center(at / columns, 1));
        if boxes.iter().any(|object| covers(object, &place)) {
            *confidence = 0.0;
            features.fill(0.0);
        }
    }
    FeatureMap {
        confidence: Some(confidence.into()),
        ..map.with_numbers(numbers)
    }
}

/// Whether a place is on a box's ground, or next to it.
fn covers(object: &Box3, place: &Vector2<f64>) -> bool {
    let (sin, cos) = libm::sincos(object.yaw);
    let (x, y) = (place.x - object.center[0], place.y - object.center[1]);
    let [along, across] = [x * cos + y * sin, y * cos - x * sin];
    along.abs() <= 0.5 * object.length + AROUND_M && across.abs() <= 0.5 * object.width + AROUND_M
}

#[cfg(test)]
mod tests {
    use realo_kernels::bev::BevMap;

    use super::*;

    #[test]
    fn cells_of_a_box_and_around_it_are_gone_and_no_others() {
        let maps = Maps {
            identity: "lite-1".into(),
            origin: [-10.0, -5.0],
            cell: 0.5,
        };
        let map = maps.write(BevMap {
            rows: 20,
            columns: 40,
            channels: 1,
            data: vec![7.0; 20 * 40],
        });
        let object = Box3::new("Car", [2.0, -1.0, 0.8], [4.0, 1.9, 1.6], std::f64::consts::FRAC_PI_2);
        let left = without_cells_of(&[&object], &map);
        let at = |x: f64, y: f64| {
            let [column, row] = [(x + 10.0) / 0.5, (y + 5.0) / 0.5].map(|cell| cell as usize);
            let feature = left.numbers().expect("it can be read")[row * 40 + column];
            (
                left.confidence.as_ref().expect("cells are gone")[row * 40 + column],
                feature,
            )
        };
        assert_eq!([at(2.1, -1.1), at(2.1, 1.6), at(0.4, -3.6)], [(0.0, 0.0); 3]);
        assert_eq!([at(2.1, 2.1), at(-0.1, -1.1), at(-9.9, -4.9)], [(1.0, 7.0); 3]);
        assert_eq!(without_cells_of(&[], &map), map);
        let of_less = FeatureMap {
            confidence: Some(vec![0.0; 800].into()),
            ..map
        };
        assert_eq!(without_cells_of(&[&object], &of_less).confidence, of_less.confidence);
    }
}

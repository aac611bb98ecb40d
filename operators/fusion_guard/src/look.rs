//! What a map of features shows by itself: the boxes that the heads of its model find in it.

use std::path::Path;

use nalgebra::Vector2;
use realo_bev::{Computing, Decoder, Engine, Maps};
use realo_nn::anchors::Anchors;
use realo_operator::{Error, Steps};
use realo_schemas::geometry::{Footprint, iou_exceeds};
use realo_schemas::{Box3, Elements, FeatureMap};

/// A box is a duplicate if it overlaps more than this with a better one.
const DUPLICATE: f64 = 0.15;
/// What is dropped of a map around a box that is not there, m: its features lie in cells around it, too.
const AROUND_M: f64 = 0.8;

/// Reads maps of one model.
pub(crate) struct Looker {
    engine: Engine,
    decoder: Decoder,
    maps: Maps,
}

impl Looker {
    /// For the maps of a model file.
    ///
    /// # Errors
    /// A file that is not a model, or kernels that this machine or the model does not have.
    pub fn new(model: &Path, computing: &Computing) -> Result<Self, Error> {
        let loaded = computing.load(model)?;
        Ok(Looker {
            decoder: Decoder::new(Anchors::of(&loaded.model), loaded.model.score_threshold),
            maps: Maps::of(&loaded),
            engine: Engine::new(loaded, computing.device, Elements::F32)?,
        })
    }

    /// The boxes that a map shows, best first; `None` for one that is not of the model or that no network makes, which fusions reject.
    ///
    /// # Errors
    /// Those of the device.
    pub fn boxes(&mut self, map: &FeatureMap, steps: &mut Steps) -> Result<Option<Vec<Box3>>, Error> {
        let Some(map) = self.maps.read(map).ok().filter(|map| map.is_sound()) else {
            return Ok(None);
        };
        let heads = self.engine.heads_alone(map.view(), steps)?;
        let found = self.decoder.decode(&heads.scores, &heads.deltas).boxes;
        let mut kept: Vec<(Footprint, Box3)> = Vec::new();
        for object in found {
            let ground = Footprint::of(&object);
            if !kept.iter().any(|(better, _)| iou_exceeds(better, &ground, DUPLICATE)) {
                kept.push((ground, object));
            }
        }
        Ok(Some(kept.into_iter().map(|(_, object)| object).collect()))
    }
}

/// A map without the cells of some boxes: its sender takes no part in what is said of them.
pub(crate) fn without(map: &FeatureMap, boxes: &[&Box3]) -> FeatureMap {
    if boxes.is_empty() {
        return map.clone();
    }
    let (rows, columns) = (map.rows as usize, map.columns as usize);
    let mut confidence = match &map.confidence {
        Some(confidence) => confidence.to_vec(),
        None => vec![1.0; rows * columns],
    };
    for (at, confidence) in confidence.iter_mut().enumerate() {
        let center = |cell: usize, axis: usize| map.origin[axis] + (cell as f64 + 0.5) * map.cell;
        let place = Vector2::new(center(at % columns, 0), center(at / columns, 1));
        if boxes.iter().any(|object| is_at(object, &place)) {
            *confidence = 0.0;
        }
    }
    FeatureMap {
        confidence: Some(confidence.into()),
        ..map.clone()
    }
}

/// Whether a place is on a box's ground, or next to it.
fn is_at(object: &Box3, place: &Vector2<f64>) -> bool {
    let (sin, cos) = libm::sincos(object.yaw);
    let (x, y) = (place.x - object.center[0], place.y - object.center[1]);
    let [along, across] = [x * cos + y * sin, y * cos - x * sin];
    along.abs() <= 0.5 * object.length + AROUND_M && across.abs() <= 0.5 * object.width + AROUND_M
}

#[cfg(test)]
mod tests {
    use realo_schemas::DType;

    use super::*;

    #[test]
    fn cells_of_a_box_and_around_it_are_gone_and_no_others() {
        let map = FeatureMap {
            rows: 20,
            columns: 40,
            channels: 1,
            cell: 0.5,
            origin: [-10.0, -5.0],
            dtype: DType::F32,
            data: vec![0u8; 4 * 20 * 40].into(),
            model: "lite-1".into(),
            confidence: None,
        };
        let object = Box3::new("Car", [2.0, -1.0, 0.8], [4.0, 1.9, 1.6], std::f64::consts::FRAC_PI_2);
        let left = without(&map, &[&object]);
        let at = |x: f64, y: f64| {
            let [column, row] = [(x + 10.0) / 0.5, (y + 5.0) / 0.5].map(|cell| cell as usize);
            left.confidence.as_ref().expect("cells are gone")[row * 40 + column]
        };
        assert_eq!([at(2.1, -1.1), at(2.1, 1.6), at(0.4, -3.6)], [0.0; 3]);
        assert_eq!([at(2.1, 2.1), at(-0.1, -1.1), at(-9.9, -4.9)], [1.0; 3]);
        assert_eq!(without(&map, &[]), map);
        let of_less = FeatureMap {
            confidence: Some(vec![0.0; 800].into()),
            ..map
        };
        assert_eq!(without(&of_less, &[&object]).confidence, of_less.confidence);
    }
}

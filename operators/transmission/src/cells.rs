//! The cells of a feature map that cross, where not all do: those whose maker is surest that they hold an object.

use std::cmp::Ordering;

use arrow::buffer::{Buffer, MutableBuffer};
use realo_schemas::geometry::{bottom_corners, footprint_contains};
use realo_schemas::{Box3, FeatureMap};

use crate::error::{DecodeError, EncodeError};

/// Largest code of a confidence.
const GREATEST: f32 = 255.0;

/// What crosses beside a map, and says of some cells what they hold.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Covering<'a> {
    /// Boxes in the frame of the map.
    pub boxes: &'a [Box3],
    /// What the confidence of a cell under a box of score 1 counts, of 1.
    pub covered: f32,
}

impl Covering<'_> {
    /// What the confidence of each cell of a map counts, of 1: less, the surer the surest box is that covers its centre.
    fn weights(&self, map: &FeatureMap) -> Vec<f32> {
        let [rows, columns] = [map.rows, map.columns].map(|count| count as usize);
        let mut weights = vec![1.0f32; rows * columns];
        let cell_at = |place: f64, axis: usize, count: usize| {
            (((place - map.origin[axis]) / map.cell).floor().max(0.0) as usize).min(count)
        };
        for object in self.boxes {
            let weight = 1.0 - object.score.clamp(0.0, 1.0) * (1.0 - self.covered);
            let corners = bottom_corners(object);
            let span = |axis: usize, count: usize| {
                let places = corners.iter().map(|corner| corner[axis]);
                let (min, max) = places.fold((f64::MAX, f64::MIN), |(min, max), place| {
                    (min.min(place), max.max(place))
                });
                cell_at(min, axis, count)..(cell_at(max, axis, count) + 1).min(count)
            };
            for row in span(1, rows) {
                for column in span(0, columns) {
                    let centre = |axis: usize, index: usize| map.origin[axis] + (index as f64 + 0.5) * map.cell;
                    if footprint_contains(object, [centre(0, column), centre(1, row)]) {
                        let known = &mut weights[row * columns + column];
                        *known = known.min(weight);
                    }
                }
            }
        }
        weights
    }
}

/// Numbers of the cells of a map that are at least so sure, those first that count most: the surest, where nothing covers them.
///
/// # Errors
/// [`EncodeError::NoConfidence`] of a map that does not tell how sure it is, [`EncodeError::Length`] of one that does not tell it
/// of each cell.
pub(crate) fn ranked(map: &FeatureMap, min: f32, covering: Option<Covering>) -> Result<Vec<u32>, EncodeError> {
    let confidence = map.confidence.as_ref().ok_or(EncodeError::NoConfidence)?;
    let cells = map.rows as usize * map.columns as usize;
    if confidence.len() != cells {
        return Err(EncodeError::Length {
            field: "confidence of the feature map",
            found: 4 * confidence.len(),
            expected: 4 * cells as u128,
        });
    }
    let sure = (0..cells as u32).filter(|cell| {
        let confidence = confidence[*cell as usize];
        confidence > 0.0 && confidence >= min
    });
    let mut sure: Vec<u32> = sure.collect();
    let weights = covering.map(|covering| covering.weights(map));
    let counts = |cell: u32| {
        let weight = weights.as_ref().map_or(1.0, |weights| weights[cell as usize]);
        confidence[cell as usize] * weight
    };
    let order = |a: &u32, b: &u32| -> Ordering {
        let [of_a, of_b] = [a, b].map(|cell| counts(*cell));
        of_b.total_cmp(&of_a).then(a.cmp(b))
    };
    sure.sort_unstable_by(order);
    Ok(sure)
}

/// The map of some cells, one row of them in ascending order.
pub(crate) fn gathered(map: &FeatureMap, ascending: &[u32]) -> FeatureMap {
    let size = map.channels as usize * map.dtype.size();
    let mut data = Vec::with_capacity(ascending.len() * size);
    for cell in ascending {
        data.extend_from_slice(&map.data[*cell as usize * size..][..size]);
    }
    FeatureMap {
        rows: 1,
        columns: ascending.len() as u32,
        data: Buffer::from_vec(data),
        confidence: None,
        ..map.clone()
    }
}

/// Bytes of [`write`] for so many cells of a map of so many.
pub(crate) fn length(crossing: usize, cells: usize) -> usize {
    cells.div_ceil(8) + crossing
}

/// Says which cells cross, and how sure their maker is of each: a bit for each cell of the map, the first in the lowest bit,
/// then for each that crosses the root of its confidence in 255ths, 1 at least.
pub(crate) fn write(ascending: &[u32], confidence: &[f32], into: &mut Vec<u8>) {
    into.clear();
    into.resize(confidence.len().div_ceil(8), 0);
    for cell in ascending {
        into[*cell as usize / 8] |= 1 << (cell % 8);
    }
    let code = |cell: &u32| {
        (confidence[*cell as usize].sqrt() * GREATEST)
            .round()
            .clamp(1.0, GREATEST)
    };
    into.extend(ascending.iter().map(|cell| code(cell) as u8));
}

/// The cells of a map that crossed.
#[derive(Debug)]
pub(crate) struct Chosen {
    /// Their numbers.
    pub ascending: Vec<u32>,
    /// How sure the map's maker is of each cell of the map; 0 of those that did not cross.
    pub confidence: Vec<f32>,
}

impl Chosen {
    /// All cells, as bytes, from the bytes of those that crossed; there are some.
    pub fn scattered(&self, bytes: &[u8]) -> Buffer {
        let size = bytes.len() / self.ascending.len();
        let mut all = MutableBuffer::from_len_zeroed(self.confidence.len() * size);
        for (cell, bytes) in self.ascending.iter().zip(bytes.chunks_exact(size)) {
            all[*cell as usize * size..][..size].copy_from_slice(bytes);
        }
        all.into()
    }
}

/// Which cells of a map of so many crossed, from what [`write`] says of `crossing` of them.
///
/// # Errors
/// [`DecodeError::Value`] where the bits are not as many, or a code is none.
pub(crate) fn read(bytes: &[u8], crossing: usize, cells: usize) -> Result<Chosen, DecodeError> {
    let (bits, codes) = bytes.split_at(cells.div_ceil(8));
    let set = bits.iter().map(|byte| byte.count_ones() as usize).sum::<usize>();
    let beyond = bits
        .last()
        .is_some_and(|last| !cells.is_multiple_of(8) && last >> (cells % 8) != 0);
    if set != crossing || beyond {
        return Err(DecodeError::Value {
            field: "cells that cross",
            expected: "as many as the packet says, within the map",
            found: format!("{set} for {crossing} of {cells}"),
        });
    }
    if codes.contains(&0) {
        return Err(DecodeError::Value {
            field: "confidence of a cell",
            expected: "1 to 255",
            found: "0".into(),
        });
    }
    let is_set = |cell: &u32| bits[*cell as usize / 8] >> (cell % 8) & 1 == 1;
    let ascending: Vec<u32> = (0..cells as u32).filter(is_set).collect();
    let mut confidence = vec![0.0; cells];
    for (cell, code) in ascending.iter().zip(codes) {
        confidence[*cell as usize] = (f32::from(*code) / GREATEST).powi(2);
    }
    Ok(Chosen { ascending, confidence })
}

#[cfg(test)]
mod tests {
    use realo_schemas::DType;

    use super::*;

    fn map(confidence: &[f32]) -> FeatureMap {
        FeatureMap {
            rows: 2,
            columns: confidence.len() as u32 / 2,
            channels: 2,
            cell: 0.8,
            origin: [0.0; 2],
            dtype: DType::U8,
            data: (0..2 * confidence.len() as u8).collect::<Vec<u8>>().into(),
            model: "m".into(),
            confidence: Some(confidence.to_vec().into()),
        }
    }

    #[test]
    fn cells_under_sure_boxes_count_less() {
        let object = |x: f64, score: f32| Box3 {
            center: [x, 0.8, 0.0],
            length: 1.6,
            width: 1.6,
            height: 1.0,
            yaw: 0.0,
            velocity: None,
            class: "vehicle".into(),
            score,
            track: None,
            covariance: None,
        };
        // A sure box over columns 0 and 1, an unsure one over 2 and 3, nothing over 4; one far away.
        let boxes = [object(0.8, 1.0), object(2.4, 0.5), object(-50.0, 1.0)];
        let of = [0.9, 0.9, 0.6, 0.5, 0.4, 0.9, 0.9, 0.6, 0.5, 0.05];
        let order = |covered: f32| {
            let covering = Covering { boxes: &boxes, covered };
            ranked(&map(&of), 0.0, Some(covering)).unwrap()
        };
        assert_eq!(order(1.0), ranked(&map(&of), 0.0, None).unwrap());
        // By what counts: 0.4; 0.3; 0.25; 0.05; 0.
        assert_eq!(order(0.0), [4, 2, 7, 3, 8, 9, 0, 1, 5, 6]);
        let held_back = ranked(
            &map(&of),
            0.5,
            Some(Covering {
                boxes: &boxes,
                covered: 0.0,
            }),
        );
        assert_eq!(held_back.unwrap().len(), 8, "the min is of the confidence itself");
    }

    #[test]
    fn the_surest_come_first_and_what_is_not_sure_does_not_come() {
        let of = [0.1, 0.9, f32::NAN, 0.5, 0.0, 0.5, 0.2, -1.0, 0.04, 1.0];
        assert_eq!(ranked(&map(&of), 0.1, None).unwrap(), [9, 1, 3, 5, 6, 0]);
        assert_eq!(ranked(&map(&of), 0.0, None).unwrap().len(), 7, "0 is no cell");
        let chosen = gathered(&map(&of), &[3, 9]);
        assert_eq!(
            (chosen.size(), chosen.data.as_slice()),
            ([1, 2, 2], &[6, 7, 18, 19][..])
        );
        let unknown = FeatureMap {
            confidence: None,
            ..map(&of)
        };
        assert!(
            ranked(&unknown, 0.1, None)
                .unwrap_err()
                .to_string()
                .contains("confidence=true")
        );
        let short = FeatureMap { columns: 6, ..map(&of) };
        let error = ranked(&short, 0.1, None).unwrap_err().to_string();
        assert!(error.contains("40 bytes of data, its dimensions say 48"), "{error}");
    }

    #[test]
    fn what_crosses_comes_back_with_how_sure_it_was() {
        let sure: Vec<f32> = (0..19).map(|cell| 1e-9 + (cell as f32 / 18.0).powi(4)).collect();
        let mut bytes = Vec::new();
        let crossing = [0, 3, 7, 8, 17, 18];
        write(&crossing, &sure, &mut bytes);
        assert_eq!(bytes.len(), length(6, 19));
        let Chosen {
            ascending,
            confidence: found,
        } = read(&bytes, 6, 19).unwrap();
        assert_eq!(ascending, crossing);
        for (cell, (found, sure)) in found.iter().zip(&sure).enumerate() {
            match crossing.contains(&(cell as u32)) {
                true => assert!(
                    *found > 0.0 && (found - sure).abs() < 1.0 / 255.0,
                    "{cell}: {found} for {sure}"
                ),
                false => assert_eq!(*found, 0.0),
            }
        }
        let changed = |at: usize, value: u8| {
            let mut bytes = bytes.clone();
            bytes[at] = value;
            read(&bytes, 6, 19).unwrap_err().to_string()
        };
        assert!(changed(0, 0).contains("3 for 6 of 19"));
        assert!(changed(2, 0b1010).contains("6 for 6 of 19"), "a bit beyond the map");
        assert!(changed(4, 0).contains("`confidence of a cell`: expected 1 to 255"));
    }
}

//! BEV maps as messages: what a network makes, written; what another stage of the same model sent, read. And what computes
//! the network: the [`Engine`].

mod computing;
pub mod counters;
mod decoder;
mod engine;
mod known;

use std::borrow::Cow;

use arrow_buffer::Buffer;
use realo_kernels::bev::{BevMap, BevView};
use realo_methods::Loaded;
use realo_operator::Error;
use realo_schemas::{DType, FeatureMap, Name, feature_map};

pub use computing::Computing;
pub use decoder::{Decoded, Decoder};
pub use engine::{Device, Engine, EngineError};
pub use known::known_map;

/// A map that does not fit the model that is to read it.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// Another model made it.
    #[error("expected a map of model {expected}, found one of {found}: name one model file in both")]
    Model {
        /// The model that reads.
        expected: Name,
        /// The one that wrote.
        found: Name,
    },
    /// Its cells lie elsewhere.
    #[error("expected cells of {} m from {:?} on, found {} m from {:?} on", .expected.0, .expected.1, .found.0, .found.1)]
    Place {
        /// Side of a cell and corner of the first, m.
        expected: (f64, [f64; 2]),
        /// Those of the map.
        found: (f64, [f64; 2]),
    },
    /// Its confidence is of other cells.
    #[error("expected a confidence for each cell of {size:?}, found {found}")]
    Confidence {
        /// Rows, columns and channels.
        size: [usize; 3],
        /// Numbers of confidence.
        found: usize,
    },
    /// Its numbers cannot be read.
    #[error(transparent)]
    Numbers(Error),
}

/// Where the maps of one model lie, and whose they are.
#[derive(Clone, Debug, PartialEq)]
pub struct Maps {
    /// Name and digest of the model.
    pub identity: Name,
    /// Corner of the first cell in the model's frame, m.
    pub origin: [f64; 2],
    /// Side of a cell, m.
    pub cell: f64,
}

/// A map that was read from a message.
#[derive(Debug)]
pub struct Read<'a> {
    size: [usize; 3],
    numbers: Cow<'a, [f32]>,
    confidence: Option<&'a [f32]>,
}

impl Maps {
    /// Those of a model.
    pub fn of(loaded: &Loaded) -> Self {
        let grid = &loaded.model.grid;
        Maps {
            identity: loaded.identity.as_str().into(),
            origin: [grid.x[0], grid.y[0]],
            cell: grid.cell * loaded.model.stride() as f64,
        }
    }

    /// A map as a message of f32.
    pub fn write(&self, map: BevMap) -> FeatureMap {
        FeatureMap {
            rows: map.rows as u32,
            columns: map.columns as u32,
            channels: map.channels as u32,
            cell: self.cell,
            origin: self.origin,
            dtype: DType::F32,
            data: Buffer::from_vec(map.data),
            model: self.identity.clone(),
            confidence: None,
        }
    }

    /// The numbers of a map of this model: those of the message, or a copy where they do not lie as numbers do.
    ///
    /// # Errors
    /// A map of another model, elsewhere, or of other elements than f32.
    pub fn read<'a>(&self, map: &'a FeatureMap) -> Result<Read<'a>, MapError> {
        if map.model != self.identity {
            let (expected, found) = (self.identity.clone(), map.model.clone());
            return Err(MapError::Model { expected, found });
        }
        let [expected, found] = [(self.cell, self.origin), (map.cell, map.origin)];
        if found != expected {
            return Err(MapError::Place { expected, found });
        }
        let (size, numbers, confidence) = (
            map.size(),
            map.numbers().map_err(|error| MapError::Numbers(error.into()))?,
            map.confidence.as_deref(),
        );
        if let Some(confidence) = confidence
            && confidence.len() != size[0] * size[1]
        {
            let found = confidence.len();
            return Err(MapError::Confidence { size, found });
        }
        Ok(Read {
            size,
            numbers,
            confidence,
        })
    }
}

impl Read<'_> {
    /// The map for a network, which checks its size.
    pub fn view(&self) -> BevView<'_> {
        let [rows, columns, channels] = self.size;
        BevView {
            rows,
            columns,
            channels,
            data: &self.numbers,
        }
    }

    /// How sure its maker is of each cell, see [`FeatureMap::confidence`].
    pub fn confidence(&self) -> Option<&[f32]> {
        self.confidence
    }

    /// Rows, columns and channels.
    pub fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Whether all numbers are as a network makes them, see [`feature_map::are_sound`].
    pub fn is_sound(&self) -> bool {
        feature_map::are_sound(&self.numbers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn maps() -> Maps {
        Maps {
            identity: "lite-1".into(),
            origin: [-4.0, -2.0],
            cell: 0.8,
        }
    }

    fn map(data: Vec<f32>) -> BevMap {
        BevMap {
            rows: 2,
            columns: 1,
            channels: 3,
            data,
        }
    }

    #[test]
    fn a_map_is_read_as_it_was_written_where_it_lies_and_copied_only_if_it_lies_askew() {
        let numbers: Vec<f32> = (0..6).map(|k| k as f32 - 2.5).collect();
        let written = maps().write(map(numbers.clone()));
        let read = maps().read(&written).unwrap();
        assert!(matches!(read.numbers, Cow::Borrowed(_)));
        let view = read.view();
        assert_eq!(
            (view.rows, view.columns, view.channels, view.data),
            (2, 1, 3, &numbers[..])
        );
        let mut bytes = vec![0; 1];
        bytes.extend_from_slice(&written.data);
        let askew = FeatureMap {
            data: Buffer::from_vec(bytes).slice(1),
            ..written
        };
        let read = maps().read(&askew).unwrap();
        assert!(matches!(read.numbers, Cow::Owned(_)));
        assert_eq!(read.view().data, numbers);
    }

    #[test]
    fn maps_that_do_not_fit_are_refused_with_what_is_expected() {
        let written = maps().write(map(vec![0.0; 6]));
        let refused = |change: fn(&mut FeatureMap)| {
            let mut map = written.clone();
            change(&mut map);
            maps().read(&map).map(|_| ()).unwrap_err().to_string()
        };
        let other = refused(|map| map.model = "other-0".into());
        assert!(other.contains("lite-1") && other.contains("other-0"), "{other}");
        assert!(refused(|map| map.dtype = DType::F16).contains("expected a map of f32, found F16"));
        assert!(refused(|map| map.cell = 0.4).contains("expected cells of 0.8 m from [-4.0, -2.0] on, found 0.4 m"));
        assert!(refused(|map| map.rows = 3).contains("expected 4 bytes for each number of [3, 1, 3], found 24"));
        assert!(refused(|map| (map.rows, map.columns) = (u32::MAX, u32::MAX)).contains("found 24"));
        assert!(refused(|map| map.origin = [0.0, -2.0]).contains("found 0.8 m from [0.0, -2.0] on"));
        let unsure = refused(|map| map.confidence = Some(vec![0.5; 3].into()));
        assert!(
            unsure.contains("a confidence for each cell of [2, 1, 3], found 3"),
            "{unsure}"
        );
    }

    #[test]
    fn numbers_that_no_network_makes_are_seen() {
        let sound = |number: f32| {
            let written = maps().write(map(vec![0.0, 1.0, number, 0.0, -3.0, 5.0]));
            maps().read(&written).unwrap().is_sound()
        };
        assert!(sound(7.0) && sound(-1e15));
        for number in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 2e15, -2e15] {
            assert!(!sound(number), "{number}");
        }
    }
}

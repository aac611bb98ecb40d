//! Collaborators' BEV maps, looked at from the cells of the ego's.
//!
//! This samples as `realo-kernels` does, one cell at a time and in plain Rust: plug-ins that fuse link this crate, and shall not build
//! the kernels for it.

use std::borrow::Cow;

use nalgebra::Isometry3;
use realo_operator::Error;
use realo_schemas::{FeatureMap, feature_map};

use crate::{Collaborator, Set};

/// The maps of a set, all of one model, size and place, in the frames of those who made them.
#[derive(Debug)]
pub struct Maps<'a> {
    /// Rows, columns and channels of each.
    pub size: [usize; 3],
    /// The ego's features, `[rows, columns, channels]`.
    pub ego: Cow<'a, [f32]>,
    /// The collaborators', in the order of the set.
    pub others: Vec<PlacedMap<'a>>,
}

/// A collaborator's map, and where it lies in the ego's.
#[derive(Debug)]
pub struct PlacedMap<'a> {
    size: [usize; 3],
    features: Cow<'a, [f32]>,
    /// See [`FeatureMap::confidence`].
    confidence: Option<&'a [f32]>,
    /// From (column, row, 1) of the ego's cells to the map's own.
    own_from_ego: [[f64; 3]; 2],
}

impl Set<FeatureMap> {
    /// The maps of the set. Collaborators whose map is of another model, size or place than the ego's, or has numbers that no
    /// network makes, are left out as rejected.
    ///
    /// # Errors
    /// A map of the ego that is not of f32 or shorter than it says.
    pub fn maps(&mut self) -> Result<Maps<'_>, Error> {
        let kind = |map: &FeatureMap| (map.size(), map.cell, map.origin, map.model.clone());
        let expected = kind(&self.ego);
        let fits = |map: &FeatureMap| {
            let cells = expected.0[0] * expected.0[1];
            let reports_all = map
                .confidence
                .as_ref()
                .is_none_or(|confidence| confidence.len() == cells);
            let sound = |map: &FeatureMap| map.numbers().is_ok_and(|numbers| feature_map::are_sound(&numbers));
            kind(map) == expected && reports_all && sound(map)
        };
        self.reject(|collaborator| !fits(&collaborator.payload));
        let others = self.collaborators.iter().map(PlacedMap::of);
        Ok(Maps {
            size: self.ego.size(),
            ego: self.ego.numbers()?,
            others: others.collect::<Result<_, Error>>()?,
        })
    }
}

impl<'a> PlacedMap<'a> {
    fn of(collaborator: &'a Collaborator<FeatureMap>) -> Result<Self, Error> {
        let map = &collaborator.payload;
        Ok(PlacedMap {
            size: map.size(),
            features: map.numbers()?,
            confidence: map.confidence.as_deref(),
            own_from_ego: cells(&collaborator.ego_from_sender.inverse(), map.origin, map.cell),
        })
    }

    /// The features at a cell of the ego's map, one for each channel: bilinear between the four cells around it, zeros
    /// outside the map; of a map that has not all of its cells, between those that are there. Whether the map covers the cell:
    /// the nearest of its own is there. Where it does not, its maker says nothing of it.
    ///
    /// Maps are moved as the ground, z = 0, moves; what moved on it between the two stamps is not brought back.
    ///
    /// # Panics
    /// If `to` has not as many numbers as the map has channels.
    pub fn features_at(&self, row: usize, column: usize, to: &mut [f32]) -> bool {
        let [rows, columns, channels] = self.size;
        assert_eq!(to.len(), channels, "a number for each channel");
        to.fill(0.0);
        let [x, y] = self
            .own_from_ego
            .map(|[along_columns, along_rows, shift]| along_columns * column as f64 + along_rows * row as f64 + shift);
        let cell_at = |x: f64, y: f64| Some(within(y, rows)? * columns + within(x, columns)?);
        let is_there = |cell: &usize| self.confidence.is_none_or(|confidence| confidence[*cell] > 0.0);
        let covered = cell_at(x.round_ties_even(), y.round_ties_even()).is_some_and(|cell| is_there(&cell));
        if self.confidence.is_some() && !covered {
            return false;
        }
        let (left, low, mut sum) = (x.floor(), y.floor(), 0.0);
        for (cell_y, weight_y) in [(low, 1.0 - (y - low)), (low + 1.0, y - low)] {
            for (cell_x, weight_x) in [(left, 1.0 - (x - left)), (left + 1.0, x - left)] {
                let Some(cell) = cell_at(cell_x, cell_y).filter(is_there) else {
                    continue;
                };
                let weight = (weight_x * weight_y) as f32;
                sum += weight;
                let cell = &self.features[cell * channels..][..channels];
                to.iter_mut()
                    .zip(cell)
                    .for_each(|(to, feature)| *to += weight * feature);
            }
        }
        if self.confidence.is_some() {
            to.iter_mut().for_each(|to| *to *= 1.0 / sum);
        }
        covered
    }
}

/// A whole number as an index below `length`, if it is one.
fn within(place: f64, length: usize) -> Option<usize> {
    (place >= 0.0 && place < length as f64).then_some(place as usize)
}

/// Where the cells of a map lie in another map of the same grid, from how the ground moves between their frames, m.
fn cells(sender_from_ego: &Isometry3<f64>, origin: [f64; 2], cell: f64) -> [[f64; 3]; 2] {
    let matrix = sender_from_ego.to_homogeneous();
    let center = origin.map(|corner| corner + 0.5 * cell);
    [0, 1].map(|axis| {
        let [along_x, along_y] = [matrix[(axis, 0)], matrix[(axis, 1)]];
        let first = along_x * center[0] + along_y * center[1] + matrix[(axis, 3)];
        [along_x, along_y, (first - center[axis]) / cell]
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::{Translation3, UnitQuaternion};
    use realo_operator::Outputs;
    use realo_schemas::report::Fate;
    use realo_schemas::{DType, Header, Kind};

    use super::*;

    /// What a fusion sends.
    #[derive(Outputs)]
    enum Output {
        /// What was fused.
        Fused(Header, FeatureMap),
    }

    const SIZE: [u32; 3] = [5, 7, 2];

    fn map(of: impl Fn(usize) -> f32) -> FeatureMap {
        let [rows, columns, channels] = SIZE;
        let empty = FeatureMap {
            rows,
            columns,
            channels,
            cell: 0.8,
            origin: [-2.0, -1.6],
            dtype: DType::F32,
            data: Vec::<u8>::new().into(),
            model: "lite-1".into(),
            confidence: None,
        };
        empty.with_numbers((0..(rows * columns * channels) as usize).map(of).collect())
    }

    fn collaborator(agent: &str, payload: FeatureMap, ego_from_sender: Isometry3<f64>) -> Collaborator<FeatureMap> {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Features, 0, 0, 0);
        header.to = Some("cav1".into());
        Collaborator {
            header,
            payload,
            ego_from_sender,
        }
    }

    fn set(collaborators: Vec<Collaborator<FeatureMap>>) -> Set<FeatureMap> {
        Set {
            header: Header::origin(&"run".into(), &"cav1".into(), Kind::Features, 0, 0, 0),
            ego: map(|_| 1.0),
            collaborators,
            left_out: vec![],
        }
    }

    fn shift(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, yaw);
        Isometry3::from_parts(Translation3::new(x, y, 0.3), turn)
    }

    #[test]
    fn features_are_found_where_the_ground_has_moved() {
        let features = |at: usize| at as f32;
        // Two cells ahead of the ego and one to its right: its cell (1, 0) is the ego's cell (0, 2).
        let mut set = set(vec![collaborator("rsu1", map(features), shift(1.6, -0.8, 0.0))]);
        let maps = set.maps().unwrap();
        let mut found = [0.0; 2];
        assert!(maps.others[0].features_at(0, 2, &mut found));
        let expected = [7.0 * 2.0, 7.0 * 2.0 + 1.0];
        assert!(
            found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4),
            "{found:?}"
        );
        assert!(!maps.others[0].features_at(0, 1, &mut found), "it does not reach there");
        assert!(
            !maps.others[0].features_at(4, 2, &mut found) && found[0].abs() < 1e-4,
            "{found:?}"
        );
        assert_eq!((maps.size, maps.ego.len()), ([5, 7, 2], 70));
    }

    #[test]
    fn maps_that_do_not_fit_the_egos_are_left_out() {
        let good = map(|_| 2.0);
        let cases = [
            (
                "a",
                FeatureMap {
                    model: "lite-2".into(),
                    ..good.clone()
                },
            ),
            (
                "b",
                FeatureMap {
                    cell: 0.4,
                    ..good.clone()
                },
            ),
            (
                "c",
                FeatureMap {
                    origin: [0.0, 0.0],
                    ..good.clone()
                },
            ),
            (
                "d",
                FeatureMap {
                    rows: 4,
                    ..good.clone()
                },
            ),
            (
                "e",
                FeatureMap {
                    dtype: DType::F16,
                    ..good.clone()
                },
            ),
            ("f", map(|at| if at == 3 { f32::NAN } else { 0.0 })),
            ("g", map(|_| 1e30)),
            ("h", good),
        ];
        let collaborators = cases.map(|(agent, map)| collaborator(agent, map, Isometry3::identity()));
        let mut set = set(collaborators.into());
        assert_eq!(set.maps().unwrap().others.len(), 1);
        let mut out = Outputs::at(0);
        let fused = set.ego.clone();
        set.send(Output::Fused, fused, &mut out);
        let fates = out.take_fates();
        assert_eq!(fates.iter().filter(|fated| fated.fate == Fate::Rejected).count(), 7);
        assert_eq!((&*fates[0].message.from, fates[0].fate), ("h", Fate::Used));

        let mut short = self::set(vec![]);
        short.ego.rows = 6;
        let error = short.maps().unwrap_err().to_string();
        assert!(
            error.contains("4 bytes for each number of [6, 7, 2], found 280"),
            "{error}"
        );
    }
}

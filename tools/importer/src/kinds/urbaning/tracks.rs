//! Labels of a sequence: a track for each object, with its places over time.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use realo_logs::track_of;
use realo_schemas::Nanos;
use realo_schemas::geometry::normalize_yaw;
use serde::Deserialize;
use serde_json::Value;

use crate::ImportError;
use crate::files::read_json;
use crate::options::BoxPlace;
use crate::scenes::{Label, SharedLabels};

/// Between two places so far apart an object is interpolated, ns.
const BRIDGED: Nanos = 250_000_000;
/// An object is at the nearest of its places within this, ns.
const NEAR: Nanos = 50_000_000;

#[derive(Deserialize)]
struct File {
    tracks: Vec<FileTrack>,
}

#[derive(Deserialize)]
struct FileTrack {
    track_id: Value,
    object_type: String,
    timestamps: Vec<f64>,
    positions: Vec<[f64; 3]>,
    orientations: Vec<f64>,
    dimensions: Dimensions,
}

/// Length, width, height: of all times, or of each.
#[derive(Deserialize)]
#[serde(untagged)]
enum Dimensions {
    All([f64; 3]),
    Each(Vec<[f64; 3]>),
}

/// An object over time.
struct Track {
    id: String,
    class: String,
    /// Time, place, yaw and size, in the order of time.
    places: Vec<(Nanos, [f64; 3], f64, [f64; 3])>,
}

/// All objects of a sequence.
struct Tracks(Vec<Track>);

/// The file of a sequence's labels; it is read when the first sweep needs it.
pub struct TracksFile {
    path: PathBuf,
    tracks: OnceLock<Tracks>,
}

/// No heading is larger, rad: headings of a track may go on over a turn.
const MOST_TURN: f64 = 2.0 * std::f64::consts::TAU;

impl TracksFile {
    /// Of a path at which the file need not be.
    pub fn new(path: &Path) -> Self {
        TracksFile {
            path: path.into(),
            tracks: OnceLock::new(),
        }
    }
}

impl SharedLabels for TracksFile {
    fn at(&self, at: Nanos, place: BoxPlace) -> Result<(Vec<Label>, usize), ImportError> {
        let tracks = match self.tracks.get() {
            Some(tracks) => tracks,
            None => {
                let tracks = Tracks::read(&self.path)?;
                self.tracks.get_or_init(|| tracks)
            }
        };
        Ok(tracks.at(at, place))
    }
}

impl Tracks {
    /// Reads a file.
    ///
    /// # Errors
    /// A file of another form; columns of a track that differ in length.
    fn read(path: &Path) -> Result<Self, ImportError> {
        let file: File = read_json(path)?;
        let tracks = file.tracks.into_iter().map(track);
        tracks
            .collect::<Result<_, _>>()
            .map(Tracks)
            .map_err(|reason| ImportError::content(path, reason))
    }

    /// The objects at a time, and how many have no size.
    fn at(&self, at: Nanos, place: BoxPlace) -> (Vec<Label>, usize) {
        let there: Vec<Label> = self.0.iter().filter_map(|track| track.at(at, place)).collect();
        let all = there.len();
        let labels: Vec<Label> = there.into_iter().filter(|label| !label.size.contains(&0.0)).collect();
        let dropped = all - labels.len();
        (labels, dropped)
    }
}

fn track(file: FileTrack) -> Result<Track, String> {
    let id = match &file.track_id {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let count = file.timestamps.len();
    let sizes = match file.dimensions {
        Dimensions::All(size) => vec![size; count],
        Dimensions::Each(sizes) => sizes,
    };
    let lengths = [file.positions.len(), file.orientations.len(), sizes.len()];
    if lengths.iter().any(|length| *length != count) {
        return Err(format!(
            "track `{}`: expected a position, an orientation and dimensions for each of {count} timestamps, found {lengths:?}",
            crate::shown(&id)
        ));
    }
    let mut places = Vec::with_capacity(count);
    for (((time, center), yaw), size) in file
        .timestamps
        .iter()
        .zip(file.positions)
        .zip(file.orientations)
        .zip(sizes)
    {
        if !((0.0..4e9).contains(time) && yaw.is_finite()) {
            return Err(format!(
                "track `{}`: expected times in s since 1970 and finite orientations, found {time} and {yaw}",
                crate::shown(&id)
            ));
        }
        if yaw.abs() > MOST_TURN {
            return Err(format!(
                "track `{}`: expected orientations in rad within ±4π, found {yaw}; degrees must be turned to radians",
                crate::shown(&id)
            ));
        }
        // Seconds and their rest apart: a double holds a time since 1970 to 0.2 µs.
        let nanos = time.trunc() as Nanos * 1_000_000_000 + (time.fract() * 1e9).round() as Nanos;
        places.push((nanos, center, yaw, size));
    }
    places.sort_by_key(|(time, ..)| *time);
    Ok(Track {
        id,
        class: file.object_type,
        places,
    })
}

impl Track {
    fn at(&self, at: Nanos, place: BoxPlace) -> Option<Label> {
        let next = self.places.partition_point(|(time, ..)| *time < at);
        let (before, after) = (self.places[..next].last(), self.places.get(next));
        let (center, yaw, size) = match (before, after) {
            (Some((t0, a, yaw_a, size)), Some((t1, b, yaw_b, _))) if t1 - t0 <= BRIDGED => {
                let share = (at - t0) as f64 / (t1 - t0) as f64;
                let center = [0, 1, 2].map(|axis| a[axis] + share * (b[axis] - a[axis]));
                (center, yaw_a + share * normalize_yaw(yaw_b - yaw_a), *size)
            }
            _ => {
                let nearest = [before, after]
                    .into_iter()
                    .flatten()
                    .min_by_key(|(time, ..)| (time - at).abs());
                let (_, center, yaw, size) = nearest.filter(|(time, ..)| (time - at).abs() <= NEAR)?;
                (*center, *yaw, *size)
            }
        };
        let [x, y, z] = center;
        let lift = if place == BoxPlace::Bottom { size[2] / 2.0 } else { 0.0 };
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        Some(Label {
            id: self.id.clone(),
            track: track_of(&self.id),
            class: self.class.clone(),
            map_from_object: Isometry3::from_parts(Translation3::new(x, y, z + lift), turn),
            size,
            speed: None,
            points: None,
        })
    }
}

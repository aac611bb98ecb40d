//! One instant as training keeps it: every agent's sweep and what is really there.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use crate::TrainError;

/// Coordinates are kept in units of 1/256 m: 4 mm steps, up to 128 m from the sensor.
const UNIT: f32 = 1.0 / 256.0;

/// Frames hold points up to so far along x, y and z, m.
pub(crate) const REACH: f64 = 128.0;

const MAGIC: &[u8; 8] = b"realofr2";

/// Bytes of a return in a file.
const RETURN: usize = 8;

/// The agents' sweeps of one instant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Names of the super-classes that objects have.
    pub classes: Vec<String>,
    /// The agents.
    pub agents: Vec<AgentSweep>,
    /// The same agents some sweeps before, where that is kept.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub earlier: Option<Earlier>,
}

/// The agents of a frame as they were before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Earlier {
    /// How many sweeps before.
    pub delay: usize,
    /// The agents in the frame's order.
    pub agents: Vec<AgentSweep>,
}

/// What one agent measured and what was there.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AgentSweep {
    /// Name.
    pub name: String,
    /// Whether it stands beside the road.
    pub roadside: bool,
    /// Its true pose at its stamp.
    #[serde(with = "pose")]
    pub map_from_body: Isometry3<f64>,
    /// What came back, without its own body.
    #[serde(skip)]
    pub points: Vec<Return>,
    #[serde(rename = "points")]
    count: usize,
    /// The objects around it, in its body frame at its stamp.
    pub objects: Vec<Seen>,
}

/// A point of a sweep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Return {
    /// x, y, z in the body frame at the sweep's stamp, in units of 1/256 m.
    pub at: [i16; 3],
    /// Number of its beam; 0 for all where beams are not known.
    pub ring: u16,
}

impl Return {
    /// x, y, z, m.
    pub fn metres(self) -> [f32; 3] {
        self.at.map(|value| f32::from(value) * UNIT)
    }

    fn to_bytes(self) -> [u8; RETURN] {
        let [[a, b], [c, d], [e, f]] = self.at.map(i16::to_le_bytes);
        let [g, h] = self.ring.to_le_bytes();
        [a, b, c, d, e, f, g, h]
    }

    fn from_bytes([a, b, c, d, e, f, g, h]: [u8; RETURN]) -> Self {
        Return {
            at: [[a, b], [c, d], [e, f]].map(i16::from_le_bytes),
            ring: u16::from_le_bytes([g, h]),
        }
    }
}

/// An object as one agent sees it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Seen {
    /// The object, the same for all agents.
    pub track: u64,
    /// Index in [`Frame::classes`].
    pub class: usize,
    /// x, y, z of the centre, length, width, height (m), yaw (rad).
    pub lwh: [f64; 7],
    /// The agent's own points on it.
    pub points: u32,
}

impl AgentSweep {
    /// A sweep from points (m) and the numbers of their beams; what lies outside of ±128 m is left out.
    pub fn new(
        name: &str,
        roadside: bool,
        map_from_body: Isometry3<f64>,
        points: impl Iterator<Item = ([f32; 3], u16)>,
        objects: Vec<Seen>,
    ) -> Self {
        let limit = f32::from(i16::MAX);
        let points: Vec<Return> = points
            .map(|(point, ring)| (point.map(|value| (value / UNIT).round()), ring))
            .filter(|(point, _)| point.iter().all(|value| value.abs() <= limit))
            .map(|(point, ring)| Return {
                at: point.map(|value| value as i16),
                ring,
            })
            .collect();
        AgentSweep {
            name: name.into(),
            roadside,
            map_from_body,
            count: points.len(),
            points,
            objects,
        }
    }

    /// The agent as if it had not measured anything.
    pub(crate) fn unseeing(&self) -> Self {
        let objects = self.objects.iter().map(|object| Seen { points: 0, ..*object });
        let nothing = std::iter::empty();
        AgentSweep::new(
            &self.name,
            self.roadside,
            self.map_from_body,
            nothing,
            objects.collect(),
        )
    }

    /// x, y, z of all points, m.
    pub fn metres(&self) -> impl Iterator<Item = [f32; 3]> + '_ {
        self.points.iter().map(|point| point.metres())
    }
}

impl Frame {
    /// All sweeps: the agents', then those before.
    fn sweeps(&self) -> impl Iterator<Item = &AgentSweep> {
        let earlier = self.earlier.iter().flat_map(|earlier| &earlier.agents);
        self.agents.iter().chain(earlier)
    }

    /// Writes the frame; a reader never finds a part of it.
    ///
    /// # Errors
    /// [`TrainError::Write`], for instance on a full disk.
    pub fn write(&self, path: &Path) -> Result<(), TrainError> {
        let header = serde_json::to_vec(self).expect("frames are plain data");
        let points = self.sweeps().map(|agent| agent.points.len()).sum::<usize>();
        let mut bytes = Vec::with_capacity(16 + header.len() + RETURN * points);
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&(header.len() as u64).to_le_bytes());
        bytes.extend_from_slice(&header);
        for agent in self.sweeps() {
            bytes.extend(agent.points.iter().flat_map(|point| point.to_bytes()));
        }
        // Several trainings may fill one folder; each has parts of its own.
        static PARTS: AtomicU64 = AtomicU64::new(0);
        let number = PARTS.fetch_add(1, Ordering::Relaxed);
        write_by_way_of(
            &path.with_extension(format!("{}-{number}.part", std::process::id())),
            path,
            &bytes,
        )
    }

    /// Reads a frame.
    ///
    /// # Errors
    /// [`TrainError::Read`]; [`TrainError::Cache`] for bytes that are no frame.
    pub fn read(path: &Path) -> Result<Self, TrainError> {
        let bytes = fs::read(path).map_err(|error| TrainError::Read {
            path: path.into(),
            error,
        })?;
        Frame::parse(&bytes).map_err(|reason| TrainError::Cache {
            path: path.into(),
            reason,
        })
    }

    fn parse(bytes: &[u8]) -> Result<Self, String> {
        let rest = bytes.strip_prefix(MAGIC).ok_or("it is not a frame of training data")?;
        let (length, rest) = rest.split_first_chunk::<8>().ok_or("it ends in its header")?;
        let length = usize::try_from(u64::from_le_bytes(*length)).map_err(|error| error.to_string())?;
        let (header, rest) = rest.split_at_checked(length).ok_or("it ends in its header")?;
        let mut frame: Frame = serde_json::from_slice(header).map_err(|error| error.to_string())?;
        let mut returns = rest.as_chunks().0.iter().map(|bytes| Return::from_bytes(*bytes));
        let expected = frame
            .sweeps()
            .try_fold(0usize, |sum, agent| sum.checked_add(agent.count));
        if expected.and_then(|points| points.checked_mul(RETURN)) != Some(rest.len()) {
            let expected = expected.unwrap_or(usize::MAX);
            return Err(format!(
                "expected {expected} points of {RETURN} bytes, found {} bytes",
                rest.len()
            ));
        }
        let classes = frame
            .sweeps()
            .flat_map(|agent| &agent.objects)
            .map(|object| object.class);
        let max = classes.max();
        if let Some(class) = max.filter(|class| *class >= frame.classes.len()) {
            return Err(format!("an object of class {class} of {}", frame.classes.len()));
        }
        if frame.agents.is_empty() {
            return Err("it has no agents".into());
        }
        let earlier = frame
            .earlier
            .as_ref()
            .map_or(frame.agents.len(), |earlier| earlier.agents.len());
        if earlier != frame.agents.len() {
            return Err(format!("{} agents were {earlier} before", frame.agents.len()));
        }
        let earlier = frame.earlier.iter_mut().flat_map(|earlier| &mut earlier.agents);
        for agent in frame.agents.iter_mut().chain(earlier) {
            agent.points = returns.by_ref().take(agent.count).collect();
        }
        Ok(frame)
    }
}

/// A pose as x, y, z (m) and the quaternion's i, j, k, w.
mod pose {
    use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(pose: &Isometry3<f64>, to: S) -> Result<S::Ok, S::Error> {
        let (t, q) = (pose.translation.vector, pose.rotation.coords);
        [t.x, t.y, t.z, q.x, q.y, q.z, q.w].serialize(to)
    }

    pub fn deserialize<'a, D: Deserializer<'a>>(from: D) -> Result<Isometry3<f64>, D::Error> {
        let [x, y, z, i, j, k, w] = <[f64; 7]>::deserialize(from)?;
        let rotation = UnitQuaternion::new_normalize(Quaternion::new(w, i, j, k));
        Ok(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
    }
}

/// Writes a file beside its place and then puts it there, so that a kill or a full disk leaves the old one.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), TrainError> {
    write_by_way_of(&path.with_extension("part"), path, bytes)
}

fn write_by_way_of(part: &Path, path: &Path, bytes: &[u8]) -> Result<(), TrainError> {
    let failed = |error| TrainError::Write {
        path: path.into(),
        error,
    };
    let write = || {
        let mut file = fs::File::create(part)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(part, path)
    };
    write().map_err(|error| {
        // What could not be finished is of no use; that it cannot be removed either changes nothing.
        let _ = fs::remove_file(part);
        failed(error)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> Frame {
        let object = Seen {
            track: 7,
            class: 1,
            lwh: [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.1],
            points: 9,
        };
        let points = [
            [1.0, -2.5, 0.25],
            [127.9, 0.0, 0.0],
            [128.1, 0.0, 0.0],
            [f32::NAN, 0.0, 0.0],
        ];
        let agent = AgentSweep::new(
            "cav1",
            false,
            Isometry3::translation(1.0, 2.0, 3.0),
            points.into_iter().zip(5..),
            vec![object],
        );
        let before = AgentSweep::new(
            "cav1",
            false,
            Isometry3::translation(0.5, 2.0, 3.0),
            [([2.0, 0.5, -1.0], 0)].into_iter(),
            Vec::new(),
        );
        let earlier = Earlier {
            delay: 2,
            agents: vec![before],
        };
        Frame {
            classes: vec!["vehicle".into(), "pedestrian".into()],
            agents: vec![agent],
            earlier: Some(earlier),
        }
    }

    #[test]
    fn comes_back_from_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.frame");
        frame().write(&path).unwrap();
        let back = Frame::read(&path).unwrap();
        assert_eq!(back, frame());
        assert_eq!(back.agents[0].metres().next(), Some([1.0, -2.5, 0.25]));
        assert_eq!(
            back.agents[0].points.iter().map(|point| point.ring).collect::<Vec<_>>(),
            [5, 6]
        );
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn damaged_files_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.frame");
        frame().write(&path).unwrap();
        let bytes = fs::read(&path).unwrap();
        let mut cases = vec![Vec::new(), b"something else".to_vec()];
        cases.extend((8..bytes.len()).step_by(13).map(|end| bytes[..end].to_vec()));
        for case in cases {
            fs::write(&path, &case).unwrap();
            let error = Frame::read(&path).unwrap_err();
            assert!(
                matches!(error, TrainError::Cache { .. }),
                "{} bytes: {error}",
                case.len()
            );
        }
        assert!(matches!(
            Frame::read(&folder.path().join("b")),
            Err(TrainError::Read { .. })
        ));
    }
}

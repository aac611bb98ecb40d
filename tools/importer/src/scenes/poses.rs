//! All poses of an agent, where `realo-lab export` wrote them beside its labels, which have only those at the sweeps.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use realo_logs::{LogWriter, MAX_GAP, Stream};
use realo_schemas::Nanos;
use realo_schemas::geometry::PoseTrack;

use super::SceneAgent;
use crate::ImportError;
use crate::files::read_text;
use crate::places::{WORLD, recorded};

/// First line of the file.
const HEAD: &str = "topic,stamp_ns,ready_ns,x,y,z,qx,qy,qz,qw";
/// Poses of the two files are one within so many metres and radians.
const SAME_M: f64 = 0.05;
const SAME_RAD: f64 = 0.01;
/// Where only some frames are wanted, poses up to so long before and after them are, ns.
const AROUND: Nanos = 1_000_000_000;

struct Row {
    is_truth: bool,
    stamp: Nanos,
    ready: Nanos,
    map_from_body: Isometry3<f64>,
}

/// The poses of an agent, in the order of their times.
pub struct Poses {
    path: PathBuf,
    rows: Vec<Row>,
    next: usize,
    /// The true ones, or where there are none, the others.
    track: PoseTrack,
    /// Whether all of them are wanted; else those around the frames.
    all: bool,
    last: Nanos,
}

impl Poses {
    /// Those of a file of this name beside the labels of an agent, if it is there.
    ///
    /// # Errors
    /// A file that cannot be read, or a line that is no pose.
    pub fn of(agent: &SceneAgent, name: &str, all: bool) -> Result<Option<Self>, ImportError> {
        let labels = agent
            .sweeps
            .values()
            .map(|files| files.labels.with_file_name(name))
            .next();
        let Some(path) = labels.filter(|path| path.exists()) else {
            return Ok(None);
        };
        let rows = rows(&path, &read_text(&path)?)?;
        let has_truth = rows.iter().any(|row| row.is_truth);
        let mut track = PoseTrack::new(Nanos::MAX, MAX_GAP);
        for row in rows.iter().filter(|row| row.is_truth == has_truth) {
            track.insert(row.stamp, row.map_from_body);
        }
        Ok(Some(Poses {
            path,
            rows,
            next: 0,
            track,
            all,
            last: Nanos::MIN,
        }))
    }

    /// Writes those that were known when a sweep was ready, which lies here by its labels.
    ///
    /// # Errors
    /// Poses that are not those of the labels; why the log cannot be written.
    pub fn sweep(
        &mut self,
        log: &mut LogWriter,
        agent: &str,
        [stamp, ready]: [Nanos; 2],
        map_from_body: &Isometry3<f64>,
    ) -> Result<(), ImportError> {
        let Some(found) = self.track.at(stamp) else {
            let reason = format!(
                "expected a pose within the time of the sweeps, found none at {stamp} ns; give the labels their `stamp_ns` again, or remove \
                 this file: then poses are those of the labels"
            );
            return Err(ImportError::content(&self.path, reason));
        };
        let apart = (found.translation.vector - map_from_body.translation.vector).norm();
        let turned = found.rotation.angle_to(&map_from_body.rotation);
        if !(apart <= SAME_M && turned <= SAME_RAD) {
            let reason = format!(
                "expected the poses of the labels, found them {apart:.2} m and {turned:.3} rad apart at {stamp} ns; import with the \
                 options that the export named, or remove this file: then poses are those of the labels"
            );
            return Err(ImportError::content(&self.path, reason));
        }
        if !self.all && self.last == Nanos::MIN {
            let begin = stamp.saturating_sub(AROUND);
            self.next = self.rows.partition_point(|row| row.ready < begin);
        }
        self.last = ready;
        self.write(log, agent, ready)
    }

    /// Writes those behind the last sweep.
    ///
    /// # Errors
    /// Why the log cannot be written.
    pub fn finish(&mut self, log: &mut LogWriter, agent: &str) -> Result<(), ImportError> {
        let until = match self.all {
            true => Nanos::MAX,
            false => self.last.saturating_add(AROUND),
        };
        self.write(log, agent, until)
    }

    fn write(&mut self, log: &mut LogWriter, agent: &str, until: Nanos) -> Result<(), ImportError> {
        while let Some(row) = self.rows.get(self.next).filter(|row| row.ready <= until) {
            let state = recorded(row.map_from_body);
            match row.is_truth {
                true => log.pose_truth(agent, row.stamp, row.ready, &state)?,
                false => log.pose(agent, row.stamp, row.ready, &state)?,
            }
            self.next += 1;
        }
        Ok(())
    }
}

fn rows(path: &Path, text: &str) -> Result<Vec<Row>, ImportError> {
    let wrong = |number: usize, expected: &str, found: &str| {
        let found = crate::shown(found);
        let reason = format!(
            "line {number}: expected {expected}, found `{found}`; export it anew, or remove the file: then poses are those of the labels"
        );
        ImportError::content(path, reason)
    };
    let mut lines = text.lines();
    let head = lines.next().unwrap_or_default();
    if head != HEAD {
        return Err(wrong(1, &format!("`{HEAD}`"), head));
    }
    let numbered = (2..).zip(lines);
    let read = |(number, line): (usize, &str)| {
        row(line).ok_or_else(|| {
            wrong(
                number,
                "pose or pose_truth, two times in ns, a place and a quaternion",
                line,
            )
        })
    };
    let mut rows: Vec<Row> = numbered.map(read).collect::<Result<_, _>>()?;
    rows.sort_by_key(|row| row.ready);
    Ok(rows)
}

fn row(line: &str) -> Option<Row> {
    let words: [&str; 10] = line.split(',').collect::<Vec<_>>().try_into().ok()?;
    let [topic, stamp, ready, numbers @ ..] = words;
    let is_truth = match topic {
        topic if topic == Stream::PoseTruth.as_str() => true,
        topic if topic == Stream::Pose.as_str() => false,
        _ => return None,
    };
    let time = |text: &str| text.parse::<Nanos>().ok().filter(|time| *time >= 0);
    let numbers: Vec<f64> = numbers.iter().map(|text| text.parse().ok()).collect::<Option<_>>()?;
    let [x, y, z, qx, qy, qz, qw]: [f64; 7] = numbers.try_into().ok()?;
    let turn = Quaternion::new(qw, qx, qy, qz);
    let is_place = [x, y, z].iter().all(|metres| metres.abs() <= WORLD);
    // As it is written, to the bit.
    let is_turn = (turn.norm() - 1.0).abs() < 1e-6;
    (is_place && is_turn).then_some(Row {
        is_truth,
        stamp: time(stamp)?,
        ready: time(ready)?,
        map_from_body: Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::new_unchecked(turn)),
    })
}

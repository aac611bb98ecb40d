//! The lists of the data set: which sweeps there are, and which make a pair.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use realo_schemas::Nanos;
use serde::Deserialize;

use super::lists::{
    COOPERATIVE, Frame, LIST, ROADSIDE_SIDE, RoadsideInfo, SideInfo, SystemErrorOffset, Unusable, VEHICLE_SIDE,
    VehicleInfo, entries, in_no_entry, unusable,
};
use crate::ImportError;
use crate::faults::Faults;
use crate::files::local;

/// A pair as its list names it.
pub struct Listed {
    /// The vehicle's sweep, if its list has it.
    pub vehicle: Option<Frame>,
    /// The roadside unit's sweep, if its list has it.
    pub roadside: Option<Frame>,
    /// Clouds of a pair whose sweeps are in no list.
    pub alone: Vec<PathBuf>,
    /// Cooperative labels.
    pub truth: PathBuf,
    /// Added to the roadside unit's position in the world, m.
    pub offset: [f64; 2],
}

/// What the lists say.
pub struct Index {
    /// Pairs whose entry is usable.
    pub pairs: Vec<Listed>,
    /// Pairs whose entry is not usable.
    pub broken: usize,
    /// What is wrong with entries of pairs, and with entries of sweeps that pairs need.
    pub faults: Faults,
    /// What is wrong with other entries.
    pub unneeded: Faults,
}

impl Index {
    /// Reads the lists below a folder.
    ///
    /// # Errors
    /// All lists that cannot be read; a list without pairs.
    pub fn read(dir: &Path) -> Result<Self, ImportError> {
        let list = Path::new(COOPERATIVE).join(LIST);
        let (infos, vehicles, roadsides) = (
            entries::<PairInfo>(dir, COOPERATIVE),
            Side::read::<VehicleInfo>(dir, VEHICLE_SIDE),
            Side::read::<RoadsideInfo>(dir, ROADSIDE_SIDE),
        );
        let ((infos, broken), vehicles, roadsides) = match (infos, vehicles, roadsides) {
            (Ok(infos), Ok(vehicles), Ok(roadsides)) => (infos, vehicles, roadsides),
            (infos, vehicles, roadsides) => {
                let errors = [infos.err(), vehicles.err(), roadsides.err()];
                let reasons = errors.iter().flatten().map(|error| format!("  {error}"));
                return Err(ImportError::Lists {
                    path: dir.into(),
                    root: "cooperative-vehicle-infrastructure",
                    reasons: reasons.collect::<Vec<_>>().join("\n"),
                });
            }
        };
        let mut index = Index {
            pairs: Vec::new(),
            broken: broken.len(),
            faults: Faults::default(),
            unneeded: Faults::default(),
        };
        for entry in broken {
            index.faults.add(unusable(&list), entry.text);
        }
        for (number, info) in infos {
            index.pair(&list, number, info, [&vehicles, &roadsides]);
        }
        index.entries_of_no_pair(&vehicles);
        index.entries_of_no_pair(&roadsides);
        match index.pairs.is_empty() && index.broken == 0 {
            true => Err(ImportError::content(
                &dir.join(list),
                "expected at least one pair, found none",
            )),
            false => Ok(index),
        }
    }

    /// `number`: of the entry in its list.
    fn pair(&mut self, list: &Path, number: usize, info: PairInfo, sides: [&Side; 2]) {
        let clouds = [info.vehicle_pointcloud_path, info.infrastructure_pointcloud_path].map(local);
        let mut alone = Vec::new();
        let [vehicle, roadside] = [0, 1].map(|index| {
            let (cloud, side) = (&clouds[index], sides[index]);
            let frame = side.frames.get(cloud).cloned();
            if frame.is_none() {
                self.sweep_without_entry(cloud, side);
                alone.push(cloud.clone());
            }
            frame
        });
        let offset = match info.system_error_offset.meters() {
            Ok(offset) => offset,
            Err(reason) => {
                self.broken += 1;
                let [vehicle, _] = clouds;
                let entry = Unusable::new(number, Some(vehicle), reason);
                return self.faults.add(unusable(list), entry.text);
            }
        };
        self.pairs.push(Listed {
            vehicle,
            roadside,
            alone,
            truth: local(info.cooperative_label_path),
            offset,
        });
    }

    /// Adds what is wrong with the entries of a sweep that a pair needs, or that there is none.
    fn sweep_without_entry(&mut self, cloud: &Path, side: &Side) {
        let of_cloud = |entry: &&Unusable| entry.cloud.as_deref() == Some(cloud);
        let mut entries = side.unusable.iter().filter(of_cloud).peekable();
        if entries.peek().is_none() {
            self.faults.add(in_no_entry(&side.list), cloud.display().to_string());
        }
        for entry in entries {
            self.faults.add(unusable(&side.list), &entry.text);
        }
    }

    /// Adds what is wrong with the other entries of a side. One that does not say its cloud may be what a pair needs.
    fn entries_of_no_pair(&mut self, side: &Side) {
        let cause = unusable(&side.list);
        let is_one_missing = self.faults.by_cause.contains_key(&in_no_entry(&side.list));
        for entry in &side.unusable {
            if entry.cloud.is_none() && is_one_missing {
                self.faults.add(&cause, &entry.text);
            } else if !self.faults.contains(&cause, &entry.text) {
                self.unneeded.add(&cause, &entry.text);
            }
        }
    }
}

/// The sweeps of a side.
struct Side {
    list: PathBuf,
    /// By their clouds.
    frames: BTreeMap<PathBuf, Frame>,
    /// Other entries.
    unusable: Vec<Unusable>,
}

impl Side {
    fn read<T: SideInfo>(dir: &Path, side: &str) -> Result<Self, ImportError> {
        let list = Path::new(side).join(LIST);
        let (infos, unusable) = entries::<T>(dir, side)?;
        let mut found = Side {
            list,
            frames: BTreeMap::new(),
            unusable,
        };
        let mut stamps = BTreeMap::new();
        for (number, info) in infos {
            let files = info.files();
            let cloud = Path::new(side).join(files.cloud());
            match files.frame(|path| Path::new(side).join(path)) {
                Ok(frame) => found.add(number, frame, &mut stamps),
                Err(reason) => found.unusable.push(Unusable::new(number, Some(cloud), reason)),
            }
        }
        Ok(found)
    }

    /// Takes a sweep, if no other has its cloud or its stamp.
    fn add(&mut self, number: usize, frame: Frame, stamps: &mut BTreeMap<Nanos, PathBuf>) {
        let is_other = self.frames.get(&frame.cloud).is_some_and(|known| *known != frame);
        let at_its_stamp = stamps.get(&frame.stamp).filter(|known| **known != frame.cloud);
        let reason = match (is_other, at_its_stamp) {
            (true, _) => "expected one entry of this cloud, found two that differ; the first was taken".to_string(),
            (false, Some(known)) => format!(
                "pointcloud_timestamp: expected one cloud at each time, found that of {} too",
                known.display()
            ),
            (false, None) => {
                stamps.insert(frame.stamp, frame.cloud.clone());
                self.frames.insert(frame.cloud.clone(), frame);
                return;
            }
        };
        self.unusable.push(Unusable::new(number, Some(frame.cloud), reason));
    }
}

#[derive(Deserialize)]
struct PairInfo {
    infrastructure_pointcloud_path: PathBuf,
    vehicle_pointcloud_path: PathBuf,
    cooperative_label_path: PathBuf,
    system_error_offset: SystemErrorOffset,
}

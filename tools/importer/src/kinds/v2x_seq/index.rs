//! The lists of V2X-Seq-SPD: the sweeps of both sides by the numbers of their frames, and the pairs of each sequence.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use realo_schemas::Nanos;
use serde::Deserialize;
use serde_json::Value;

use crate::ImportError;
use crate::dair::lists::{
    COOPERATIVE, Entries, Frame, FrameId, LIST, ROADSIDE_SIDE, RoadsideInfo, SideInfo, SystemErrorOffset, Unusable,
    VEHICLE_SIDE, VehicleInfo, entries, in_no_entry, unusable, words,
};
use crate::faults::Faults;
use crate::scenes::{Lost, SweepPair};

/// Folder of cooperative labels.
pub const LABELS: &str = "label";

/// What the lists say.
#[derive(Default)]
pub struct Index {
    /// By their names.
    pub sequences: BTreeMap<String, Sequence>,
    /// Pairs whose entries do not say their sequence, and what is wrong with entries that may be of any.
    pub lost: Lost,
    /// What is there and in no pair.
    pub unneeded: Faults,
}

/// The pairs of a sequence.
#[derive(Default)]
pub struct Sequence {
    /// In the order of the vehicle's frames.
    pub pairs: Vec<SweepPair>,
    /// Pairs that cannot be taken, with what is wrong with their entries and those of their sweeps.
    pub lost: Lost,
}

/// A sweep in the list of its side.
#[derive(Deserialize)]
struct SweepInfo<T> {
    frame_id: Value,
    sequence_id: Value,
    #[serde(flatten)]
    files: T,
}

#[derive(Deserialize)]
struct PairInfo {
    vehicle_frame: Value,
    infrastructure_frame: Value,
    vehicle_sequence: Value,
    infrastructure_sequence: Value,
    system_error_offset: SystemErrorOffset,
}

/// A sweep of a side.
#[derive(PartialEq)]
struct Sweep {
    id: FrameId,
    sequence: String,
    frame: Frame,
}

/// The sweeps of a side.
struct Side {
    /// Its folder.
    folder: &'static str,
    /// By the numbers of their frames.
    sweeps: BTreeMap<u64, Sweep>,
    /// Other entries.
    unusable: Vec<Unusable>,
    /// Entries that say again what another does.
    repeated: Vec<String>,
}

/// A pair as its list names it.
#[derive(Clone, PartialEq)]
struct Pair {
    frames: [FrameId; 2],
    sequence: String,
    offset: [f64; 2],
}

impl Index {
    /// Reads the lists below a folder.
    ///
    /// # Errors
    /// All lists that cannot be read; a list without pairs.
    pub fn read(dir: &Path) -> Result<Self, ImportError> {
        let (pairs, vehicles, roadsides) = (
            entries::<PairInfo>(dir, COOPERATIVE),
            Side::read::<VehicleInfo>(dir, VEHICLE_SIDE),
            Side::read::<RoadsideInfo>(dir, ROADSIDE_SIDE),
        );
        let (pairs, vehicles, roadsides) = match (pairs, vehicles, roadsides) {
            (Ok(pairs), Ok(vehicles), Ok(roadsides)) => (pairs, vehicles, roadsides),
            (pairs, vehicles, roadsides) => {
                let errors = [pairs.err(), vehicles.err(), roadsides.err()];
                let reasons = errors.iter().flatten().map(|error| format!("  {error}"));
                return Err(ImportError::Lists {
                    path: dir.into(),
                    root: "V2X-Seq-SPD",
                    reasons: reasons.collect::<Vec<_>>().join("\n"),
                });
            }
        };
        let mut index = Index::default();
        index.pairs(dir, pairs, [&vehicles, &roadsides]);
        index.in_order();
        for side in [&vehicles, &roadsides] {
            index.other_entries(side);
        }
        index.sweeps_of_no_pair([&vehicles, &roadsides]);
        match index.sequences.is_empty() && index.lost.frames == 0 {
            true => {
                let reason = "expected at least one pair of frames, found none; fetch it anew";
                Err(ImportError::content(&dir.join(COOPERATIVE).join(LIST), reason))
            }
            false => Ok(index),
        }
    }

    /// Takes the pairs whose sweeps are there.
    fn pairs(&mut self, dir: &Path, (infos, broken): Entries<PairInfo>, sides: [&Side; 2]) {
        for entry in broken {
            self.lost.add(unusable(&list()), entry.text);
        }
        let mut known = BTreeMap::<u64, (usize, Pair)>::new();
        for (number, info) in infos {
            let pair = match info.pair() {
                Ok(pair) => pair,
                Err(reason) => {
                    let sequence = self.sequences.entry(words(&info.vehicle_sequence)).or_default();
                    sequence
                        .lost
                        .add(unusable(&list()), Unusable::new(number, None, reason).text);
                    continue;
                }
            };
            let name = |reason: String| format!("entry {number} (vehicle_frame {}): {reason}", pair.frames[0].name);
            match known.get(&pair.frames[0].number) {
                None => {}
                Some((first, other)) if *other == pair => {
                    let cause = format!("entry of {COOPERATIVE}/{LIST} that says again what another does");
                    self.unneeded.add(cause, name(format!("as entry {first}")));
                    continue;
                }
                Some((first, _)) => {
                    let reason = format!("expected a frame in one pair, found it in entry {first} too; remove one");
                    self.sequence(&pair).lost.add(unusable(&list()), name(reason));
                    continue;
                }
            }
            known.insert(pair.frames[0].number, (number, pair.clone()));
            match self.paired(dir, &pair, sides) {
                Ok(Some(sweeps)) => self.sequence(&pair).pairs.push(sweeps),
                Ok(None) => self.sequence(&pair).lost.frames += 1,
                Err(reason) => self.sequence(&pair).lost.add(unusable(&list()), name(reason)),
            }
        }
        for sequence in self.sequences.values_mut() {
            sequence.pairs.sort_by_key(|pair| pair.vehicle.0.number);
        }
    }

    fn sequence(&mut self, pair: &Pair) -> &mut Sequence {
        self.sequences.entry(pair.sequence.clone()).or_default()
    }

    /// The sweeps of a pair; `None` where a list has no such sweep, which is added to the faults.
    fn paired(&mut self, dir: &Path, pair: &Pair, sides: [&Side; 2]) -> Result<Option<SweepPair>, String> {
        let found = [0, 1].map(|index| {
            let (side, id) = (sides[index], &pair.frames[index]);
            let sweep = side.sweeps.get(&id.number);
            if sweep.is_none() {
                self.sequence(pair).sweep_without_entry(side, id);
            }
            sweep
        });
        let [Some(vehicle), Some(roadside)] = found else {
            return Ok(None);
        };
        for (sweep, side) in [(vehicle, sides[0]), (roadside, sides[1])] {
            if sweep.sequence != pair.sequence {
                return Err(format!(
                    "expected frames of the sequence `{}`, found frame {} of {}/{LIST} in sequence `{}`; correct one of them",
                    pair.sequence, sweep.id.name, side.folder, sweep.sequence
                ));
            }
        }
        let labels = format!("{}.json", pair.frames[0].name);
        Ok(Some(SweepPair {
            vehicle: (vehicle.id.clone(), vehicle.frame.clone()),
            roadside: (roadside.id.clone(), roadside.frame.clone()),
            labels: dir.join(COOPERATIVE).join(LABELS).join(labels),
            offset: pair.offset,
        }))
    }

    /// Leaves out pairs whose stamps go back.
    fn in_order(&mut self) {
        for (name, sequence) in &mut self.sequences {
            sequence.in_order(name);
        }
    }

    /// Adds what is wrong with the other entries of a side. One that does not say its frame may be what a pair needs.
    fn other_entries(&mut self, side: &Side) {
        let cause = unusable(&side.list());
        let mut faults = self.sequences.values().map(|sequence| &sequence.lost.faults);
        let is_one_missing = faults.any(|faults| faults.by_cause.contains_key(&in_no_entry(&side.list())));
        for entry in &side.unusable {
            let mut faults = self.sequences.values().map(|sequence| &sequence.lost.faults);
            if entry.frame.is_none() && is_one_missing {
                self.lost.faults.add(&cause, &entry.text);
            } else if !faults.any(|faults| faults.contains(&cause, &entry.text)) {
                self.unneeded.add(&cause, &entry.text);
            }
        }
        let cause = format!("entry of {} that says again what another does", side.list().display());
        side.repeated.iter().for_each(|text| self.unneeded.add(&cause, text));
    }

    /// Counts sweeps that are in no pair, by sequence, and names sequences without any pair.
    fn sweeps_of_no_pair(&mut self, sides: [&Side; 2]) {
        let mut alone = BTreeMap::<&str, [usize; 2]>::new();
        for (index, side) in sides.iter().enumerate() {
            let of_pair = |pair: &SweepPair| [&pair.vehicle, &pair.roadside][index].0.number;
            let pairs = self.sequences.values().flat_map(|sequence| &sequence.pairs);
            let paired: BTreeSet<u64> = pairs.map(of_pair).collect();
            for (number, sweep) in &side.sweeps {
                alone.entry(&sweep.sequence).or_default()[index] += usize::from(!paired.contains(number));
            }
        }
        for (sequence, [of_vehicle, of_roadside]) in alone {
            let sweeps = format!("`{sequence}`: {of_vehicle} of {VEHICLE_SIDE}, {of_roadside} of {ROADSIDE_SIDE}");
            match (self.sequences.contains_key(sequence), of_vehicle + of_roadside) {
                (_, 0) => {}
                (true, _) => self
                    .unneeded
                    .add("sequence with sweeps in no pair, which were left out", sweeps),
                (false, _) => self
                    .unneeded
                    .add("sequence without a pair, which becomes no log", sweeps),
            }
        }
    }
}

impl Sequence {
    /// Adds what is wrong with the entries of a sweep that a pair needs, or that there is none.
    fn sweep_without_entry(&mut self, side: &Side, id: &FrameId) {
        let faults = &mut self.lost.faults;
        let entries = side.unusable.iter().filter(|entry| entry.frame == Some(id.number));
        let texts: Vec<&String> = entries.map(|entry| &entry.text).collect();
        if texts.is_empty() {
            faults.add(in_no_entry(&side.list()), format!("frame {}", id.name));
        }
        for text in texts {
            faults.add(unusable(&side.list()), text);
        }
    }

    /// Leaves out pairs whose stamps go back: frames follow each other as their numbers do. A roadside sweep may be in several
    /// pairs.
    fn in_order(&mut self, name: &str) {
        let mut last: [Option<(FrameId, Nanos)>; 2] = [None, None];
        for pair in std::mem::take(&mut self.pairs) {
            let sides = [(&pair.vehicle, VEHICLE_SIDE), (&pair.roadside, ROADSIDE_SIDE)];
            let back = sides.iter().zip(&last).find_map(|(((id, frame), folder), last)| {
                let (before, stamp) = last.as_ref()?;
                let is_back = frame.stamp < *stamp || (frame.stamp == *stamp && id != before);
                is_back.then(|| {
                    format!(
                        "frame {}: pointcloud_timestamp: expected one later than that of frame {}, {} µs, found {} µs; correct the \
                         numbers or the stamps of sequence `{name}` in {folder}/{LIST}",
                        id.name,
                        before.name,
                        stamp / 1000,
                        frame.stamp / 1000
                    )
                })
            });
            match back {
                Some(reason) => self.lost.add("frame whose stamp goes back".into(), reason),
                None => {
                    last = sides.map(|((id, frame), _)| Some((id.clone(), frame.stamp)));
                    self.pairs.push(pair);
                }
            }
        }
    }
}

/// The list of pairs.
fn list() -> PathBuf {
    Path::new(COOPERATIVE).join(LIST)
}

impl PairInfo {
    fn pair(&self) -> Result<Pair, String> {
        let frames = [
            FrameId::of("vehicle_frame", &self.vehicle_frame)?,
            FrameId::of("infrastructure_frame", &self.infrastructure_frame)?,
        ];
        let [sequence, other] = [&self.vehicle_sequence, &self.infrastructure_sequence].map(words);
        if sequence.is_empty() || sequence != other {
            return Err(format!(
                "vehicle_sequence and infrastructure_sequence: expected one name, as `0000`, found `{}` and `{}`; correct them",
                crate::shown(&sequence),
                crate::shown(&other)
            ));
        }
        Ok(Pair {
            frames,
            sequence,
            offset: self.system_error_offset.meters()?,
        })
    }
}

impl Side {
    fn read<T: SideInfo>(dir: &Path, folder: &'static str) -> Result<Self, ImportError> {
        let (infos, unusable) = entries::<SweepInfo<T>>(dir, folder)?;
        let mut side = Side {
            folder,
            sweeps: BTreeMap::new(),
            unusable,
            repeated: Vec::new(),
        };
        for (number, info) in infos {
            let files = info.files.files();
            let cloud = Path::new(folder).join(files.cloud());
            let id = FrameId::of("frame_id", &info.frame_id);
            let frame = files.frame(|path| dir.join(folder).join(path));
            match id.clone().and_then(|id| Ok((id, frame?))) {
                Ok((id, frame)) => {
                    let sequence = words(&info.sequence_id);
                    side.add(number, cloud, Sweep { id, sequence, frame });
                }
                Err(reason) => side.unusable.push(Unusable {
                    frame: id.ok().map(|id| id.number),
                    ..Unusable::new(number, Some(cloud), reason)
                }),
            }
        }
        Ok(side)
    }

    /// Its list.
    fn list(&self) -> PathBuf {
        Path::new(self.folder).join(LIST)
    }

    /// Takes a sweep, if no other has its number.
    fn add(&mut self, number: usize, cloud: PathBuf, sweep: Sweep) {
        match self.sweeps.get(&sweep.id.number) {
            None => drop(self.sweeps.insert(sweep.id.number, sweep)),
            Some(known) if *known == sweep => {
                self.repeated.push(format!("entry {number}: frame {}", sweep.id.name));
            }
            Some(known) => {
                let reason = format!(
                    "expected one entry of frame {}, found two that differ; the first was taken",
                    known.id.name
                );
                self.unusable.push(Unusable {
                    // Its frame is there.
                    frame: Some(sweep.id.number),
                    ..Unusable::new(number, Some(cloud), reason)
                });
            }
        }
    }
}

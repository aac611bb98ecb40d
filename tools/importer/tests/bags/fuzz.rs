//! Damaged bags of every container are read or refused, and take no more memory than their size allows.
//!
//! `REALO_FUZZ_CASES=100000 cargo test --release -p realo-importer --test bags fuzz` runs as many cases.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use damage::{Draw, cases, most_held};
use realo_bags::messages::{Kind, detections, fix, pose, transforms};
use realo_bags::{Draft, open, survey};
use realo_logs::cloud::CloudReader;

use super::containers::all;
use super::world::{PLAIN, recording};

/// What chunks may unpack to, more than once at a time, and what decoders hold.
fn bound(bytes: usize) -> u64 {
    (96 << 20) + 4 * 1024 * bytes as u64
}

/// Reads all that a bag has; gives how many messages were read.
fn read(path: &Path) -> Result<usize, String> {
    let bag = open(path).map_err(|error| error.to_string())?;
    let survey = survey(bag.as_ref()).map_err(|error| error.to_string())?;
    let _ = (survey.to_string(), Draft::of(&[survey]).map(|draft| draft.to_string()));
    let wanted: BTreeSet<usize> = (0..bag.connections().len()).collect();
    let mut messages = bag.messages(&wanted).map_err(|error| error.to_string())?;
    let mut count = 0;
    while let Some(message) = messages.next().map_err(|error| error.to_string())? {
        count += 1;
        let connection = &bag.connections()[message.connection];
        let begin = || connection.reader(message.data());
        let Ok(mut input) = begin() else { continue };
        // Whether they can be read does not matter here.
        match Kind::named(&connection.kind) {
            Some(Kind::PointCloud2) => drop(CloudReader::read(&mut input).map(|cloud| cloud.look())),
            Some(Kind::Transforms) => drop(transforms(&mut input)),
            Some(Kind::NavSatFix) => drop(fix(&mut input)),
            Some(Kind::Detection3DArray) => drop(detections(begin)),
            Some(kind) if kind.is_pose() => drop(pose(kind, &mut input)),
            _ => {}
        }
    }
    Ok(count)
}

/// The file of a bag that is damaged.
fn file_of(bag: &Path, draw: &mut Draw) -> PathBuf {
    if bag.is_file() {
        return bag.into();
    }
    let mut files: Vec<PathBuf> = fs::read_dir(bag).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files.swap_remove(draw.below(files.len()))
}

#[test]
fn damaged_bags_are_read_or_refused() {
    let dir = tempfile::tempdir().unwrap();
    let messages: Vec<_> = recording(PLAIN, 0.0, 0).into_iter().take(12).collect();
    let bags = all(dir.path(), &messages);
    for (name, bag) in &bags {
        assert_eq!(read(bag).unwrap(), messages.len(), "{name}");
    }
    let (mut whole, mut refused) = (0, 0);
    for case in 0..cases(300) {
        let mut draw = Draw::new(case);
        let (name, bag) = &bags[draw.below(bags.len())];
        let file = file_of(bag, &mut draw);
        let sound = fs::read(&file).unwrap();
        let mut bytes = sound.clone();
        draw.damage(&mut bytes);
        if draw.chance(4) {
            bytes.truncate(draw.below(bytes.len()));
        }
        fs::write(&file, &bytes).unwrap();
        let mut found = Ok(0);
        let held = most_held(|| found = read(bag));
        assert!(
            held <= bound(bytes.len()),
            "case {case} of {name}: {} bytes took {held}",
            bytes.len()
        );
        match found {
            Ok(_) => whole += 1,
            Err(error) => {
                assert!(!error.is_empty());
                refused += 1;
            }
        }
        fs::write(&file, sound).unwrap();
    }
    assert!(whole > 0 && refused > 0, "{whole} read, {refused} refused");
}

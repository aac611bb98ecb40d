//! Logs are read back as they were written, whole or cut, by our reader and by that of the `mcap` crate.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex};

use common::{MS, POINTS, START, SWEEPS};
use realo_logs::{Log, LogError, LogWriter, McapFile, Output, Stream, describe};
use realo_schemas::{Nanos, PoseStatus};

fn made() -> (tempfile::TempDir, std::path::PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    common::make(&path);
    (dir, path)
}

#[test]
fn reads_back_what_was_written() {
    let (_dir, path) = made();
    let log = Log::open(&path).unwrap();
    assert_eq!(log.info(), &common::info());
    assert!(log.truncation().is_none());
    let mut reader = log
        .read_all(&[
            ("rsu1", Stream::Points),
            ("cav1", Stream::GroundTruth),
            ("cav1", Stream::GroundTruthInfo),
            ("cav1", Stream::PoseTruth),
        ])
        .unwrap();
    let mut sweeps = 0;
    let mut boxes = None;
    let mut last = 0;
    while let Some(entry) = reader.next().unwrap() {
        assert!(entry.ready() >= last);
        last = entry.ready();
        match entry.stream {
            Stream::Points => {
                assert_eq!(entry.cloud().unwrap(), common::cloud(POINTS, sweeps as u32));
                assert_eq!(entry.seq(), sweeps as u64);
                assert_eq!(entry.stamp(), START + 50 * MS + sweeps as Nanos * 100 * MS);
                sweeps += 1;
            }
            Stream::PoseTruth => {
                let seconds = (entry.stamp() - START) / MS / 10;
                assert_eq!(
                    entry.pose().unwrap(),
                    common::state(seconds as f64 * 0.01, PoseStatus::Truth)
                );
            }
            Stream::GroundTruth => boxes = Some(entry.boxes().unwrap()),
            _ => {
                let mut boxes = boxes.take().unwrap();
                let info = entry.info(&mut boxes).unwrap();
                assert_eq!(boxes.0, common::objects(info.seq as usize % 5));
                assert_eq!(info.points, Some((0..info.seq as u32 % 5).collect()));
                assert_eq!(info.key, info.seq % 2 == 0);
            }
        }
    }
    assert_eq!(sweeps, SWEEPS);
    assert_eq!(log.key_frames().unwrap()["cav1"].len(), SWEEPS / 2);
    assert_eq!(log.span(), Some((START + MS, START + 3000 * MS)));
}

#[test]
fn reads_a_time_range_only() {
    let (_dir, path) = made();
    let log = Log::open(&path).unwrap();
    let (from, until) = (START + 1100 * MS, START + 1500 * MS);
    let mut reader = log.read(&[("cav1", Stream::Points)], from, until).unwrap();
    let mut seqs = Vec::new();
    while let Some(entry) = reader.next().unwrap() {
        seqs.push(entry.seq());
    }
    assert_eq!(seqs, [10, 11, 12, 13]);
}

#[test]
fn the_mcap_crate_reads_it_with_every_checksum() {
    let (_dir, path) = made();
    let bytes = fs::read(&path).unwrap();
    let mut counts: BTreeMap<String, u64> = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let number = counts.entry(message.channel.topic.clone()).or_default();
        assert_eq!(u64::from(message.sequence), *number);
        *number += 1;
    }
    let log = Log::open(&path).unwrap();
    let ours: BTreeMap<String, u64> = log
        .topics()
        .into_iter()
        .map(|(topic, info)| (topic, info.messages))
        .collect();
    assert_eq!(counts, ours);
    assert_eq!(counts["/cav1/points"], SWEEPS as u64);

    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let stats = summary.stats.as_ref().unwrap();
    assert_eq!(stats.message_count, counts.values().sum::<u64>());
    assert_eq!(stats.chunk_count as usize, summary.chunk_indexes.len());
    let mut indexed = 0;
    for chunk in &summary.chunk_indexes {
        assert!(chunk.message_end_time - chunk.message_start_time <= 500 * MS as u64);
        for entries in summary.read_message_indexes(&bytes, chunk).unwrap().values() {
            for entry in entries {
                summary.seek_message(&bytes, chunk, entry).unwrap();
                indexed += 1;
            }
        }
    }
    assert_eq!(indexed, stats.message_count);
    let footer = mcap::read::footer(&bytes).unwrap();
    assert_ne!(footer.summary_crc, 0);
    let names: Vec<String> = summary
        .metadata_indexes
        .iter()
        .map(|index| mcap::read::metadata(&bytes, index).unwrap().name)
        .collect();
    assert_eq!(names, ["realo", "realo_end"]);
}

/// Everything readable in a log, as (topic's stream, ready).
fn times(path: &Path) -> Vec<(Stream, Nanos)> {
    let log = Log::open(path).unwrap();
    let all = [Stream::Points, Stream::Pose, Stream::GroundTruth].map(|stream| ("cav1", stream));
    let all: Vec<_> = all
        .into_iter()
        .filter(|(agent, stream)| log.has(agent, *stream))
        .collect();
    let mut reader = log.read_all(&all).unwrap();
    let mut times = Vec::new();
    while let Some(entry) = reader.next().unwrap() {
        times.push((entry.stream, entry.ready()));
    }
    times
}

#[test]
fn a_cut_loses_at_most_a_second_and_is_reported() {
    let (dir, path) = made();
    let whole = times(&path);
    let bytes = fs::read(&path).unwrap();
    let cut = dir.path().join("cut.mcap");
    for percent in [30, 50, 70, 90, 99] {
        let at = bytes.len() * percent / 100;
        fs::write(&cut, &bytes[..at]).unwrap();
        let log = Log::open(&cut).unwrap();
        let truncation = log.truncation().unwrap();
        assert_eq!(truncation.file_bytes, at as u64);
        assert_eq!(truncation.expected_end, Some(START + 3000 * MS));
        let left = times(&cut);
        let last = left.iter().map(|(_, ready)| *ready).max().unwrap();
        let complete: Vec<_> = whole.iter().filter(|(_, ready)| *ready < last - 1000 * MS).collect();
        assert!(
            complete.iter().all(|entry| left.contains(entry)),
            "{percent} %: {truncation}"
        );
        assert!(left.iter().all(|entry| whole.contains(entry)));
        assert_eq!(truncation.complete_until, log.span().map(|(_, last)| last + 1));
        let before: Vec<_> = whole
            .iter()
            .filter(|(_, ready)| *ready <= log.span().unwrap().1)
            .collect();
        assert_eq!(
            left.len(),
            before.len(),
            "{percent} %: nothing is missing before the cut"
        );
        let expected = (percent as f64 / 100.0 - 0.4) * 3.0;
        assert!(
            (last - START) as f64 > expected * 1e9,
            "{percent} %: only {} s are left",
            (last - START) as f64 * 1e-9
        );
        assert!(describe(&cut).unwrap().to_string().contains("TRUNCATED"));
    }
}

#[test]
fn every_cut_and_every_flipped_byte_is_an_answer_or_an_error() {
    let (dir, path) = made();
    let bytes = fs::read(&path).unwrap();
    let damaged = dir.path().join("damaged.mcap");
    for at in (0..4000)
        .step_by(97)
        .chain((bytes.len() - 9000..bytes.len()).step_by(211))
    {
        fs::write(&damaged, &bytes[..at]).unwrap();
        let _ = Log::open(&damaged).map(|log| log.topics());
        let mut flipped = bytes.clone();
        flipped[at] ^= 0x5a;
        fs::write(&damaged, &flipped).unwrap();
        if let Ok(log) = Log::open(&damaged)
            && let Ok(mut reader) = log.read_all(&[("cav1", Stream::GroundTruth)])
        {
            while let Ok(Some(entry)) = reader.next() {
                let _ = entry.boxes();
            }
        }
    }
}

#[test]
fn an_unfinished_writer_leaves_a_readable_log_and_an_atomic_one_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    let mut writer = LogWriter::create(&path, &common::info()).unwrap();
    common::fill(&mut writer).unwrap();
    // As if the program were killed: nothing of the writer runs any more. Its threads write what they were given.
    std::mem::forget(writer);
    let left = || times(&path).iter().map(|(_, ready)| *ready).max().unwrap_or(0);
    for _ in 0..100 {
        if left() >= START + 2400 * MS {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    assert!(left() >= START + 2400 * MS, "only {} ns are left", left() - START);
    assert!(Log::open(&path).unwrap().truncation().is_some());

    let path = dir.path().join("b.mcap");
    let mut writer = LogWriter::create_atomic(&path, &common::info()).unwrap();
    common::fill(&mut writer).unwrap();
    assert!(!path.exists());
    drop(writer);
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    let mut writer = LogWriter::create_atomic(&path, &common::info()).unwrap();
    common::fill(&mut writer).unwrap();
    writer.finish().unwrap();
    assert!(Log::open(&path).unwrap().truncation().is_none());
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
}

#[test]
fn a_finished_log_replaces_files_only_and_follows_links() {
    let dir = tempfile::tempdir().unwrap();
    let begin = |path: &Path| LogWriter::create_atomic(path, &common::info());
    let refused = |path: &Path| begin(path).map(|_| ()).unwrap_err().to_string();
    let folder = refused(dir.path());
    assert!(folder.contains("found a folder; choose another path"), "{folder}");
    let device = refused(Path::new("/dev/null"));
    assert!(
        device.contains("/dev/null") && device.contains("found a device"),
        "{device}"
    );
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);

    let [target, link] = ["target.mcap", "link.mcap"].map(|name| dir.path().join(name));
    fs::write(&target, "what was there").unwrap();
    std::os::unix::fs::symlink(&target, &link).unwrap();
    let mut writer = begin(&link).unwrap();
    common::fill(&mut writer).unwrap();
    writer.finish().unwrap();
    assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
    assert!(Log::open(&target).unwrap().truncation().is_none());
}

#[test]
fn bytes_do_not_depend_on_timing() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b] = ["a", "b"].map(|name| {
        let path = dir.path().join(name);
        common::make(&path);
        fs::read(path).unwrap()
    });
    assert_eq!(a, b);
}

/// A disk with room for so many bytes.
struct Small {
    disk: Arc<Mutex<Vec<u8>>>,
    room: usize,
}

impl Write for Small {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut disk = self.disk.lock().unwrap();
        let n = bytes.len().min(self.room - disk.len());
        disk.extend_from_slice(&bytes[..n]);
        if n == 0 {
            Err(io::Error::from_raw_os_error(28))
        } else {
            Ok(n)
        }
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Output for Small {
    fn cut(&mut self, length: u64) {
        self.disk.lock().unwrap().truncate(length as usize);
    }
}

#[test]
fn a_full_disk_is_an_error_and_what_was_written_stays_readable() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("full.mcap");
    let disk = Arc::new(Mutex::new(Vec::new()));
    let output = Small {
        disk: disk.clone(),
        room: 6_000_000,
    };
    let mut writer = LogWriter::to_output(&path, output, &common::info()).unwrap();
    let error = common::fill(&mut writer).and_then(|()| writer.finish()).unwrap_err();
    assert!(
        matches!(error, LogError::Write { written, .. } if written > 4_000_000),
        "{error}"
    );
    assert!(error.to_string().contains("No space left on device"), "{error}");
    fs::write(&path, &*disk.lock().unwrap()).unwrap();
    let last = times(&path).iter().map(|(_, ready)| *ready).max().unwrap();
    assert!(last > START + 300 * MS);

    let mut writer = LogWriter::create("/dev/full", &common::info()).unwrap();
    let error = common::fill(&mut writer).and_then(|()| writer.finish()).unwrap_err();
    assert!(error.to_string().contains("No space left on device"), "{error}");
}

#[test]
fn says_what_is_wrong_and_what_there_is() {
    let (dir, path) = made();
    let log = Log::open(&path).unwrap();
    let error = log.read_all(&[("cav2", Stream::Points)]).unwrap_err().to_string();
    assert!(error.contains("no agent `cav2`; it has: cav1, rsu1"), "{error}");

    let bare = dir.path().join("bare.mcap");
    let mut writer = LogWriter::create(&bare, &common::info()).unwrap();
    writer
        .pose("cav1", START, START, &common::state(0.0, PoseStatus::Recorded))
        .unwrap();
    assert!(
        writer
            .truth("cav1", START, START, &common::objects(2), Some(&[1]), true)
            .is_err()
    );
    let error = writer
        .pose("cav9", START, START, &common::state(0.0, PoseStatus::Recorded))
        .unwrap_err();
    assert!(error.to_string().contains("`cav9`"), "{error}");
    assert!(writer.sweep("cav1", -1, START).is_err());
    writer.finish().unwrap();
    let error = Log::open(&bare)
        .unwrap()
        .need("cav1", Stream::Points)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("no topic `/cav1/points`") && error.contains("topics there: /cav1/pose"),
        "{error}"
    );

    let mut twins = common::info();
    twins.agents[1].name = "cav1".into();
    let error = LogWriter::create(dir.path().join("twins.mcap"), &twins)
        .err()
        .unwrap()
        .to_string();
    assert!(error.contains("two agents are named `cav1`"), "{error}");

    let other = dir.path().join("other");
    fs::write(&other, b"PK\x03\x04 something else").unwrap();
    let error = Log::open(&other).unwrap_err().to_string();
    assert!(error.contains("is not an MCAP file"), "{error}");
    let error = Log::open(dir.path().join("none.mcap")).unwrap_err().to_string();
    assert!(error.contains("cannot open") && error.contains("none.mcap"), "{error}");

    let mut writer = mcap::Writer::new(fs::File::create(&other).unwrap()).unwrap();
    writer.finish().unwrap();
    let error = Log::open(&other).unwrap_err().to_string();
    assert!(
        error.contains("no metadata record `realo`") && error.contains("realo-lab simulate"),
        "{error}"
    );
}

#[test]
fn two_agents_of_one_name_in_a_file_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("twins.mcap");
    let mut writer = mcap::Writer::new(fs::File::create(&path).unwrap()).unwrap();
    let agents = r#"[{"name":"a","kind":"vehicle"},{"name":"a","kind":"roadside"}]"#;
    let entries = [
        ("format", "1"),
        ("program", "x"),
        ("source", "x"),
        ("agents", agents),
        ("map_frame", "map"),
        ("protocol", "default"),
        ("key_frames", "all"),
    ];
    let metadata = entries
        .into_iter()
        .map(|(k, v)| (k.to_string(), v.to_string()))
        .collect();
    writer
        .write_metadata(&mcap::records::Metadata {
            name: "realo".into(),
            metadata,
        })
        .unwrap();
    writer.finish().unwrap();
    let error = Log::open(&path).unwrap_err().to_string();
    assert!(error.contains("two agents are named `a`"), "{error}");
}

#[test]
fn a_wrong_index_is_not_believed_and_nothing_is_missing() {
    let (dir, path) = made();
    let whole = times(&path);
    let topics = Log::open(&path).unwrap().topics();
    let bytes = fs::read(&path).unwrap();
    // The last bytes are the footer's length, the index' start, that of its offsets, its checksum, and the magic.
    let start = u64::from_le_bytes(bytes[bytes.len() - 28..][..8].try_into().unwrap()) as usize;
    let other = dir.path().join("other.mcap");
    let topic = b"/cav1/points";
    let named = start
        + bytes[start..]
            .windows(topic.len())
            .position(|bytes| bytes == topic)
            .unwrap();
    let statistics = (start..bytes.len() - 37)
        .find(|at| bytes[*at] == mcap::records::op::STATISTICS && bytes[at + 2..at + 9] == [0; 7])
        .unwrap();
    for (at, crc) in [
        (statistics + 9, false),
        (statistics + 9, true),
        (named + 5, true),
        (bytes.len() - 28, true),
        (bytes.len() - 12, true),
    ] {
        let mut changed = bytes.clone();
        changed[at] ^= 1;
        if !crc {
            let end = changed.len() - 12;
            let sum = crc32fast::hash(&changed[start..end]);
            changed[end..end + 4].copy_from_slice(&sum.to_le_bytes());
        }
        fs::write(&other, changed).unwrap();
        let log = Log::open(&other).unwrap();
        assert!(log.truncation().is_none(), "{at}");
        assert_eq!(log.topics(), topics, "{at}");
        assert!(times(&other) == whole, "{at}");
        assert_eq!(log.key_frames().unwrap()["cav1"].len(), SWEEPS / 2);
    }
}

fn files_below(dir: &Path, ends: &str, found: &mut Vec<std::path::PathBuf>) {
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files_below(&path, ends, found);
        } else if path.to_string_lossy().ends_with(ends) {
            found.push(path);
        }
    }
    found.sort();
}

#[test]
fn reads_the_conformance_files_of_mcap() {
    let Some(shared) = skipped::shared("data/mcap-conformance") else {
        return;
    };
    let mut files = Vec::new();
    files_below(&shared, ".mcap", &mut files);
    assert!(files.len() > 100);
    for path in files {
        let expected: serde_json::Value =
            serde_json::from_slice(&fs::read(path.with_extension("json")).unwrap()).unwrap();
        let records = expected["records"].as_array().unwrap();
        let of_type = |name: &str| records.iter().filter(|r| r["type"] == name).count();
        let file = McapFile::open(&path).unwrap_or_else(|error| panic!("{error}"));
        let channels = file.channels().keys().copied().collect();
        let mut messages = file.messages(channels, 0..u64::MAX).unwrap();
        let mut count = 0;
        while let Some(message) = messages.next().unwrap() {
            assert!(!message.data().is_empty());
            count += 1;
        }
        assert_eq!(count, of_type("Message"), "{}", path.display());
        assert!(file.truncation().is_none(), "{}", path.display());
    }
}

#[test]
fn reads_rosbag2_files_and_says_that_they_are_no_logs() {
    let Some(shared) = skipped::shared("data/rosbag2/mcap") else {
        return;
    };
    let mut files = Vec::new();
    files_below(&shared, ".mcap", &mut files);
    let mut counts = BTreeMap::new();
    for path in files {
        let file = McapFile::open(&path).unwrap_or_else(|error| panic!("{error}"));
        let mut messages = file
            .messages(file.channels().keys().copied().collect(), 0..u64::MAX)
            .unwrap();
        let mut count = 0u64;
        while messages.next().unwrap().is_some() {
            count += 1;
        }
        assert_eq!(
            count,
            file.channels().values().map(|channel| channel.messages).sum::<u64>()
        );
        assert!(matches!(Log::open(&path), Err(LogError::NotRealo { .. })));
        counts.insert(path.file_stem().unwrap().to_string_lossy().into_owned(), count);
    }
    assert!(
        counts
            .iter()
            .any(|(name, count)| name.starts_with("talker") && *count == 20),
        "{counts:?}"
    );
    let wbag: Vec<u64> = counts
        .iter()
        .filter(|(name, _)| name.starts_with("wbag"))
        .map(|(_, n)| *n)
        .collect();
    assert_eq!(wbag, [1246, 1240, 1240, 1240, 1108]);
}

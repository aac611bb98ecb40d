//! What a file is that is no log of realo, what it holds, and what helps.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use crate::info::LOG_RECORD;
use crate::{McapFile, shell};

/// Where the way from other data to a log is described.
pub(crate) const GUIDE: &str = "docs/reference/log-format.md says what a log holds, python/realo_log.py writes one, `realo-lab import` reads data sets, `realo-lab simulate` makes one up";
const NONE: &str = "no topics";
/// Topics that are listed.
const SHOWN: usize = 12;

/// Says what starts with these bytes instead of being an MCAP file.
pub(crate) fn not_mcap(path: &Path, head: &[u8]) -> String {
    let name = shell::word(path);
    let unpack = |program: &str| format!("unpack it first (`{program} {name}`)");
    let known: [(&[u8], &str, String); 9] = [
        (
            b"version https://git-lfs",
            "it is a pointer of git-LFS, not the file itself",
            format!(
                "fetch the file: `git lfs pull --include {}`",
                shell::word(file_name(path))
            ),
        ),
        (
            b"\x28\xb5\x2f\xfd",
            "it is compressed as a whole by zstd",
            unpack("zstd -d"),
        ),
        (b"\x1f\x8b", "it is compressed as a whole by gzip", unpack("gunzip -k")),
        (
            b"\x04\x22\x4d\x18",
            "it is compressed as a whole by lz4",
            unpack("lz4 -d"),
        ),
        (b"BZh", "it is compressed as a whole by bzip2", unpack("bunzip2 -k")),
        (b"PK\x03\x04", "it is a zip archive", unpack("unzip")),
        (b"# .PCD", "it is a cloud of PCL (.pcd)", GUIDE.into()),
        (b"SQLite format 3\0", "it is a bag of ROS 2 in SQLite", sqlite(path)),
        (b"#ROSBAG V", "it is a bag of ROS 1", rosbag1(path)),
    ];
    if head.is_empty() {
        return "it is empty; the program that wrote it ended before its first message, or the copy failed".into();
    }
    if let Some((_, what, then)) = known.into_iter().find(|(magic, ..)| head.starts_with(magic)) {
        return format!("{what}; {then}");
    }
    let found = &head[..head.len().min(5)];
    format!("expected it to start with 89 4d 43 41 50, found {found:02x?}; {GUIDE}")
}

/// How a bag becomes a log.
pub(crate) fn imported(path: &Path) -> String {
    format!(
        "`realo-lab import bag {} -o LOG` makes a log of it; topics of other types: {GUIDE}",
        shell::word(path)
    )
}

fn sqlite(path: &Path) -> String {
    let held = path.parent().and_then(of_metadata).filter(|held| held != NONE);
    format!(
        "{}{}",
        held.map_or(String::new(), |held| format!("it holds {held}; ")),
        imported(path)
    )
}

/// Says what a folder is.
pub(crate) fn folder(path: &Path) -> String {
    let mut files: Vec<String> = fs::read_dir(path)
        .into_iter()
        .flatten()
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| name.contains(".mcap") || name.contains(".db3"))
        .collect();
    files.sort();
    let metadata = of_metadata(path);
    let what = match (&metadata, files.is_empty()) {
        (None, true) => {
            return format!(
                "it is a folder; expected an MCAP file. If it is a data set, `realo-lab import auto {}` says which, and how it becomes a log",
                shell::word(path)
            );
        }
        (None, false) => format!("it is a folder (files: {})", files.join(", ")),
        (Some(_), _) => format!("it is the folder of a bag of ROS 2 (files: {})", files.join(", ")),
    };
    let is_mcap = |name: &&String| Path::new(name).extension().is_some_and(|extension| extension == "mcap");
    let mcaps = files.iter().filter(is_mcap).map(|name| path.join(name));
    let opened: Vec<McapFile> = mcaps.take(SHOWN).filter_map(|path| McapFile::open(path).ok()).collect();
    if let Some(log) = opened.iter().find(|file| file.metadata().contains_key(LOG_RECORD)) {
        return format!("{what}; give the log in it: {}", log.path().display());
    }
    let topics = metadata.filter(|topics| topics != NONE);
    let topics = topics.or_else(|| opened.first().map(of_mcap));
    let held = topics.map_or(String::new(), |topics| format!("it holds {topics}; "));
    format!("{what}; {held}{}", imported(path))
}

/// Topics with types by the `metadata.yaml` of a bag's folder.
fn of_metadata(folder: &Path) -> Option<String> {
    let text = fs::read_to_string(folder.join("metadata.yaml")).ok()?;
    text.contains("rosbag2_bagfile_information").then(|| {
        let value = |line: &str, key: &str| {
            let value = line.trim().trim_start_matches("- ").strip_prefix(key)?.trim();
            Some(value.trim_matches(['"', '\'']).to_string())
        };
        let mut topics: Vec<(String, String)> = Vec::new();
        for line in text.lines() {
            if let Some(name) = value(line, "name:") {
                topics.push((name, String::new()));
            } else if let (Some(kind), Some((_, last))) = (value(line, "type:"), topics.last_mut())
                && last.is_empty()
            {
                *last = kind;
            }
        }
        list(topics)
    })
}

/// Topics with types of an MCAP file.
pub(crate) fn of_mcap(file: &McapFile) -> String {
    let channels = file.channels().values();
    list(
        channels
            .map(|channel| (channel.topic.clone(), channel.schema.clone()))
            .collect(),
    )
}

fn list(mut topics: Vec<(String, String)>) -> String {
    topics.sort();
    topics.dedup();
    if topics.is_empty() {
        return NONE.into();
    }
    let shown = topics.iter().take(SHOWN).map(|(topic, kind)| match kind.as_str() {
        "" => topic.clone(),
        kind => format!("{topic} ({kind})"),
    });
    let shown: Vec<String> = shown.collect();
    let more = topics.len().saturating_sub(SHOWN);
    match more {
        0 => shown.join(", "),
        _ => format!("{} and {more} more", shown.join(", ")),
    }
}

fn file_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str());
    name.to_string_lossy().into_owned()
}

fn rosbag1(path: &Path) -> String {
    let held = rosbag1_topics(path).unwrap_or_default();
    format!(
        "{}{}",
        match held.is_empty() {
            true => String::new(),
            false => format!("it holds {}; ", list(held)),
        },
        imported(path)
    )
}

/// Topics by the records of connections at the end of a bag of ROS 1; `None` of one that was not closed.
fn rosbag1_topics(path: &Path) -> Option<Vec<(String, String)>> {
    /// Longer heads and texts are not a bag's.
    const MOST: u32 = 1 << 20;
    const CONNECTION: u8 = 7;
    fn block(file: &mut impl Read) -> Option<Vec<u8>> {
        let mut length = [0; 4];
        file.read_exact(&mut length).ok()?;
        let length = u32::from_le_bytes(length);
        if length > MOST {
            return None;
        }
        let mut bytes = vec![0; length as usize];
        file.read_exact(&mut bytes).ok().map(|()| bytes)
    }
    fn field<'a>(mut head: &'a [u8], name: &str) -> Option<&'a [u8]> {
        while let Some((length, rest)) = head.split_first_chunk::<4>() {
            let field = rest.get(..u32::from_le_bytes(*length) as usize)?;
            head = &rest[field.len()..];
            let at = field.iter().position(|byte| *byte == b'=')?;
            if &field[..at] == name.as_bytes() {
                return Some(&field[at + 1..]);
            }
        }
        None
    }
    let mut file = io::BufReader::new(File::open(path).ok()?);
    // Behind the line "#ROSBAG V2.0".
    file.seek(SeekFrom::Start(13)).ok()?;
    let head = block(&mut file)?;
    let index = u64::from_le_bytes(field(&head, "index_pos")?.try_into().ok()?);
    file.seek(SeekFrom::Start(index)).ok()?;
    let mut topics = Vec::new();
    while let Some(head) = block(&mut file) {
        let data = block(&mut file)?;
        if field(&head, "op")? != [CONNECTION] {
            break;
        }
        let text = |bytes: Option<&[u8]>| Some(String::from_utf8_lossy(bytes?).into_owned());
        topics.push((text(field(&head, "topic"))?, text(field(&data, "type"))?));
    }
    Some(topics)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_others_are_named_with_what_helps() {
        let path = Path::new("a/b.mcap");
        for (head, expected) in [
            (
                &b"version https://git-lfs.github.com/spec/v1"[..],
                ["git-LFS", "git lfs pull --include b.mcap"],
            ),
            (b"\x28\xb5\x2f\xfd\x04", ["zstd", "`zstd -d a/b.mcap`"]),
            (b"\x1f\x8b\x08", ["gzip", "gunzip"]),
            (b"SQLite format 3\0", ["SQLite", "realo-lab import bag a/b.mcap"]),
            (b"#ROSBAG V2.0\n", ["ROS 1", "python/realo_log.py"]),
            (b"", ["empty", "copy"]),
            (b"hello", ["found [68, 65, 6c, 6c, 6f]", "docs/reference/log-format.md"]),
        ] {
            let found = not_mcap(path, head);
            assert!(expected.iter().all(|part| found.contains(part)), "{found}");
        }
    }

    #[test]
    fn the_folder_of_a_bag_is_named_with_its_topics() {
        let dir = tempfile::tempdir().unwrap();
        assert!(folder(dir.path()).contains("it is a folder; expected an MCAP file"));
        let text = "rosbag2_bagfile_information:\n  version: 5\n  topics_with_message_count:\n    - topic_metadata:\n        \
                    name: /points\n        type: sensor_msgs/msg/PointCloud2\n        serialization_format: cdr\n      \
                    message_count: 4\n    - topic_metadata: {}\n      name: \"/imu\"\n      type: 'sensor_msgs/msg/Imu'\n";
        fs::write(dir.path().join("metadata.yaml"), text).unwrap();
        for name in ["bag_0.mcap", "notes.txt", "bag_1.db3"] {
            fs::write(dir.path().join(name), b"").unwrap();
        }
        let found = folder(dir.path());
        for part in [
            "files: bag_0.mcap, bag_1.db3)",
            "/imu (sensor_msgs/msg/Imu), /points (sensor_msgs/msg/PointCloud2);",
            "realo-lab import bag",
            "docs/reference/log-format.md",
        ] {
            assert!(found.contains(part), "{found}");
        }
        let info = crate::LogInfo::new("a test", vec![]);
        crate::LogWriter::create(dir.path().join("log.mcap"), &info)
            .unwrap()
            .finish()
            .unwrap();
        let found = folder(dir.path());
        assert!(
            found.contains("give the log in it: ") && found.ends_with("log.mcap"),
            "{found}"
        );
        let sqlite = not_mcap(&dir.path().join("bag_1.db3"), b"SQLite format 3\0");
        assert!(sqlite.contains("it holds /imu"), "{sqlite}");
    }

    #[test]
    fn many_topics_are_cut_short() {
        let topics: Vec<_> = (10..30).map(|i| (format!("/t{i}"), "x".to_string())).collect();
        let found = list(topics);
        assert!(
            found.starts_with("/t10 (x), ") && found.ends_with("/t21 (x) and 8 more"),
            "{found}"
        );
    }
}

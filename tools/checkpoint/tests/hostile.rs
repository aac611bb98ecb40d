//! Checkpoints that somebody damaged, by accident or on purpose: an error that names the file, no panic, no more memory than
//! the file could have a use for.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use damage::{Draw, cases, most_held};
use realo_checkpoint::{Checkpoint, convert};
use realo_methods::Model;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

/// No file of these tests is longer than some tens of kilobytes.
const MOST: u64 = 4 << 20;

/// Opens and converts the bytes of a file within bounds; an error names the file.
fn read(bytes: &[u8], model: &Model) -> Result<(), String> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("net.pth");
    fs::write(&path, bytes).unwrap();
    let mut result = Ok(());
    let held = most_held(|| {
        result = Checkpoint::open(&path)
            .map_err(|error| error.to_string())
            .and_then(|mut checkpoint| convert(&mut checkpoint, model.clone()).map_err(|error| error.to_string()))
            .map(drop);
    });
    assert!(held <= MOST, "{held} bytes of memory for a file of {}", bytes.len());
    if let Err(said) = &result {
        assert!(said.contains("net.pth: "), "{said}");
        assert!(!said.chars().any(|c| c.is_control() && c != '\n'), "{said:?}");
    }
    result
}

/// An archive as torch.save writes it, with this pickle.
fn archive(pickle: &[u8], entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut zip = ZipWriter::new(&mut bytes);
    for (name, content) in [("data.pkl", pickle)].iter().chain(entries) {
        let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
        zip.start_file(format!("net/{name}"), options).unwrap();
        zip.write_all(content).unwrap();
    }
    zip.finish().unwrap();
    bytes.into_inner()
}

/// The pickle of an archive and its other entries.
fn taken_apart(name: &str) -> (Vec<u8>, Vec<(String, Vec<u8>)>) {
    let mut zip = zip::ZipArchive::new(fs::File::open(data(name)).unwrap()).unwrap();
    let mut entries: Vec<(String, Vec<u8>)> = (0..zip.len())
        .map(|index| {
            let mut entry = zip.by_index(index).unwrap();
            let name = entry.name().unwrap().split_once('/').unwrap().1.to_string();
            let mut bytes = Vec::new();
            std::io::copy(&mut entry, &mut bytes).unwrap();
            (name, bytes)
        })
        .collect();
    let at = entries.iter().position(|(name, _)| name == "data.pkl").unwrap();
    (entries.remove(at).1, entries)
}

#[test]
fn damaged_files_are_refused_or_give_weights() {
    let model = Model::read(&data("small-attfuse.toml")).unwrap();
    let mut draws = Draw::new(0xc0de);
    for name in ["nested.pth", "legacy.pth", "views.pth"] {
        let good = fs::read(data(name)).unwrap();
        let (mut accepted, mut refused) = (0, 0);
        for _ in 0..cases(600) {
            let mut bytes = good.clone();
            draws.damage(&mut bytes);
            match read(&bytes, &model) {
                Ok(()) => accepted += 1,
                Err(_) => refused += 1,
            }
        }
        assert!(refused > 200, "{name}: {accepted} accepted, {refused} refused");
    }
}

#[test]
fn damaged_pickles_in_sound_archives_are_refused_or_give_weights() {
    let model = Model::read(&data("small-attfuse.toml")).unwrap();
    let mut draws = Draw::new(0xbad);
    let (pickle, entries) = taken_apart("nested.pth");
    let entries: Vec<(&str, &[u8])> = entries.iter().map(|(name, bytes)| (&**name, &**bytes)).collect();
    read(&archive(&pickle, &entries), &model).unwrap();
    let (mut accepted, mut refused) = (0, 0);
    for _ in 0..cases(1500) {
        let mut bytes = pickle.clone();
        draws.damage(&mut bytes);
        match read(&archive(&bytes, &entries), &model) {
            Ok(()) => accepted += 1,
            Err(_) => refused += 1,
        }
    }
    assert!(accepted > 50 && refused > 500, "{accepted} accepted, {refused} refused");
}

#[test]
fn every_cut_file_is_refused() {
    let model = Model::read(&data("small-attfuse.toml")).unwrap();
    for name in ["plain.pth", "legacy.pth"] {
        let good = fs::read(data(name)).unwrap();
        for length in (0..good.len()).step_by(97) {
            assert!(read(&good[..length], &model).is_err(), "{name} of {length} bytes");
        }
    }
}

/// A text as a pickle has it.
fn text(text: &str) -> Vec<u8> {
    [&b"X"[..], &(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
}

/// A state dict of one tensor over a storage of `count` floats.
fn one(count: &[u8], offset: &[u8], sizes: &[u8], strides: &[u8]) -> Vec<u8> {
    [
        &b"\x80\x02}"[..],
        &text("w"),
        b"ctorch._utils\n_rebuild_tensor_v2\n((",
        &text("storage"),
        b"ctorch\nFloatStorage\n",
        &text("0"),
        &text("cpu"),
        count,
        b"tQ",
        offset,
        sizes,
        strides,
        b"\x89}tRs.",
    ]
    .concat()
}

#[test]
fn files_made_to_ask_for_much_or_to_lie_are_refused() {
    let model = Model::read(&data("small-attfuse.toml")).unwrap();
    let said = |pickle: &[u8]| read(&archive(pickle, &[("data/0", &[0; 16])]), &model).unwrap_err();
    // Sound, but of another network.
    assert!(said(&one(b"K\x04", b"K\x00", b"K\x02K\x02\x86", b"K\x02K\x01\x86")).contains("`w` is not part"));
    let long = |number: i64| [&b"\x8a\x08"[..], &number.to_le_bytes()].concat();
    let most = long(i64::MAX);
    let cases: [(Vec<u8>, &str); 14] = [
        (
            one(b"K\x04", b"K\x01", b"K\x04\x85", b"K\x01\x85"),
            "beyond a storage of 4",
        ),
        (
            one(b"K\x04", &long(-1), b"K\x04\x85", b"K\x01\x85"),
            "without storage, offset",
        ),
        (
            one(
                &most,
                b"K\x00",
                &[&most[..], &most, b"\x86"].concat(),
                b"K\x01K\x01\x86",
            ),
            "beyond",
        ),
        (
            one(b"K\x04", b"K\x00", &[&most[..], b"\x85"].concat(), b"K\x00\x85"),
            "more than once",
        ),
        (
            one(b"K\x04", b"K\x00", b"K\x01K\x02\x86", b"K\x01\x85"),
            "2 sizes and 1 strides",
        ),
        (one(b"X\xff\xff\xff\xff", b"", b"", b""), "longer than any name"),
        (
            b"\x80\x02".iter().chain(&b"(".repeat(2_000_000)).copied().collect(),
            "longer than",
        ),
        (
            [b"\x80\x02)".to_vec(), b"\x85".repeat(5_000), b".".to_vec()].concat(),
            "no dict",
        ),
        (b"\x80\x02]q\x00h\x00a.".to_vec(), "no dict"),
        (
            b"\x80\x02}q\x00X\x0a\x00\x00\x00state_dicth\x00s.".to_vec(),
            "no tensor",
        ),
        (b"\x80\x02cbuiltins\neval\n.".to_vec(), "`builtins.eval`"),
        (b"\x80\x02c\x1b[31m\nx\n.".to_vec(), "u{1b}"),
        (b"\x80\x02h\x07.".to_vec(), "not kept"),
        (b"\x80\x02i.".to_vec(), "0x69"),
    ];
    for (pickle, expected) in cases {
        // A long pickle is held as it is read, and little more.
        if pickle.len() < 100_000 {
            let said = said(&pickle);
            assert!(said.contains(expected), "{expected}: {said}");
        } else {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("net.pth");
            fs::write(&path, archive(&pickle, &[])).unwrap();
            let mut said = String::new();
            let held = most_held(|| said = Checkpoint::open(&path).err().expect("refused").to_string());
            assert!(said.contains(expected) && held < 100 << 20, "{held}: {said}");
        }
    }
}

#[test]
fn storages_must_be_as_long_as_they_say() {
    let model = Model::read(&data("small-attfuse.toml")).unwrap();
    let (pickle, entries) = taken_apart("plain.pth");
    for change in [0, 4, 8] {
        let changed: Vec<(&str, Vec<u8>)> = entries
            .iter()
            .map(|(name, bytes)| match (&**name, change) {
                ("data/3", 0) => ("data/3", [&bytes[..], &[0; 4]].concat()),
                ("data/3", cut) => ("data/3", bytes[cut..].to_vec()),
                (name, _) => (name, bytes.clone()),
            })
            .collect();
        let changed: Vec<(&str, &[u8])> = changed.iter().map(|(name, bytes)| (*name, &**bytes)).collect();
        let said = read(&archive(&pickle, &changed), &model).unwrap_err();
        assert!(said.contains("storage `") && said.contains("bytes"), "{said}");
    }
    let without: Vec<(&str, &[u8])> = entries
        .iter()
        .filter(|(name, _)| name != "data/3")
        .map(|(name, bytes)| (&**name, &**bytes))
        .collect();
    let said = read(&archive(&pickle, &without), &model).unwrap_err();
    assert!(said.contains("found none"), "{said}");
    let order = [("byteorder", &b"middle"[..])];
    let said = read(&archive(&pickle, &order), &model).unwrap_err();
    assert!(said.contains("lowest byte first"), "{said}");
}

#[test]
fn other_files_are_no_checkpoints() {
    let model = Model::read(&data("small-attfuse.toml")).unwrap();
    let empty_zip = archive(b"", &[]);
    let cases: [(&[u8], &str); 9] = [
        (b"", "torch.save"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"\n<!DOCTYPE html><html>", "a web page"),
        (b"\x40\0\0\0\0\0\0\0{\"a\":{\"dtype\":\"F32\"", "safetensors"),
        (b"PK\x03\x04", "damaged archive"),
        (b"{\"a\": 1}", "this is neither"),
        (b"\x80\x02}.", "this is neither"),
        (b"\x80\x04\x95", "this is neither"),
        (&empty_zip, "breaks off at byte 0"),
    ];
    for (bytes, expected) in cases {
        let said = read(bytes, &model).unwrap_err();
        assert!(said.contains(expected), "{said}");
    }
    assert!(Checkpoint::open(Path::new("nowhere.pth")).is_err());
}

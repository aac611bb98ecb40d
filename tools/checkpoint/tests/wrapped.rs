//! Checkpoints whose names stand behind what wrappers put before them, or with other things beside the weights.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use realo_checkpoint::{Checkpoint, Converted, convert};
use realo_methods::Model;
use realo_nn::weights::expected;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

fn model() -> Model {
    Model::read(&data("small-attfuse.toml")).unwrap()
}

/// A text as a pickle has it.
fn text(text: &str) -> Vec<u8> {
    [&b"X"[..], &(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
}

/// Converts the plain checkpoint with its pickle changed, or says why that failed; with the names that were left out.
fn changed(change: impl FnOnce(&[u8]) -> Vec<u8>) -> Result<(Converted, Vec<String>), String> {
    let mut zip = zip::ZipArchive::new(fs::File::open(data("plain.pth")).unwrap()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("net.pth");
    let mut out = ZipWriter::new(fs::File::create(&path).unwrap());
    let mut change = Some(change);
    for index in 0..zip.len() {
        let mut entry = zip.by_index(index).unwrap();
        let name = entry.name().unwrap().into_owned();
        let mut bytes = Vec::new();
        std::io::copy(&mut entry, &mut bytes).unwrap();
        if name.ends_with("data.pkl") {
            bytes = change.take().expect("one pickle")(&bytes);
        }
        let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
        out.start_file(name, options).unwrap();
        out.write_all(&bytes).unwrap();
    }
    out.finish().unwrap();
    let mut checkpoint = Checkpoint::open(&path).map_err(|error| error.to_string())?;
    let converted = convert(&mut checkpoint, model()).map_err(|error| error.to_string())?;
    let left_out = checkpoint.left_out().to_vec();
    Ok((converted, left_out))
}

/// Replaces the names of the tensors.
fn renamed(pickle: &[u8], rename: impl Fn(&str) -> String) -> Vec<u8> {
    let plain = Checkpoint::open(&data("plain.pth")).unwrap();
    let mut names: Vec<&str> = plain.tensors().map(|(name, ..)| name).collect();
    names.extend(plain.others().iter().map(String::as_str));
    let (mut out, mut at) = (Vec::new(), 0);
    while at < pickle.len() {
        match names.iter().find(|name| pickle[at..].starts_with(&text(name))) {
            Some(name) => {
                out.extend(text(&rename(name)));
                at += text(name).len();
            }
            None => {
                out.push(pickle[at]);
                at += 1;
            }
        }
    }
    assert_ne!(out, pickle, "names were found");
    out
}

fn assert_plain(converted: &Converted, what: &str) {
    let mut plain = Checkpoint::open(&data("plain.pth")).unwrap();
    let plain = convert(&mut plain, model()).ok().unwrap();
    for (key, _) in expected(&model()) {
        assert_eq!(
            converted.weights.tensor(&key),
            plain.weights.tensor(&key),
            "{what}: {key}"
        );
    }
}

#[test]
fn what_wrappers_put_before_all_names_is_taken_away() {
    for prefix in [
        "_orig_mod.",
        "module._orig_mod.",
        "_orig_mod.module.",
        "module.module.",
        "model.",
        "model._orig_mod.module.",
        "net.",
        "student.backbone_3d.",
    ] {
        let (converted, left_out) = changed(|pickle| renamed(pickle, |name| format!("{prefix}{name}")))
            .unwrap_or_else(|error| panic!("{prefix}: {error}"));
        assert_plain(&converted, prefix);
        assert!(left_out.is_empty(), "{prefix}: {left_out:?}");
    }
    // What was compiled may be a part of the network.
    let (converted, _) = changed(|pickle| {
        renamed(pickle, |name| match name.split_once('.') {
            Some((part, rest)) => format!("{part}._orig_mod.{rest}"),
            None => name.into(),
        })
    })
    .unwrap_or_else(|error| panic!("{error}"));
    assert_plain(&converted, "parts");
}

/// A dict that holds the plain state dict and what `beside` makes.
fn with_beside(pickle: &[u8], beside: &[u8]) -> Vec<u8> {
    let body = pickle.strip_prefix(b"\x80\x02").expect("protocol 2");
    let body = body.strip_suffix(b".").expect("it ends");
    [
        b"\x80\x02}",
        &text("state_dict")[..],
        body,
        b"s",
        &text("beside"),
        beside,
        b"s.",
    ]
    .concat()
}

#[test]
fn plain_data_beside_the_weights_is_skipped_and_never_run() {
    let namespace = [
        &b"cargparse\nNamespace\n)\x81}"[..],
        &text("lr"),
        &b"G\x3f\xb9\x99\x99\x99\x99\x99\x9a"[..],
        b"sb",
    ]
    .concat();
    let scalar = |module: &str| {
        [
            format!("c{module}.multiarray\nscalar\n").as_bytes(),
            b"cnumpy\ndtype\n",
            &text("f8"),
            b"K\x00K\x01\x87R(K\x03",
            &text("<"),
            b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb",
            b"c_codecs\nencode\n",
            &text("12345678"),
            &text("latin1"),
            b"\x86R\x86R",
        ]
        .concat()
    };
    let listed = [&b"]"[..], &scalar("numpy.core"), b"a"].concat();
    for (what, beside) in [
        ("Namespace", namespace),
        ("numpy 1", scalar("numpy.core")),
        ("numpy 2", scalar("numpy._core")),
        ("in a list", listed),
    ] {
        let (converted, _) =
            changed(|pickle| with_beside(pickle, &beside)).unwrap_or_else(|error| panic!("{what}: {error}"));
        assert_plain(&converted, what);
    }
    let run = [&b"cposix\nsystem\n"[..], &text("true"), b"\x85R"].concat();
    let error = changed(|pickle| with_beside(pickle, &run)).err().expect("refused");
    assert!(error.contains("posix.system"), "{error}");
}

#[test]
fn names_that_do_not_fit_are_listed() {
    let error = changed(|pickle| renamed(pickle, |name| format!("{name}_other")))
        .err()
        .expect("refused");
    assert!(error.contains("_other"), "{error}");
}

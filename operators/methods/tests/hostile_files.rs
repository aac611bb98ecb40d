//! Model files and weights that somebody damaged, by accident or on purpose: an error that names the file, no panic, and
//! never more memory than the file could have a use for. What is still accepted makes a network.

use std::collections::HashMap;
use std::path::Path;

use damage::{Draw, most_held};
use realo_kernels::conv::Isa;
use realo_methods::Model;
use realo_methods::network::{Network, NetworkOptions};
use realo_nn::layers::Layers;
use realo_nn::model::ModelFile;
use realo_nn::weights::Weights;
use safetensors::Dtype;
use safetensors::tensor::TensorView;

/// No file of these tests is longer than some tens of kilobytes.
const MOST: u64 = 8 << 20;

const MODEL: &str = r#"
name = "small"
frame = "body"
precision = "f32"
rotations = [0.0, 1.57]
score_threshold = 0.2
classes = [
  { name = "vehicle", length = 3.9, width = 1.6, height = 1.56, z = 0.78, matched = 0.6, unmatched = 0.45 },
  { name = "truck", length = 8.0, width = 3.0, height = 3.0, z = 1.5, matched = 0.6, unmatched = 0.45 },
]
grid = { x = [-6.4, 6.4], y = [-3.2, 3.2], z = [-3.0, 5.0], cell = 0.8 }
pillars = { channels = 4, points = 16, pillars = 80, empty_slots = false, intensity = false }
backbone = { layers = [1, 1], strides = [2, 2], channels = [4, 6], up_strides = [1, 2], up_channels = [4, 5] }
shrink = [{ kernel = 3, channels = 7 }]
arch = { kind = "pointpillars" }
"#;

/// What is put in place of a number, a word or some bytes.
const WORDS: [&str; 28] = [
    "0",
    "-1",
    "1",
    "2",
    "3",
    "16",
    "4096",
    "4097",
    "65536",
    "16777216",
    "4294967296",
    "9223372036854775807",
    "18446744073709551616",
    "1e308",
    "-1e308",
    "1e-308",
    "5e-324",
    "nan",
    "inf",
    "-inf",
    "true",
    "\"\"",
    "[]",
    "{}",
    "[[[[[[[[",
    "{{{{{{{{",
    "\u{0}",
    "F64",
];

/// Some changes of a file.
fn damage(bytes: &[u8], draws: &mut Draw) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    // Every other file is changed in one place only.
    for _ in 0..1 + draws.below(2) * draws.below(4) {
        let (at, other) = (draws.below(bytes.len()), draws.below(bytes.len()));
        let word = WORDS[draws.below(WORDS.len())].bytes();
        match draws.below(10) {
            0 => bytes[at] ^= 1 << draws.below(8),
            1 => bytes[at] = draws.below(256) as u8,
            2 => bytes.truncate(at.max(1)),
            3 => {
                bytes.splice(at..at, word);
            }
            4 => {
                let end = at + draws.below(bytes.len() - at).min(64);
                bytes.drain(at..end);
            }
            7 => {
                let piece = bytes[at.min(other)..at.max(other)]
                    .iter()
                    .copied()
                    .take(64)
                    .collect::<Vec<u8>>();
                bytes.splice(at..at, piece);
            }
            5 | 6 => {
                let digit = (at..bytes.len()).find(|i| bytes[*i].is_ascii_digit());
                digit.into_iter().for_each(|i| bytes[i] = b'0' + draws.below(10) as u8);
            }
            // A whole number or word, so that the rest of the file stays what it is.
            _ => {
                let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || b"-._".contains(byte);
                let Some(begin) = (at..bytes.len()).find(|i| is_part(&bytes[*i])) else {
                    continue;
                };
                let begin = (0..begin).rev().find(|i| !is_part(&bytes[*i])).map_or(0, |i| i + 1);
                let end = (begin..bytes.len())
                    .find(|i| !is_part(&bytes[*i]))
                    .unwrap_or(bytes.len());
                bytes.splice(begin..end.min(begin + 64), word);
            }
        }
        if bytes.is_empty() {
            return bytes;
        }
    }
    bytes
}

fn model() -> Model {
    Model::parse(MODEL.as_bytes(), Path::new("small.toml")).unwrap()
}

/// The weights of a model, all the same number.
fn weights_of(model: &Model) -> Vec<u8> {
    let tensors: Vec<(String, Vec<usize>, Vec<u8>)> = Layers::of(model)
        .tensors()
        .map(|spec| {
            (
                spec.key.clone(),
                spec.shape.clone(),
                0.25f32.to_le_bytes().repeat(spec.count()),
            )
        })
        .collect();
    let views = tensors.iter().map(|(key, shape, data)| {
        let view = TensorView::new(Dtype::F32, shape.clone(), data).unwrap();
        (key.as_str(), view)
    });
    safetensors::serialize(views.collect::<HashMap<_, _>>(), None).unwrap()
}

/// What a test counts, so that a mutator that only breaks or only keeps files is noticed.
#[derive(Default)]
struct Seen {
    accepted: usize,
    refused: usize,
}

/// Runs a case; what it holds of memory must stay within bounds.
fn watched<T>(case: usize, run: impl FnOnce() -> T) -> T {
    let mut result = None;
    let held = most_held(|| result = Some(run()));
    assert!(held <= MOST, "case {case} takes {held} bytes");
    result.expect("the case has run")
}

fn build(model: &Model, weights: &Weights) {
    let options = NetworkOptions {
        isa: Isa::Portable,
        precision: None,
        threads: 1,
    };
    Network::new(model, weights, options).expect("a network of a model and weights that were accepted");
}

/// A file of weights.
fn of(stem: &str, bytes: &[u8]) -> [ModelFile; 1] {
    [(format!("{stem}.safetensors").into(), bytes.to_vec())]
}

#[test]
fn damaged_files_are_refused_or_make_a_network() {
    let (model, good) = (model(), weights_of(&model()));
    let fitting = Weights::parse(&of("small", &good), &model).unwrap();
    build(&model, &fitting);

    let mut draws = Draw::new(0x5eed);
    let mut seen = Seen::default();
    for case in 0..12_000 {
        let text = damage(MODEL.as_bytes(), &mut draws);
        match watched(case, || Model::parse(&text, Path::new("small.toml"))) {
            Ok(changed) => {
                seen.accepted += 1;
                let layers = watched(case, || Layers::of(&changed));
                assert!(
                    layers.numbers() <= 1 << 28,
                    "case {case}: maps of {} numbers",
                    layers.numbers()
                );
                // Weights of another model do not fit it, those of this one do.
                match watched(case, || Weights::parse(&of("small", &good), &changed)) {
                    Ok(weights) => watched(case, || build(&changed, &weights)),
                    Err(error) => assert!(error.to_string().starts_with("small.safetensors: "), "{error}"),
                }
            }
            Err(error) => {
                seen.refused += 1;
                assert!(error.to_string().starts_with("small.toml: "), "case {case}: {error}");
            }
        }
    }
    assert!(
        seen.accepted > 1000 && seen.refused > 5000,
        "{} {}",
        seen.accepted,
        seen.refused
    );

    // The header, where everything is decided, is damaged more often than the numbers.
    let header = 8 + u64::from_le_bytes(good[..8].try_into().unwrap()) as usize;
    let mut seen = Seen::default();
    for case in 0..12_000 {
        let bytes = match case % 4 {
            0 => damage(&good, &mut draws),
            1 => [damage(&good[..header], &mut draws), good[header..].to_vec()].concat(),
            // The header's length stays right, so that its text is looked at.
            _ => {
                let text = damage(&good[8..header], &mut draws);
                [
                    (text.len() as u64).to_le_bytes().to_vec(),
                    text,
                    good[header..].to_vec(),
                ]
                .concat()
            }
        };
        match watched(case, || Weights::parse(&of("small", &bytes), &model)) {
            Ok(weights) => {
                seen.accepted += 1;
                build(&model, &weights);
            }
            Err(error) => {
                seen.refused += 1;
                assert!(
                    error.to_string().starts_with("small.safetensors: "),
                    "case {case}: {error}"
                );
            }
        }
    }
    assert!(
        seen.accepted > 500 && seen.refused > 5000,
        "{} {}",
        seen.accepted,
        seen.refused
    );
}

#[test]
fn files_made_to_ask_for_much_are_refused() {
    let model = model();
    let weights = |header: &str, data: usize| {
        let length = (header.len() as u64).to_le_bytes();
        [&length[..], header.as_bytes(), &vec![0; data]].concat()
    };
    let huge = |shape: &str| format!(r#"{{"cls_head.bias":{{"dtype":"F32","shape":{shape},"data_offsets":[0,16]}}}}"#);
    let headers = [
        huge("[4611686018427387904]"),
        huge("[4294967296,4294967296,4294967296]"),
        huge("[0,18446744073709551615,18446744073709551615]"),
        huge("[-1]"),
        format!("{}1{}", "[".repeat(100_000), "]".repeat(100_000)),
        "{}".into(),
    ];
    for header in headers {
        let error = Weights::parse(&of("w", &weights(&header, 16)), &model).unwrap_err();
        assert!(error.to_string().starts_with("w.safetensors: "), "{error}");
    }
    for length in [0u64, 1 << 40, u64::MAX] {
        assert!(Weights::parse(&of("w", &length.to_le_bytes()), &model).is_err());
    }
    let deep = format!("name = {}", "[".repeat(200_000));
    assert!(Model::parse(deep.as_bytes(), Path::new("m.toml")).is_err());
    for (from, to) in [
        ("cell = 0.8", "cell = 1e-9"),
        ("cell = 0.8", "cell = 5e-324"),
        ("x = [-6.4, 6.4]", "x = [-1.7e308, 1.7e308]"),
        ("channels = 4,", "channels = 9223372036854775807,"),
        ("pillars = 80", "pillars = 9223372036854775807"),
        ("layers = [1, 1]", "layers = [64, 9223372036854775807]"),
        ("up_strides = [1, 2]", "up_strides = [0, 2]"),
        ("strides = [2, 2], channels", "strides = [0, 0], channels"),
    ] {
        let text = MODEL.replace(from, to);
        assert_ne!(text, MODEL, "{from}");
        let error = Model::parse(text.as_bytes(), Path::new("m.toml"))
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("m.toml: "), "{error}");
    }
}

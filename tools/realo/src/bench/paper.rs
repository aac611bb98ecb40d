//! The paper's tables of its transmission, with what is found here beside them.

use std::fmt;

use eyre::Result;
use realo_schemas::{Box3, Boxes, Elements, Header, Kind, Message, Pose};
use realo_transmission::{BoxesLayout, EncoderConfig};
use serde::Serialize;

use super::transmission::{Crossed, Way, cross};

/// Rate at which the paper's points crossed its Wi-Fi, 3.7 MB in 144.2 ms, bit/s: messages of here are reported at the same.
const RATE: f64 = 205e6;
/// Boxes of a sweep.
const BOXES: usize = 50;

/// The paper's compression of feature maps: rate, KB, ms.
const COMPRESSION: [(&str, f64, f64); 4] = [
    ("not compressed", 25_000.0, 511.2),
    ("8 times", 3_100.0, 97.0),
    ("32 times", 840.0, 41.7),
    ("64 times", 391.1, 14.3),
];

/// The paper's transmission module: step, ms of encoder and decoder, and the steps of here that do the same.
const MODULE: [(&str, f64, f64, &[&str]); 4] = [
    ("compression (a network)", 0.13, 0.27, &[]),
    ("device transfer", 19.19, 0.43, &[]),
    (
        "serialisation",
        0.26,
        0.07,
        &[
            "selection",
            "quantisation",
            "shuffling",
            "compression",
            "serialisation",
            "deserialisation",
            "decompression",
            "unshuffling",
            "dequantisation",
        ],
    ),
    ("packaging, parsing", 0.01, 0.01, &["packaging", "parsing"]),
];

/// The paper's messages: kind, KB, ms over its Wi-Fi.
const MESSAGES: [(Kind, f64, f64); 3] = [
    (Kind::Boxes, 3.63, 10.0),
    (Kind::Points, 3_700.0, 144.2),
    (Kind::Features, 840.0, 41.7),
];

/// A message of here.
#[derive(Serialize)]
pub struct Sent {
    kind: Kind,
    name: String,
    bytes: usize,
    encode: Way,
    decode: Way,
}

/// What stands beside the paper's tables.
#[derive(Serialize)]
pub struct Tables {
    sent: Vec<Sent>,
}

/// Has a sweep, its map with the confidence of its cells, and boxes cross.
pub fn tables(sweep: &Message, map: &Message) -> Result<Tables> {
    let usual = EncoderConfig::default;
    let budget = |bytes: usize| EncoderConfig {
        budget_bytes: Some(bytes),
        ..usual()
    };
    let exact = EncoderConfig {
        elements: Elements::F32,
        shuffle: false,
        zstd: None,
        ..usual()
    };
    let steps = EncoderConfig {
        step_m: 0.01,
        ..usual()
    };
    let cpm = EncoderConfig {
        boxes: BoxesLayout::Cpm,
        max_objects: BOXES,
        ..usual()
    };
    let boxes = boxes();
    let all = [
        (map, "f32, all cells", exact),
        (map, "int8, all cells", usual()),
        (map, "int8, cells in 60,000 bytes", budget(60_000)),
        (map, "int8, cells in 8,000 bytes", budget(8_000)),
        (&boxes, "50 boxes", usual()),
        (&boxes, "50 boxes, a CPM", cpm),
        (sweep, "exact", usual()),
        (sweep, "steps of 1 cm", steps),
    ];
    let sent = all.into_iter().map(|(message, name, config)| {
        let Crossed {
            bytes, encode, decode, ..
        } = cross(message, &config)?;
        Ok(Sent {
            kind: message.header.kind,
            name: name.into(),
            bytes,
            encode,
            decode,
        })
    });
    Ok(Tables {
        sent: sent.collect::<Result<_>>()?,
    })
}

/// Cars around a vehicle.
fn boxes() -> Message {
    let place = |n: usize, far: f64| far * (n as f64 * 2.4).cos();
    let car = |n: usize| Box3 {
        center: [place(n, 60.0), place(n + 1, 30.0), 0.8],
        length: 4.5,
        width: 1.8,
        height: 1.6,
        yaw: place(n, 3.0),
        velocity: Some([place(n, 8.0), 0.0, 0.0]),
        class: "vehicle".into(),
        score: 0.9,
        track: None,
        covariance: None,
    };
    // After 2004, where the time of CPMs begins.
    let stamp = 1_700_000_000_000_000_000;
    let header = Header {
        pose: Some(Pose {
            map_from_frame: Default::default(),
            covariance: None,
        }),
        ..Header::origin(&"bench".into(), &"cav1".into(), Kind::Boxes, 0, stamp, stamp)
    };
    Message::new(header, Boxes((0..BOXES).map(car).collect()))
}

impl Sent {
    /// From its content to its content, at the paper's rate, ms.
    fn latency(&self) -> f64 {
        self.encode.median_ms + 8e3 * self.bytes as f64 / RATE + self.decode.median_ms
    }

    fn line(&self) -> String {
        format!(
            "{:<30}{:>10.1}{:>9.1}",
            self.name,
            self.bytes as f64 / 1e3,
            self.latency()
        )
    }
}

impl fmt::Display for Tables {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let of = |kind: Kind| self.sent.iter().filter(move |sent| sent.kind == kind);
        writeln!(
            f,
            "\nBeside the paper's tables. Its times are over its Wi-Fi; those of here are encoding, bytes at {:.0} Mbit/s, the rate of its points, and decoding",
            RATE / 1e6
        )?;
        writeln!(
            f,
            "\n{:<26}{:>10}{:>9}   {:<30}{:>10}{:>9}",
            "compression: the paper", "KB", "ms", "here", "KB", "ms"
        )?;
        let here: Vec<String> = of(Kind::Features).map(Sent::line).collect();
        for (n, (name, kilobytes, ms)) in COMPRESSION.iter().enumerate() {
            let here = here.get(n).map_or("", |line| line);
            writeln!(f, "{name:<26}{kilobytes:>10.1}{ms:>9.1}   {here}")?;
        }
        writeln!(
            f,
            "\n{:<26}{:>14}{:>14}   encoder and decoder here, ms",
            "transmission module", "encoder, ms", "decoder, ms"
        )?;
        for (name, encoder, decoder, steps) in MODULE {
            write!(f, "{name:<26}{encoder:>14.2}{decoder:>14.2}   ")?;
            let all: Vec<String> = of(Kind::Features)
                .skip(1)
                .take(2)
                .map(|sent| {
                    let took = |way: &Way| match steps {
                        [] => "–".into(),
                        _ => format!("{:.2}", way.sum(steps)),
                    };
                    format!("{} / {} ({})", took(&sent.encode), took(&sent.decode), sent.name)
                })
                .collect();
            writeln!(f, "{}", all.join(", "))?;
        }
        writeln!(
            f,
            "\n{:<26}{:>10}{:>9}   {:<30}{:>10}{:>9}",
            "messages: the paper", "KB", "ms", "here", "KB", "ms"
        )?;
        for (kind, kilobytes, ms) in MESSAGES {
            let mut first = format!("{:<26}{kilobytes:>10.2}{ms:>9.1}", kind.to_string());
            for sent in of(kind) {
                writeln!(f, "{first:<45}   {}", sent.line())?;
                first.clear();
            }
        }
        Ok(())
    }
}

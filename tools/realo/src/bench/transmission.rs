use std::fmt;

use eyre::{Result, bail, eyre};
use realo_host::running_time;
use realo_operator::{Operator, Outputs, PortId, Steps};
use realo_pillar_encoder::PillarEncoder;
use realo_schemas::{Elements, FeatureMap, Header, Kind, Message, Nanos, Payload};
use realo_transmission::{Decoder, Encoder, EncoderConfig};
use serde::Serialize;

use super::detector::{MODEL, cloud, spread};

const ROUNDS: usize = 41;
/// Greatest map that is taken, bytes.
const LIMIT: usize = 64 << 20;

/// What it takes to put the BEV map of a sweep into bytes and to get it out again, step by step.
#[derive(Serialize)]
pub struct Transmission {
    /// Rows, columns, channels.
    shape: [u32; 3],
    /// From the sweep to its map, median, ms.
    encoder_ms: f64,
    /// There is none on a CPU.
    device_copy_ms: Option<f64>,
    codings: Vec<Coding>,
}

#[derive(Serialize)]
struct Coding {
    elements: Elements,
    shuffle: bool,
    zstd: Option<i32>,
    bytes: usize,
    /// Greatest difference of a number that crossed.
    greatest_error: f32,
    encode: Way,
    decode: Way,
}

#[derive(Default, Serialize)]
struct Way {
    /// In the order in which they are done.
    steps: Vec<Step>,
    /// Least and median of the whole way.
    minimum_ms: f64,
    median_ms: f64,
}

#[derive(Serialize)]
struct Step {
    name: &'static str,
    median_ms: f64,
}

/// Times the transmission of the map of a simulated sweep in all elements.
pub fn bench() -> Result<Transmission> {
    let (sweep, mut encoder) = (sweep()?, pillar_encoder()?);
    let mut times = Vec::new();
    let mut sent = None;
    for _ in 0..ROUNDS {
        let begun = running_time();
        sent = Some(map_of(&mut encoder, sweep.clone())?);
        times.push((running_time() - begun) as f64 / 1e6);
    }
    let sent = sent.ok_or_else(|| eyre!("no round"))?;
    let map = feature_map(&sent)?;
    let codings = [
        (Elements::F32, false, None),
        (Elements::F32, true, Some(1)),
        (Elements::F16, false, None),
        (Elements::F16, true, Some(1)),
        (Elements::Int8, false, None),
        (Elements::Int8, false, Some(1)),
        (Elements::Int8, true, Some(1)),
    ];
    let codings = codings.map(|(elements, shuffle, zstd)| {
        let config = EncoderConfig {
            elements,
            shuffle,
            zstd,
            ..EncoderConfig::default()
        };
        coding(&sent, &config)
    });
    Ok(Transmission {
        shape: [map.rows, map.columns, map.channels],
        encoder_ms: spread(&times).1,
        device_copy_ms: None,
        codings: codings.into_iter().collect::<Result<_>>()?,
    })
}

fn sweep() -> Result<Message> {
    let header = Header::origin(&"bench".into(), &"cav1".into(), Kind::Points, 0, 0, 0);
    Ok(Message::new(header, cloud()?))
}

fn pillar_encoder() -> Result<PillarEncoder> {
    let config = realo_pillar_encoder::Config {
        model: MODEL.into(),
        ..realo_pillar_encoder::Config::default()
    };
    PillarEncoder::new(config).map_err(|error| eyre!("{error}"))
}

fn map_of(encoder: &mut PillarEncoder, sweep: Message) -> Result<Message> {
    let mut out = Outputs::at(0);
    let taken = encoder.on_input(PortId(0), sweep, &mut out);
    taken.map_err(|error| eyre!("{error}"))?;
    let (_, map) = out.take_sent().pop().ok_or_else(|| eyre!("the encoder sent nothing"))?;
    Ok(map)
}

fn feature_map(message: &Message) -> Result<&FeatureMap> {
    match &message.payload {
        Payload::FeatureMap(map) => Ok(map),
        other => bail!("expected a FeatureMap, found a {}", other.payload_type()),
    }
}

fn coding(sent: &Message, config: &EncoderConfig) -> Result<Coding> {
    let (mut encoder, mut decoder) = (Encoder::new(config)?, Decoder::new(LIMIT)?);
    let (mut encode, mut decode) = (Rounds::default(), Rounds::default());
    let (mut bytes, mut greatest_error) = (0, 0.0);
    for round in 0..ROUNDS {
        let packet = encode.time(|steps| encoder.encode(sent, steps))?.0;
        let content = decode.time(|steps| decoder.decode(&packet.bytes, steps))?;
        if round == 0 {
            bytes = packet.bytes.len();
            let found = content.into_message(sent.header.clone(), &packet.codec)?;
            greatest_error = difference(feature_map(sent)?, feature_map(&found)?)?;
        }
    }
    Ok(Coding {
        elements: config.elements,
        shuffle: config.shuffle,
        zstd: config.zstd,
        bytes,
        greatest_error,
        encode: encode.way(),
        decode: decode.way(),
    })
}

fn difference(sent: &FeatureMap, found: &FeatureMap) -> Result<f32> {
    let (Ok(sent), Ok(found)) = (sent.numbers(), found.numbers()) else {
        bail!("expected maps of f32");
    };
    let differences = sent.iter().zip(&*found).map(|(sent, found)| (sent - found).abs());
    Ok(differences.fold(0.0, f32::max))
}

/// What each round took.
#[derive(Default)]
struct Rounds {
    whole: Vec<f64>,
    steps: Vec<(&'static str, Vec<f64>)>,
}

impl Rounds {
    fn time<T>(&mut self, work: impl FnOnce(&mut Steps) -> T) -> T {
        let millis = |nanos: Nanos| nanos as f64 / 1e6;
        let mut steps = Steps::timed_by(running_time);
        let begun = running_time();
        let done = work(&mut steps);
        self.whole.push(millis(running_time() - begun));
        for (step, took) in steps.take() {
            match self.steps.iter_mut().find(|(known, _)| *known == step) {
                Some((_, times)) => times.push(millis(took)),
                None => self.steps.push((step, vec![millis(took)])),
            }
        }
        done
    }

    fn way(self) -> Way {
        let (minimum_ms, median_ms) = spread(&self.whole);
        let steps = self.steps.into_iter();
        let steps = steps.map(|(name, times)| Step {
            name,
            median_ms: spread(&times).1,
        });
        Way {
            steps: steps.collect(),
            minimum_ms,
            median_ms,
        }
    }
}

impl Coding {
    fn name(&self) -> String {
        let elements = format!("{:?}", self.elements).to_lowercase();
        let shuffle = if self.shuffle { " shuffle" } else { "" };
        let zstd = self.zstd.map(|level| format!(" zstd={level}"));
        format!("{elements}{shuffle}{}", zstd.unwrap_or_default())
    }
}

const ENCODING: [&str; 5] = ["quantisation", "shuffling", "compression", "serialisation", "packaging"];
const DECODING: [&str; 5] = [
    "parsing",
    "deserialisation",
    "decompression",
    "unshuffling",
    "dequantisation",
];

impl fmt::Display for Transmission {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let [rows, columns, channels] = self.shape;
        writeln!(
            f,
            "{MODEL}, map of {rows} × {columns} × {channels} from a simulated sweep in {:.1} ms; medians, ms; no device copy on a CPU",
            self.encoder_ms
        )?;
        for (title, names, way) in [
            ("encoder", ENCODING, (|coding| &coding.encode) as fn(&Coding) -> &Way),
            ("decoder", DECODING, |coding| &coding.decode),
        ] {
            write!(f, "\n{title:<20}")?;
            names.iter().try_for_each(|name| write!(f, "{name:>17}"))?;
            writeln!(f, "{:>9}{:>9}{:>12}{:>14}", "all", "least", "bytes", "largest error")?;
            for coding in &self.codings {
                let way = way(coding);
                write!(f, "{:<20}", coding.name())?;
                for name in names {
                    match way.steps.iter().find(|step| step.name == name) {
                        Some(step) => write!(f, "{:>17.3}", step.median_ms)?,
                        None => write!(f, "{:>17}", "–")?,
                    }
                }
                let (all, least) = (way.median_ms, way.minimum_ms);
                writeln!(
                    f,
                    "{all:>9.2}{least:>9.2}{:>12}{:>14.4}",
                    coding.bytes, coding.greatest_error
                )?;
            }
        }
        Ok(())
    }
}

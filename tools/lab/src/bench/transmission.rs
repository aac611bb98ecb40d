use std::fmt;

use eyre::{Result, bail, eyre};
use realo_cli::Progress;
use realo_clock::steady;
use realo_operator::{Operator, Outputs, PortId, Steps};
use realo_pillar_encoder::PillarEncoder;
use realo_radio::keys::Own;
use realo_radio::seal::Seal;
use realo_radio::station::Topic;
use realo_schemas::{Elements, FeatureMap, Header, Kind, Message, Nanos, Payload, PointCloud};
use realo_simulator::{Options, Simulation};
use realo_transmission::{Decoder, Encoder, EncoderSettings};
use serde::Serialize;

use super::detector::{MODEL, cloud, spread};
use super::paper::{self, Tables};

const ROUNDS: usize = 41;
/// Largest map that is taken, bytes.
const LIMIT: usize = 64 << 20;

/// Bytes of a point before it crosses, by which rates are counted: x, y, z and intensity in f32.
const POINT: usize = 16;

/// What it takes to put a sweep and its BEV map into bytes and to get them out again, step by step.
#[derive(Serialize)]
pub struct Transmission {
    /// Rows, columns, channels.
    shape: [u32; 3],
    /// From the sweep to its map, median, ms.
    encoder_ms: f64,
    /// There is none on a CPU.
    device_copy_ms: Option<f64>,
    codings: Vec<Coding>,
    /// Points of the sweep that crosses by itself.
    points: usize,
    clouds: Vec<CloudCoding>,
    /// Of a part of 16,384 bytes.
    seal: SealCost,
    paper: Tables,
}

/// What the signature of a frame costs.
#[derive(Serialize)]
struct SealCost {
    sign_ms: f64,
    check_ms: f64,
}

#[derive(Serialize)]
struct CloudCoding {
    step_m: f64,
    zstd: Option<i32>,
    bytes: usize,
    /// Largest difference of a coordinate that crossed, m.
    max_error: f32,
    encode: Way,
    decode: Way,
}

#[derive(Serialize)]
struct Coding {
    elements: Elements,
    shuffle: bool,
    zstd: Option<i32>,
    bytes: usize,
    /// Largest difference of a number that crossed.
    max_error: f32,
    encode: Way,
    decode: Way,
}

#[derive(Default, Serialize)]
pub(super) struct Way {
    /// In the order in which they are done.
    steps: Vec<Step>,
    /// Smallest and median of the whole way.
    pub(super) minimum_ms: f64,
    pub(super) median_ms: f64,
}

#[derive(Serialize)]
struct Step {
    name: &'static str,
    median_ms: f64,
}

/// Times the transmission of a simulated sweep, exactly and in whole steps, and of its map in all elements.
pub fn bench(progress: &Progress) -> Result<Transmission> {
    let (sweep, mut encoder) = (sweep()?, pillar_encoder(false)?);
    let mut times = Vec::new();
    let mut sent = None;
    for _ in 0..ROUNDS {
        let begun = steady();
        sent = Some(map_of(&mut encoder, sweep.clone())?);
        times.push((steady() - begun) as f64 / 1e6);
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
    let clouds = [(0.0, None), (0.01, None), (0.01, Some(1)), (0.001, Some(1))];
    progress.count("codings", (codings.len() + clouds.len()) as f64);
    let codings = codings.map(|(elements, shuffle, zstd)| {
        progress.add(1.0);
        let config = EncoderSettings {
            elements,
            shuffle,
            zstd,
            ..EncoderSettings::default()
        };
        coding(&sent, &config)
    });
    let cloud = whole_sweep()?;
    let sure = map_of(&mut pillar_encoder(true)?, sweep)?;
    let clouds = clouds.map(|(step_m, zstd)| {
        progress.add(1.0);
        cloud_coding(&cloud, step_m, zstd)
    });
    Ok(Transmission {
        shape: [map.rows, map.columns, map.channels],
        encoder_ms: spread(&times).1,
        device_copy_ms: None,
        codings: codings.into_iter().collect::<Result<_>>()?,
        points: point_cloud(&cloud)?.len(),
        clouds: clouds.into_iter().collect::<Result<_>>()?,
        seal: seal()?,
        paper: paper::tables(&cloud, &sure)?,
    })
}

fn seal() -> Result<SealCost> {
    let own = Own::new("cav1")?;
    let trusted = own.public();
    let seal = Seal::new("bench", own, trusted);
    let (part, name) = (vec![7; 16_384], "cav1".into());
    let (mut sign, mut check) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let begun = steady();
        let sealed = seal.close("cav1", Topic::Bulk, &part, 0);
        sign.push((steady() - begun) as f64 / 1e6);
        let begun = steady();
        let opened = seal.open(&name, Topic::Bulk, &sealed, 0);
        check.push((steady() - begun) as f64 / 1e6);
        if opened.is_err() {
            bail!("a frame that was just signed is refused");
        }
    }
    Ok(SealCost {
        sign_ms: spread(&sign).1,
        check_ms: spread(&check).1,
    })
}

/// All points of a simulated sweep, in the order in which the sensor fires.
fn whole_sweep() -> Result<Message> {
    let options = Options {
        seed: 900,
        seconds: 0.1,
        agents: vec!["cav1".into()],
        ..Options::default()
    };
    let (sweep, _) = Simulation::new(&options)?.sweep(0, 0);
    let header = Header::origin(&"bench".into(), &"cav1".into(), Kind::Points, 0, 0, 0);
    Ok(Message::new(header, sweep.cloud.clone()))
}

fn sweep() -> Result<Message> {
    let header = Header::origin(&"bench".into(), &"cav1".into(), Kind::Points, 0, 0, 0);
    Ok(Message::new(header, cloud()?))
}

fn pillar_encoder(confidence: bool) -> Result<PillarEncoder> {
    let config = realo_pillar_encoder::Settings {
        confidence,
        model: MODEL.into(),
        ..realo_pillar_encoder::Settings::default()
    };
    PillarEncoder::new(config).map_err(|error| eyre!("{error}"))
}

fn map_of(encoder: &mut PillarEncoder, sweep: Message) -> Result<Message> {
    let mut out = Outputs::at(0);
    let taken = encoder.on_message(PortId(0), sweep, &mut out);
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

fn point_cloud(message: &Message) -> Result<&PointCloud> {
    match &message.payload {
        Payload::PointCloud(cloud) => Ok(cloud),
        other => bail!("expected a PointCloud, found a {}", other.payload_type()),
    }
}

/// What came of a message that crossed.
pub(super) struct Crossed {
    pub(super) bytes: usize,
    found: Message,
    pub(super) encode: Way,
    pub(super) decode: Way,
}

/// Has a message cross, often enough to tell what that takes.
pub(super) fn cross(sent: &Message, config: &EncoderSettings) -> Result<Crossed> {
    let (mut encoder, mut decoder) = (Encoder::new(config)?, Decoder::new(LIMIT)?);
    let (mut encode, mut decode) = (Rounds::default(), Rounds::default());
    let mut crossed = None;
    for _ in 0..ROUNDS {
        let packet = encode.time(|steps| encoder.encode(sent, steps))?.0;
        let header = sent.header.clone();
        let (found, _) = decode.time(|steps| decoder.message(header, &packet, steps))?;
        crossed.get_or_insert((packet.bytes.len(), found));
    }
    let (bytes, found) = crossed.ok_or_else(|| eyre!("no round"))?;
    Ok(Crossed {
        bytes,
        found,
        encode: encode.way(),
        decode: decode.way(),
    })
}

fn coding(sent: &Message, config: &EncoderSettings) -> Result<Coding> {
    let crossed = cross(sent, config)?;
    Ok(Coding {
        elements: config.elements,
        shuffle: config.shuffle,
        zstd: config.zstd,
        bytes: crossed.bytes,
        max_error: difference(feature_map(sent)?, feature_map(&crossed.found)?)?,
        encode: crossed.encode,
        decode: crossed.decode,
    })
}

fn cloud_coding(sent: &Message, step_m: f64, zstd: Option<i32>) -> Result<CloudCoding> {
    let config = EncoderSettings {
        step_m,
        zstd,
        ..EncoderSettings::default()
    };
    let crossed = cross(sent, &config)?;
    let (sent, found) = (point_cloud(sent)?, point_cloud(&crossed.found)?);
    let columns = [(&sent.x, &found.x), (&sent.y, &found.y), (&sent.z, &found.z)];
    let errors = columns.map(|(sent, found)| max_difference(sent, found));
    Ok(CloudCoding {
        step_m,
        zstd,
        bytes: crossed.bytes,
        max_error: errors.into_iter().fold(0.0, f32::max),
        encode: crossed.encode,
        decode: crossed.decode,
    })
}

fn difference(sent: &FeatureMap, found: &FeatureMap) -> Result<f32> {
    let (Ok(sent), Ok(found)) = (sent.numbers(), found.numbers()) else {
        bail!("expected maps of f32");
    };
    Ok(max_difference(&sent, &found))
}

fn max_difference(sent: &[f32], found: &[f32]) -> f32 {
    let differences = sent.iter().zip(found).map(|(sent, found)| (sent - found).abs());
    differences.fold(0.0, f32::max)
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
        let mut steps = Steps::timed_by(steady);
        let begun = steady();
        let done = work(&mut steps);
        self.whole.push(millis(steady() - begun));
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

impl Way {
    /// What these steps take together, ms.
    pub(super) fn sum(&self, steps: &[&str]) -> f64 {
        let of = self.steps.iter().filter(|step| steps.contains(&step.name));
        of.map(|step| step.median_ms).sum()
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

impl CloudCoding {
    fn name(&self) -> String {
        let zstd = self.zstd.map(|level| format!(" zstd={level}")).unwrap_or_default();
        match self.step_m {
            0.0 => "exact".into(),
            step_m => format!("step_m={step_m}{zstd}"),
        }
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
            writeln!(f, "{:>9}{:>9}{:>12}{:>14}", "all", "min", "bytes", "largest error")?;
            for coding in &self.codings {
                let way = way(coding);
                write!(f, "{:<20}", coding.name())?;
                for name in names {
                    match way.steps.iter().find(|step| step.name == name) {
                        Some(step) => write!(f, "{:>17.3}", step.median_ms)?,
                        None => write!(f, "{:>17}", "–")?,
                    }
                }
                let (all, min) = (way.median_ms, way.minimum_ms);
                writeln!(f, "{all:>9.2}{min:>9.2}{:>12}{:>14.4}", coding.bytes, coding.max_error)?;
            }
        }
        self.fmt_clouds(f)?;
        let SealCost { sign_ms, check_ms } = self.seal;
        writeln!(
            f,
            "\na part of 16,384 bytes: {sign_ms:.3} ms to sign, {check_ms:.3} to check; medians"
        )?;
        self.paper.fmt(f)
    }
}

impl Transmission {
    fn fmt_clouds(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "\ncloud of {} points from a simulated sweep; medians; MB/s of {POINT} bytes a point: x, y, z and intensity in f32",
            self.points
        )?;
        write!(
            f,
            "\n{:<20}{:>17}{:>14}{:>17}",
            "cloud", "bytes a point", "encoder ms", "encoder MB/s"
        )?;
        writeln!(
            f,
            "{:>14}{:>17}{:>18}",
            "decoder ms", "decoder MB/s", "largest error, m"
        )?;
        for cloud in &self.clouds {
            let bytes = cloud.bytes as f64 / self.points as f64;
            write!(f, "{:<20}{bytes:>17.2}", cloud.name())?;
            for way in [&cloud.encode, &cloud.decode] {
                let rate = (POINT * self.points) as f64 / 1e3 / way.median_ms;
                write!(f, "{:>14.2}{rate:>17.0}", way.median_ms)?;
            }
            writeln!(f, "{:>18.5}", cloud.max_error)?;
        }
        Ok(())
    }
}

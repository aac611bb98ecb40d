//! The measured radio of CooperScene: `mcap/TAKE.mcap` has the throughput of every way, which becomes traces for links.
//!
//! The data set's layout for Foxglove names topics `/RECEIVER_Throughput_from_agent_SENDER` whose `x` is Mbit/s, and says no more of the
//! radio: latency, loss and jitter are measured too, but nothing public says where they are.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use realo_bags::{Bag, Connection, Encoding};
use realo_schemas::{Nanos, to_seconds};

use crate::scenes::SceneSummary;
use crate::{ImportError, Options};

/// The folder of the recordings, beside the splits.
const FOLDER: &str = "mcap";
/// Folders above the given one in which it is looked for.
const ABOVE: usize = 4;
/// Stands between the receiver and the sender in names of topics.
const THROUGHPUT: &str = "_Throughput_from_agent_";
/// Words of topics that may have the rest of the radio.
const OTHERS: [&str; 4] = ["latency", "loss", "jitter", "delay"];
/// No radio of C-V2X has more, Mbit/s.
const MOST: f64 = 100.0;
const COLUMNS: &str = "seconds,bits_per_second,delay_ms,loss";

/// What a way carried, by when it was recorded: Mbit/s.
type Way = Vec<(Nanos, f64)>;

/// What a recording has of the radio.
#[derive(Default)]
struct Radio {
    /// By receiver and sender, as folders of agents.
    ways: BTreeMap<(String, String), Way>,
    /// When the first sweep was recorded.
    first_sweep: Option<Nanos>,
    /// Topics that may have more of the radio.
    left: Vec<String>,
    /// Messages that cannot be read, and why the first.
    faults: (usize, String),
}

/// Writes the traces of a scene beside its log, and says so in the scene's summary. Without a log there is nothing to write for.
pub fn add(dir: &Path, options: &Options, scene: &mut SceneSummary) {
    let Some(log) = scene.log.clone() else { return };
    let take = scene.scene.rsplit('/').next().unwrap_or_default().to_string();
    let Some(recording) = recording(dir, &take) else {
        scene.assumed.push(format!(
            "the measured radio in `{FOLDER}/` is not imported: there is no `{FOLDER}/{take}.mcap` in this folder or above it; the data set \
             ships it apart"
        ));
        return;
    };
    // The log is whole without it.
    match write(&recording, &log, options, scene) {
        Ok(lines) => scene.assumed.extend(lines),
        Err(error) => scene.assumed.push(format!(
            "the measured radio in `{FOLDER}/` is not imported: {error}; links.md has the form of traces for other measurements"
        )),
    }
}

fn recording(dir: &Path, take: &str) -> Option<PathBuf> {
    let whole = dir.canonicalize().ok()?;
    let mut paths = whole
        .ancestors()
        .take(ABOVE)
        .map(|folder| folder.join(FOLDER).join(format!("{take}.mcap")));
    paths.find(|path| path.is_file())
}

fn write(recording: &Path, log: &Path, options: &Options, scene: &SceneSummary) -> Result<Vec<String>, ImportError> {
    let radio = Radio::read(recording)?;
    let folder = log.with_extension("radio");
    std::fs::create_dir_all(&folder).map_err(ImportError::io(&folder))?;
    let put = |name: String, text: String| {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(ImportError::io(&path))
    };
    let first = radio
        .ways
        .values()
        .filter_map(|way| way.first())
        .map(|(time, _)| *time)
        .min();
    let start = radio.first_sweep.or(first).unwrap_or(0);
    let named = |folder: &String| {
        let agent = scene.agents.iter().find(|agent| agent.folder == *folder);
        agent.map_or_else(|| format!("agent_{folder}"), |agent| agent.name.clone())
    };
    let mut to: BTreeMap<String, Vec<&Way>> = BTreeMap::new();
    for ((receiver, sender), way) in &radio.ways {
        put(
            format!("{}_from_{}.csv", named(receiver), named(sender)),
            trace(&[way], start),
        )?;
        to.entry(named(receiver)).or_default().push(way);
    }
    for (receiver, ways) in &to {
        let trace_file = format!("{receiver}_from_all.csv");
        put(trace_file.clone(), trace(ways, start))?;
        put(format!("{receiver}.toml"), profile(receiver, ways.len(), &trace_file))?;
    }
    Ok(radio.words(recording, &folder, options, to.len()))
}

/// A profile of the ways to an agent.
fn profile(receiver: &str, senders: usize, trace: &str) -> String {
    format!(
        "about = \"CooperScene: throughput to {receiver} as measured, the mean of {senders} senders\"\n[default]\n[channel]\ntrace = \"{trace}\"\n"
    )
}

impl Radio {
    fn read(path: &Path) -> Result<Self, ImportError> {
        let bag = realo_bags::open(path)?;
        let mut radio = Radio::default();
        let mut known: BTreeMap<usize, (String, String)> = BTreeMap::new();
        let mut sweeps = BTreeSet::new();
        for (place, connection) in bag.connections().iter().enumerate() {
            let topic = connection.topic.trim_start_matches('/');
            let lower = topic.to_lowercase();
            if let Some((receiver, sender)) = topic.split_once(THROUGHPUT) {
                known.insert(place, (receiver.into(), sender.into()));
            } else if lower.ends_with("_lidar") {
                sweeps.insert(place);
            } else if OTHERS.iter().any(|word| lower.contains(word)) {
                radio.left.push(realo_bags::printable(&connection.topic));
            }
        }
        if known.is_empty() {
            let topics: Vec<&str> = bag
                .connections()
                .iter()
                .map(|connection| connection.topic.as_str())
                .take(12)
                .collect();
            let reason = format!(
                "expected topics `/0{THROUGHPUT}1` and the like, found {}",
                realo_bags::printable(&topics.join(", "))
            );
            return Err(ImportError::content(path, reason));
        }
        radio.first_sweep = first(bag.as_ref(), &sweeps)?;
        let mut messages = bag.messages(&known.keys().copied().collect())?;
        while let Some(message) = messages.next()? {
            let connection = &bag.connections()[message.connection];
            match throughput(connection, message.data()) {
                Ok(mbit) => {
                    let way = radio.ways.entry(known[&message.connection].clone()).or_default();
                    way.push((message.log_time, mbit));
                }
                Err(reason) => {
                    radio.faults.0 += 1;
                    if radio.faults.1.is_empty() {
                        radio.faults.1 = format!("`{}`: {reason}", realo_bags::printable(&connection.topic));
                    }
                }
            }
        }
        match radio.ways.is_empty() {
            false => Ok(radio),
            true => Err(ImportError::content(
                path,
                format!("no throughput can be read: {}", radio.faults.1),
            )),
        }
    }

    /// What was written, what was assumed and what was left.
    fn words(&self, recording: &Path, folder: &Path, options: &Options, receivers: usize) -> Vec<String> {
        let messages: usize = self.ways.values().map(Vec::len).sum();
        let mut lines = vec![format!(
            "measured radio: {messages} throughputs of {} ways in `{}`, `x` taken as Mbit/s, became traces in `{}`, a profile for each of {receivers} \
             receivers: `realo run … --link {}`",
            self.ways.len(),
            recording.display(),
            folder.display(),
            realo_logs::shell::word(folder.join("AGENT.toml")),
        )];
        lines.push(match self.first_sweep {
            Some(_) => "measured radio: traces begin at the first sweep of the recording".into(),
            None => "measured radio: traces begin at the first throughput, for the recording has no sweeps".into(),
        });
        if options.frames != [0, u64::MAX] {
            lines.push(
                "measured radio: it is of the whole take, and --frames chose a part: the trace begins before the log"
                    .into(),
            );
        }
        lines.push(match &self.left[..] {
            [] => "measured radio: its delays and losses are 0, for no topic of theirs is there".into(),
            left => format!(
                "measured radio: its delays and losses are 0; left, for their form is not known: {}",
                left.join(", ")
            ),
        });
        if self.faults.0 > 0 {
            lines.push(format!(
                "measured radio: {} messages cannot be read, the first: {}",
                self.faults.0, self.faults.1
            ));
        }
        lines
    }
}

/// When the first message of some connections was recorded.
fn first(bag: &dyn Bag, wanted: &BTreeSet<usize>) -> Result<Option<Nanos>, ImportError> {
    if wanted.is_empty() {
        return Ok(None);
    }
    Ok(bag.messages(wanted)?.next()?.map(|message| message.log_time))
}

/// The rate of some ways, their mean where there are several, from a time on.
fn trace(ways: &[&Way], start: Nanos) -> String {
    let later = ways
        .iter()
        .flat_map(|way| way.iter())
        .map(|(time, _)| *time)
        .filter(|time| *time > start);
    let times: BTreeSet<Nanos> = std::iter::once(start).chain(later).collect();
    let mut text = format!("{COLUMNS}\n");
    let (mut last, mut last_at) = (None, String::new());
    for time in times {
        let sum: f64 = ways.iter().map(|way| held(way, time)).sum();
        let bits = (1e6 * sum / ways.len() as f64).round();
        let at = format!("{:.6}", to_seconds(time - start));
        if last.replace(bits) != Some(bits) && last_at != at {
            // Writing to a text does not fail.
            let _ = writeln!(text, "{at},{bits},0,0");
            last_at = at;
        }
    }
    text
}

/// The rate of a way at a time: that of the last message before it, and before the first that of the first.
fn held(way: &Way, time: Nanos) -> f64 {
    let next = way.partition_point(|(at, _)| *at <= time);
    way.get(next.saturating_sub(1)).map_or(0.0, |(_, mbit)| *mbit)
}

/// The `x` of a message, Mbit/s.
fn throughput(connection: &Connection, data: &[u8]) -> Result<f64, String> {
    let kind = connection.kind.as_str();
    let mbit = match &connection.encoding {
        Encoding::Cdr | Encoding::Ros1 => {
            let mut input = connection.reader(data)?;
            match kind.rsplit('/').next().unwrap_or_default() {
                "Vector3" | "Point" | "Float64" => input.f64()?,
                "Vector3Stamped" | "PointStamped" => {
                    input.header()?;
                    input.f64()?
                }
                "Point32" | "Float32" => input.f32()?.into(),
                _ => {
                    return Err(format!(
                        "expected a type with `x`, as geometry_msgs/Vector3, found `{}`",
                        crate::shown(kind)
                    ));
                }
            }
        }
        Encoding::Other(name) if name == "json" => {
            let value: serde_json::Value = serde_json::from_slice(data).map_err(|error| error.to_string())?;
            value["x"]
                .as_f64()
                .ok_or_else(|| "expected a number `x` in its JSON, found none".to_string())?
        }
        Encoding::Other(name) if name == "protobuf" && (kind.ends_with("Vector3") || kind.ends_with("Point3")) => {
            first_double(data)?
        }
        Encoding::Other(name) => {
            let (name, kind) = (crate::shown(name), crate::shown(kind));
            return Err(format!(
                "expected CDR, JSON, or Foxglove's Vector3 in protobuf, found `{kind}` in `{name}`"
            ));
        }
    };
    match (0.0..=MOST).contains(&mbit) {
        true => Ok(mbit),
        false => Err(format!("expected 0 to {MOST} Mbit/s as `x`, found {mbit}")),
    }
}

/// The double of field 1 of a message of doubles in protobuf; 0 is not written.
fn first_double(mut data: &[u8]) -> Result<f64, String> {
    let mut found = 0.0;
    while let Some((tag, rest)) = data.split_first() {
        let (value, rest) = rest
            .split_first_chunk::<8>()
            .filter(|_| tag & 7 == 1)
            .ok_or("expected doubles, found something else")?;
        if tag >> 3 == 1 {
            found = f64::from_le_bytes(*value);
        }
        data = rest;
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn connection(kind: &str, encoding: Encoding) -> Connection {
        Connection {
            topic: "/0_Throughput_from_agent_1".into(),
            kind: kind.into(),
            encoding,
            messages: 1,
        }
    }

    #[test]
    fn throughputs_of_every_form_are_read() {
        let double = 1.5_f64.to_le_bytes();
        let cdr = [&[0, 1, 0, 0][..], &double, &[0; 16]].concat();
        let protobuf = [&[0x11][..], &9.0_f64.to_le_bytes(), &[0x09], &double].concat();
        let json = Encoding::Other("json".into());
        for (kind, encoding, data, expected) in [
            ("geometry_msgs/Vector3", Encoding::Cdr, &cdr[..], Ok(1.5)),
            ("geometry_msgs/Point", Encoding::Ros1, &double[..], Ok(1.5)),
            ("foxglove.Vector3", json.clone(), br#"{"x": 1.5, "y": 0}"#, Ok(1.5)),
            (
                "foxglove.Vector3",
                Encoding::Other("protobuf".into()),
                &protobuf,
                Ok(1.5),
            ),
            ("foxglove.Point3", Encoding::Other("protobuf".into()), &[], Ok(0.0)),
            ("foxglove.Vector3", json.clone(), b"{}", Err("a number `x`")),
            ("foxglove.Vector3", json, br#"{"x": -1}"#, Err("0 to 100 Mbit/s")),
            ("std_msgs/String", Encoding::Cdr, &cdr, Err("found `std_msgs/String`")),
            (
                "foxglove.Log",
                Encoding::Other("protobuf".into()),
                &[],
                Err("found `foxglove.Log` in `protobuf`"),
            ),
            (
                "foxglove.Vector3",
                Encoding::Other("protobuf".into()),
                &[0x0a, 1],
                Err("expected doubles"),
            ),
        ] {
            match (throughput(&connection(kind, encoding), data), expected) {
                (Ok(found), Ok(expected)) => assert_eq!(found, expected, "{kind}"),
                (Err(error), Err(part)) => assert!(error.contains(part), "{error}"),
                (found, expected) => panic!("{kind}: {found:?}, expected {expected:?}"),
            }
        }
    }

    #[test]
    fn a_trace_holds_each_rate_until_the_next() {
        let ms = 1_000_000;
        let one: Way = vec![(50 * ms, 1.0), (250 * ms, 2.0), (350 * ms, 2.0), (400 * ms, 0.0)];
        let other: Way = vec![(150 * ms, 3.0)];
        let from =
            |start: Nanos, ways: &[&Way]| trace(ways, start).lines().skip(1).map(String::from).collect::<Vec<_>>();
        assert_eq!(
            from(100 * ms, &[&one]),
            ["0.000000,1000000,0,0", "0.150000,2000000,0,0", "0.300000,0,0,0"]
        );
        assert_eq!(from(0, &[&one])[0], "0.000000,1000000,0,0");
        assert_eq!(
            from(100 * ms, &[&one, &other])[..2],
            ["0.000000,2000000,0,0", "0.150000,2500000,0,0"]
        );
    }
}

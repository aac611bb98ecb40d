//! Collective Perception Messages: what each agent of a log or of a run found in a sweep, as it goes on the air.

mod index;
mod lists;

use std::collections::BTreeMap;

use realo_logs::{Log, McapFile};
use realo_operator::Steps;
use realo_schemas::{Box3, Boxes, Header, Kind as MessageKind, Message, Name, Packet, Pose};
use realo_transmission::cpm::{Geodetic, station_of};
use realo_transmission::{BoxesLayout, Dropped, EncodeError, Encoder, EncoderSettings};

use self::index::Index;
use self::lists::{Agents, List, Source, Unpaired, each_list};
use super::{Exporter, Kind, Report};
use crate::options::BoxSource;
use crate::{ExportError, Exported, ExportedAgent, Folder, Options};

/// Most objects of a message.
const MOST: usize = 255;
/// A component of a velocity has no number beyond, m/s.
const FASTEST: f64 = 163.81;
/// The list of all messages.
const INDEX: &str = "index.csv";

/// Collective Perception Messages.
pub struct Cpm;

static KIND: Kind = Kind {
    name: "cpm",
    title: "Collective Perception Messages (ETSI TS 103 324 v2.1.1, UPER), of a log or of the run of one log and ego",
    writes: "AGENT/000000.uper for each list of boxes of an agent, and index.csv",
    unit: "messages",
    options: &[
        ("agents", ""),
        ("boxes", "detections"),
        ("classes", ""),
        ("origin", ""),
        ("roadside", ""),
        ("unfit", "refuse"),
    ],
};

impl Exporter for Cpm {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn write(
        &self,
        log: &Log,
        folder: &mut Folder,
        options: &Options,
        report: Report,
    ) -> Result<Exported, ExportError> {
        let origin = log
            .info()
            .map_origin
            .map(|[latitude_deg, longitude_deg, height_m]| Geodetic {
                latitude_deg,
                longitude_deg,
                height_m,
            });
        let agents = Agents::of_log(log, options)?;
        write(&Source::Log(log), agents, origin, folder, options, report)
    }

    fn write_recording(
        &self,
        file: &McapFile,
        folder: &mut Folder,
        options: &Options,
        report: Report,
    ) -> Result<Exported, ExportError> {
        let agents = Agents::of_recording(file, options)?;
        write(&Source::Recording(file), agents, None, folder, options, report)
    }
}

fn write(
    source: &Source,
    agents: Agents,
    known_origin: Option<Geodetic>,
    folder: &mut Folder,
    options: &Options,
    report: Report,
) -> Result<Exported, ExportError> {
    let refused = |reason: String| ExportError::unfit(source.path(), reason);
    let origin = options.origin.or(known_origin).ok_or_else(|| {
        refused(
            "the place of the map on the Earth: expected `map_origin` in the log or --origin, found neither; give it, as \
             --origin 48.1374,11.5755,519 (latitude, longitude, degrees; height over the ellipsoid, m)"
                .into(),
        )
    })?;
    stations(&agents).map_err(refused)?;
    let mut writing = Writing::new(&agents, origin, options, source)?;
    let unpaired = each_list(source, &agents, options, report, |list| writing.list(folder, list))?;
    writing.exported(folder, origin, unpaired)
}

/// Refuses two agents whose names stand for one station.
fn stations(agents: &Agents) -> Result<(), String> {
    let mut known: BTreeMap<u32, &str> = BTreeMap::new();
    for name in agents.names() {
        let id = station_of(name);
        if let Some(other) = known.insert(id, name) {
            return Err(format!(
                "agents `{other}` and `{name}`: expected names with a `stationId` each, found {id} for both; leave one out by --agents"
            ));
        }
    }
    Ok(())
}

struct Writing<'a> {
    agents: &'a Agents,
    options: &'a Options,
    source: &'a Source<'a>,
    encoder: Encoder,
    run: Name,
    index: Index,
    summaries: BTreeMap<String, ExportedAgent>,
    dropped: Dropped,
    /// Velocities that have no number.
    too_fast: u64,
    /// Objects that are the agent itself.
    itself: u64,
}

impl<'a> Writing<'a> {
    fn new(
        agents: &'a Agents,
        origin: Geodetic,
        options: &'a Options,
        source: &'a Source<'a>,
    ) -> Result<Self, ExportError> {
        let settings = EncoderSettings {
            boxes: BoxesLayout::Cpm,
            origin,
            roadside: agents.roadside().collect::<Vec<_>>().join(","),
            ..EncoderSettings::default()
        };
        Ok(Writing {
            agents,
            options,
            encoder: Encoder::new(&settings).map_err(|error| ExportError::Option(error.to_string()))?,
            source,
            run: "export".into(),
            index: Index::default(),
            summaries: BTreeMap::new(),
            dropped: Dropped::default(),
            too_fast: 0,
            itself: 0,
        })
    }

    /// Writes the message of a list of boxes.
    fn list(&mut self, folder: &mut Folder, mut list: List) -> Result<(), ExportError> {
        let outline = self.agents.outline(&list.agent);
        let is_itself = |object: &Box3| outline.is_some_and(|outline| is_inside(object, outline));
        let options = self.options;
        list.boxes.retain(|object| options.wants_class(&object.class));
        let wanted = list.boxes.len();
        list.boxes.retain(|object| !is_itself(object));
        self.itself += (wanted - list.boxes.len()) as u64;
        let (packet, dropped) = self.encoded(&list)?;
        let number = self.summaries.get(&list.agent).map_or(0, |summary| summary.sweeps);
        let name = format!("{}/{number:06}.uper", list.agent);
        folder.write(&name, &packet.bytes)?;
        let left_out = dropped.boxes + dropped.out_of_range + dropped.surplus;
        let objects = list.boxes.len() - left_out as usize;
        self.index.put(&name, &list, objects, packet.bytes.len());
        self.too_fast += list.boxes.iter().filter(|object| is_too_fast(object)).count() as u64;
        let summary = self
            .summaries
            .entry(list.agent.clone())
            .or_insert_with(|| ExportedAgent {
                name: list.agent.clone(),
                place: format!("folder `{}`, stationId {}", list.agent, station_of(&list.agent)),
                ..ExportedAgent::default()
            });
        summary.sweeps += 1;
        summary.boxes += objects;
        self.dropped.boxes += dropped.boxes;
        self.dropped.out_of_range += dropped.out_of_range;
        self.dropped.surplus += dropped.surplus;
        self.dropped.tracks += dropped.tracks;
        Ok(())
    }

    fn encoded(&mut self, list: &List) -> Result<(Packet, Dropped), ExportError> {
        let encoded = self.encode(list, &list.boxes);
        let (packet, dropped) = encoded.map_err(|error| self.refused(list, &in_words(&error, list)))?;
        if self.options.drops_unfit || dropped.boxes + dropped.out_of_range + dropped.surplus == 0 {
            return Ok((packet, dropped));
        }
        if dropped.surplus > 0 {
            let found = dropped.surplus as usize + MOST;
            let reason = format!(
                "expected at most {MOST} objects in a message, found {found}; choose some by --classes, or take --unfit drop, which \
                 leaves out those of the lowest scores"
            );
            return Err(self.refused(list, &reason));
        }
        for (index, object) in list.boxes.iter().enumerate() {
            let alone = self.encode(list, std::slice::from_ref(object));
            if alone.is_ok_and(|(_, dropped)| dropped.boxes + dropped.out_of_range > 0) {
                return Err(self.refused(list, &unfit(index, object)));
            }
        }
        Ok((packet, dropped))
    }

    fn encode(&mut self, list: &List, boxes: &[Box3]) -> Result<(Packet, Dropped), EncodeError> {
        let agent: Name = list.agent.as_str().into();
        let mut header = Header::origin(&self.run, &agent, MessageKind::Boxes, list.seq, list.stamp, list.ready);
        header.pose = list.map_from_body.map(Pose::exact);
        let message = Message::new(header, Boxes(boxes.to_vec()));
        self.encoder.encode(&message, &mut Steps::default())
    }

    fn refused(&self, list: &List, reason: &str) -> ExportError {
        let List { agent, stamp, .. } = list;
        ExportError::unfit(
            self.source.path(),
            format!("agent `{agent}`, stamp {stamp} ns: {reason}"),
        )
    }

    /// What messages do not hold, a line each.
    fn lost(&self) -> Vec<String> {
        let mut lost = vec![
            "names of agents: messages have a stationId, which index.csv says".into(),
            "stamps below a millisecond; index.csv has them".to_string(),
            "digits: centimetres, tenths of degrees and of metres, per cent (docs/reference/packets.md)".into(),
        ];
        if self.dropped.tracks > 0 {
            lost.push(format!(
                "tracks of {} objects, whose number another object of the message has",
                self.dropped.tracks
            ));
        }
        if self.too_fast > 0 {
            lost.push(format!(
                "velocities of {} objects above {FASTEST} m/s, which are unknown there",
                self.too_fast
            ));
        }
        lost
    }

    fn exported(self, folder: &mut Folder, origin: Geodetic, unpaired: Unpaired) -> Result<Exported, ExportError> {
        if self.summaries.is_empty() {
            let topic = self.options.boxes.topic();
            let reason = format!(
                "topic `/AGENT/{topic}`: expected boxes of at least one agent, found none; --boxes takes others, see `realo info`"
            );
            return Err(ExportError::unfit(self.source.path(), reason));
        }
        folder.write(INDEX, self.index.text().as_bytes())?;
        let counted = [
            (
                self.dropped.boxes,
                "objects with numbers that are not finite or sizes that are not positive",
            ),
            (
                self.dropped.out_of_range,
                "objects farther than 1,310.7 m from their agent, or longer than 25.4 m",
            ),
            (
                self.dropped.surplus,
                "objects of the lowest scores, beyond 255 in a message",
            ),
            (
                self.itself,
                "objects centred in the outline of their agent, which are the agent itself",
            ),
            (
                unpaired.lists,
                "lists of boxes without a companion of headings of their stamp",
            ),
            (
                unpaired.companions,
                "companions of headings without a list of boxes of their stamp",
            ),
        ];
        let lost = self.lost();
        let roadside: Vec<&str> = self.agents.roadside().collect();
        Ok(Exported {
            agents: self.summaries.into_values().collect(),
            assumed: vec![
                format!("the map's origin is at {origin} (latitude, longitude, degrees; height, m), its x looks east"),
                format!(
                    "roadside units: {}",
                    if roadside.is_empty() {
                        "none".into()
                    } else {
                        roadside.join(", ")
                    }
                ),
            ],
            left_out: counted
                .iter()
                .filter(|(n, _)| *n > 0)
                .map(|(n, what)| format!("{n} {what}"))
                .collect(),
            lost,
            read_back: "any tool of ASN.1 with ETSI's modules of TS 103 324 and TS 102 894-2, as Python's asn1tools"
                .into(),
            ..Exported::default()
        })
    }
}

fn is_inside(object: &Box3, [x0, x1, y0, y1]: [f64; 4]) -> bool {
    let [x, y, _] = object.center;
    (x0..=x1).contains(&x) && (y0..=y1).contains(&y)
}

fn is_too_fast(object: &Box3) -> bool {
    object.velocity.iter().flatten().any(|speed| speed.abs() > FASTEST)
}

/// Why an object has no numbers.
fn unfit(index: usize, object: &Box3) -> String {
    let Box3 {
        class,
        center: [x, y, z],
        length,
        width,
        height,
        ..
    } = object;
    format!(
        "object {index} (`{class}`): expected finite numbers, edges of at most 25.4 m and a place within 1,310.7 m of the agent along \
         each axis, found {length:.1} × {width:.1} × {height:.1} m at {x:.1}, {y:.1}, {z:.1} m; choose others by --classes, or take \
         --unfit drop, which leaves such objects out and counts them"
    )
}

/// Why a message cannot be, without advice for graphs.
fn in_words(error: &EncodeError, list: &List) -> String {
    match error {
        EncodeError::Stamp(stamp) => format!(
            "expected a stamp from 2004 to 2143, which `referenceTime` can say, found {stamp} ns since 1970; a log whose stamps have \
             another epoch cannot be exported"
        ),
        EncodeError::Place { field, expected, found } => {
            format!(
                "`{field}` expected {expected}, found {found}; correct --origin, or leave the agent out by --agents"
            )
        }
        EncodeError::Nowhere(_) => format!(
            "expected a pose of the agent within 150 ms, found none; leave it out by --agents, or see `realo info` about `/{}/pose`",
            list.agent
        ),
        other => other.to_string(),
    }
}

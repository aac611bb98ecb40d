//! The calls of one stage, as one run made them.

use std::collections::BTreeSet;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use realo_engine::{Call, Called};
use realo_operator::{Counts, PortId};
use realo_schemas::{Message, Nanos, Payload, PointCloud};

use super::Shared;

/// What a recorded message takes beside its payload and trace, bytes.
const HEADER: u64 = 256;
/// The same of each stage in its trace, and of each box.
const ENTRY: u64 = 64;
const BOX: u64 = 256;

/// What a source released.
pub(crate) type Released = (Nanos, PortId, Message);

/// How a stage of a run gets what comes of its calls.
pub(crate) enum Serving {
    /// It computes.
    Compute,
    /// It computes, and another run will repeat it.
    Record(Recorder),
    /// Another run computed it: its calls, and how many of them were taken.
    Repeat(Arc<Recording>, usize),
}

/// All calls of a stage.
#[derive(Default)]
pub(crate) struct Recording {
    /// Of an operator: what it was called for, and what came of it.
    calls: Vec<(u64, Called)>,
    /// Of a source.
    released: Vec<Released>,
    counts: Counts,
    /// Outputs whose payloads are there.
    whole: BTreeSet<PortId>,
    /// What it holds.
    pub bytes: u64,
}

/// A recording that grows.
pub(crate) struct Recorder(Recording);

impl Recording {
    /// Whether the payloads of these outputs are there.
    pub fn has(&self, ports: &BTreeSet<PortId>) -> bool {
        ports.is_subset(&self.whole)
    }

    /// What came of a call; `None` where the stage was not called so.
    pub fn call(&self, number: usize, mark: u64) -> Option<Called> {
        let (known, called) = self.calls.get(number)?;
        called.copy().filter(|_| *known == mark)
    }

    /// What a source released; `None` behind its last message.
    pub fn released(&self, number: usize) -> Option<Released> {
        self.released.get(number).cloned()
    }

    /// What a source counted.
    pub fn counts(&self) -> Counts {
        self.counts.clone()
    }
}

impl Recorder {
    pub fn new(whole: BTreeSet<PortId>) -> Self {
        Recorder(Recording {
            whole,
            ..Recording::default()
        })
    }

    /// Records a call; `false` where there is no room for it, or it cannot be repeated.
    pub fn call(&mut self, shared: &Shared, stage: &str, mark: u64, called: &Called) -> bool {
        let Some(copy) = self.0.kept_call(called) else {
            return false;
        };
        if self.fits(shared, stage, size_of_call(&copy)) {
            self.0.calls.push((mark, copy));
            return true;
        }
        self.thin(shared) && self.call(shared, stage, mark, called)
    }

    fn fits(&mut self, shared: &Shared, stage: &str, bytes: u64) -> bool {
        let fits = shared.reserve(stage, bytes);
        self.0.bytes += if fits { bytes } else { 0 };
        fits
    }

    /// Lets go of all payloads that fill the memory: what needs them computes this stage again. `false` where none is left.
    fn thin(&mut self, shared: &Shared) -> bool {
        if self.0.whole.is_empty() {
            return false;
        }
        self.0.whole.clear();
        let calls = std::mem::take(&mut self.0.calls).into_iter();
        self.0.calls = calls
            .filter_map(|(mark, called)| Some((mark, self.0.kept_call(&called)?)))
            .collect();
        let released = std::mem::take(&mut self.0.released).into_iter();
        let released = released.map(|(time, port, message)| (time, port, self.0.kept(port, &message)));
        self.0.released = released.collect();
        let calls = self.0.calls.iter().map(|(_, called)| size_of_call(called));
        let bytes = calls
            .chain(self.0.released.iter().map(|(.., message)| size(message)))
            .sum();
        shared.release(self.0.bytes - bytes);
        self.0.bytes = bytes;
        true
    }

    /// Records what a source released; `false` where there is no room for it.
    pub fn release(&mut self, shared: &Shared, stage: &str, released: &Released) -> bool {
        let (time, port, message) = released;
        let message = self.0.kept(*port, message);
        if self.fits(shared, stage, size(&message)) {
            self.0.released.push((*time, *port, message));
            return true;
        }
        self.thin(shared) && self.release(shared, stage, released)
    }

    /// Records what a source counted to its end.
    pub fn count(&mut self, counts: Counts) {
        self.0.counts = counts;
    }

    /// Gives up: nothing of it is kept.
    pub fn drop(self, shared: &Shared) {
        shared.release(self.0.bytes);
    }

    pub fn finish(self) -> Recording {
        self.0
    }
}

impl Recording {
    fn kept_call(&self, called: &Called) -> Option<Called> {
        called.copy_with(|port, message| self.kept(port, message))
    }

    /// A message as it is kept: without its columns where nobody will look at them.
    fn kept(&self, port: PortId, message: &Message) -> Message {
        let mut message = message.clone();
        if self.whole.contains(&port) {
            return message;
        }
        match &mut message.payload {
            Payload::PointCloud(cloud) => *cloud = PointCloud::empty(),
            Payload::FeatureMap(map) => (map.data, map.confidence) = (Vec::<u8>::new().into(), None),
            Payload::Packet(packet) => packet.bytes = Vec::<u8>::new().into(),
            // They are small, or an engine looks into them.
            Payload::AgentState(_)
            | Payload::Selection(_)
            | Payload::Report(_)
            | Payload::Boxes(_)
            | Payload::GroundTruth(_)
            | Payload::Motion(_) => {}
        }
        message
    }
}

fn size_of_call(called: &Called) -> u64 {
    HEADER + called.sent().map(|(_, message)| size(message)).sum::<u64>()
}

/// What a message holds, bytes.
fn size(message: &Message) -> u64 {
    let boxes = |boxes: usize| boxes as u64 * BOX;
    let payload = match &message.payload {
        Payload::PointCloud(cloud) => cloud.x.len() as u64 * 19,
        Payload::FeatureMap(map) => {
            let cells = map.confidence.as_ref().map_or(0, |confidence| confidence.len());
            (map.data.len() + 4 * cells) as u64
        }
        Payload::Packet(packet) => packet.bytes.len() as u64,
        Payload::Selection(selection) => selection.entries.iter().map(size).sum(),
        Payload::Report(report) => report.json.len() as u64,
        Payload::Boxes(list) => boxes(list.0.len()),
        Payload::GroundTruth(truth) => boxes(truth.boxes.len()) + 4 * truth.points.len() as u64,
        Payload::AgentState(_) => 0,
        Payload::Motion(motion) => motion.bytes(),
    };
    HEADER + message.header.trace.len() as u64 * ENTRY + payload
}

/// What a call is known by when another run repeats it: its cause, its time, and the messages by their headers.
pub(crate) fn mark_of(cause: &str, start: Nanos, call: &Call) -> u64 {
    let mut hash = DefaultHasher::new();
    (cause, start).hash(&mut hash);
    if let Call::Inputs(inputs) = call {
        for (port, message) in inputs {
            let header = &message.header;
            (port, &header.agent, header.kind, header.seq, header.hop).hash(&mut hash);
            (header.stamp, header.ready, &header.to).hash(&mut hash);
        }
    }
    hash.finish()
}

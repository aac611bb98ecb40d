//! A run's messages on the channels of Foxglove's viewers: the topics of a recording, and boxes as scenes.

use std::collections::BTreeMap;
use std::convert::Infallible;

use realo_logs::{Schema, scene};
use realo_recorder::{Channels, Times, put_boxes, put_cloud, put_fates, put_report, put_state, put_truth};
use realo_schemas::report::Fated;
use realo_schemas::{Box3, Header, Message, Name, Nanos, Payload};
use realo_view::Session;

use super::view::Part;

/// The colours are those of the report, and colour-blind people tell them apart.
const BOXES: scene::Look = scene::Look {
    color: [0.34, 0.71, 0.91],
    fill: 0.25,
    labelled: true,
};
const DETECTIONS: scene::Look = scene::Look {
    color: [0.90, 0.62, 0.0],
    fill: 0.0,
    labelled: false,
};
const TRUTH: scene::Look = scene::Look {
    color: [0.18, 0.75, 0.60],
    fill: 0.0,
    labelled: false,
};

/// The channels of a run.
pub struct Channelled {
    session: Session,
    /// By topic; `None` where there are too many.
    channels: BTreeMap<String, Option<u32>>,
    /// The newest time of a message so far, ns.
    last: Nanos,
    /// Whose message is shown.
    agent: Name,
}

impl Channelled {
    /// The channels of a run of which nothing is known yet.
    pub fn new(session: Session) -> Self {
        Channelled {
            session,
            channels: BTreeMap::new(),
            last: 0,
            agent: Name::default(),
        }
    }

    /// Shows a message of an output.
    pub fn see(&mut self, part: Part, Message { header, payload }: &Message) {
        self.agent = header.agent.clone();
        let Ok(()) = match (part, payload) {
            (Part::Boxes, Payload::Boxes(boxes)) => {
                self.scene(header, "boxes", &boxes.0, &BOXES);
                put_boxes(self, "boxes", header, boxes)
            }
            (Part::Detections, Payload::Boxes(boxes)) => {
                self.scene(header, "detections", &boxes.0, &DETECTIONS);
                put_boxes(self, "detections", header, boxes)
            }
            (Part::Truth, Payload::GroundTruth(truth)) => {
                self.scene(header, "ground_truth", &truth.boxes, &TRUTH);
                put_truth(self, header, truth)
            }
            (Part::States, Payload::AgentState(state)) => put_state(self, header, state),
            (Part::Clouds, Payload::PointCloud(cloud)) => put_cloud(self, header, cloud),
            (Part::Reports, Payload::Report(report)) => put_report(self, header, report),
            // Ports have types; nothing else comes.
            _ => Ok(()),
        };
    }

    /// Shows what became of messages.
    pub fn fates(&mut self, fates: &[Fated]) {
        self.agent = Name::default();
        let Ok(()) = put_fates(self, self.last, fates);
    }

    fn scene(&mut self, header: &Header, topic: &str, boxes: &[Box3], look: &scene::Look) {
        let Header { stamp, ready, .. } = *header;
        let topic = format!("/{}/{topic}_scene", header.agent);
        let Ok(()) = self.put(&topic, Schema::SceneUpdate, Times { ready, stamp }, |out| {
            scene::encode(out, stamp, &header.frame, &topic, boxes, look);
        });
    }

    fn channel(&mut self, topic: &str, schema: Schema) -> Option<u32> {
        if let Some(known) = self.channels.get(topic) {
            return *known;
        }
        let channel = self.session.channel(topic, &schema.name(), &schema.text());
        if channel.is_none() && self.channels.values().all(Option::is_some) {
            eprintln!("realo: --foxglove: {topic} and later topics are left out: there are too many");
        }
        self.channels.insert(topic.into(), channel);
        channel
    }
}

impl Channels for Channelled {
    type Error = Infallible;

    fn put(
        &mut self,
        topic: &str,
        schema: Schema,
        Times { ready, .. }: Times,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), Infallible> {
        self.last = self.last.max(ready);
        if let Some(channel) = self.channel(topic, schema) {
            let mut payload = Vec::new();
            encode(&mut payload);
            self.session
                .send(channel, &self.agent, ready.max(0).unsigned_abs(), payload);
        }
        Ok(())
    }
}

//! The stage that publishes boxes of a graph.

use realo_logs::{boxes, objects, pose};
use realo_operator::{Counter, Describe, Error, Inputs, NoOutput, Operator, Outputs, Settings};
use realo_schemas::geometry::transform_boxes;
use realo_schemas::{Boxes as List, Header, Nanos, Pose};
use serde::{Deserialize, Serialize};

use crate::names;
use crate::ros::{self, Delivery, Quality, Ros, Writer};

/// The frame in which boxes are published.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Frame {
    /// The world's.
    #[default]
    World,
    /// The agent's level body frame, `AGENT/body`, which `/tf` then places in the world.
    Body,
}

/// Settings of the stage.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Topic of `vision_msgs/Detection3DArray`; empty: none.
    #[setting(default = "/realo/detections")]
    pub detections: String,
    /// Topic of `visualization_msgs/MarkerArray`; empty: none.
    #[setting(default = "/realo/markers")]
    pub markers: String,
    /// Topic of `autoware_perception_msgs/DetectedObjects`; empty: none.
    #[setting(default = "/realo/objects")]
    pub objects: String,
    /// Frame of the boxes: `world`, or `body`, the agent's own.
    pub frame: Frame,
    /// Name of the world's frame.
    #[setting(default = "map", filled)]
    pub world: String,
    /// Domain of ROS, 0 to 232; null: what ROS_DOMAIN_ID says, or 0.
    pub domain: Option<u16>,
    /// Whether only programs on this machine hear it.
    pub localhost: bool,
    /// How they are published: `reliable` serves every subscriber, `best_effort` does without confirmations.
    #[setting(default = Delivery::Reliable)]
    pub reliability: Delivery,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// The final boxes.
    #[port(of(Ego))]
    Boxes(Header, List),
}

/// Publishes boxes on ROS 2.
#[derive(Describe)]
#[stage(name = "ros2-boxes", output = NoOutput, counters(PUBLISHED))]
pub struct Boxes {
    settings: Settings,
    domain: u16,
    forms: Vec<(Form, String)>,
    /// The node and its publishers, once it has joined.
    running: Option<(Ros, Vec<(Form, Writer)>)>,
}

const PUBLISHED: Counter = Counter::plain("published", "messages that were published");

#[derive(Clone, Copy, Debug, PartialEq)]
enum Form {
    Detections,
    Markers,
    Objects,
    Transform,
}

impl Form {
    fn kind(self) -> &'static str {
        match self {
            Form::Detections => "vision_msgs/Detection3DArray",
            Form::Markers => "visualization_msgs/MarkerArray",
            Form::Objects => "autoware_perception_msgs/DetectedObjects",
            Form::Transform => "tf2_msgs/TFMessage",
        }
    }
}

impl Operator for Boxes {
    fn build(settings: Settings) -> Result<Self, Error> {
        let domain = ros::domain(settings.domain)?;
        let given = [
            (Form::Detections, "detections", &settings.detections),
            (Form::Markers, "markers", &settings.markers),
            (Form::Objects, "objects", &settings.objects),
        ];
        let mut forms: Vec<(Form, String)> = Vec::new();
        for (form, setting, topic) in given.into_iter().filter(|(.., topic)| !topic.is_empty()) {
            let topic = names::topic(topic).map_err(|reason| format!("setting `{setting}`: {reason}"))?;
            if let Some((other, _)) = forms.iter().find(|(_, known)| *known == topic) {
                return Err(format!(
                    "setting `{setting}`: `{topic}` is the topic of {} too: give each a name of its own",
                    other.kind()
                )
                .into());
            }
            forms.push((form, topic));
        }
        if forms.is_empty() {
            return Err(
                "settings `detections`, `markers` and `objects`: expected at least one topic, found none".into(),
            );
        }
        if settings.frame == Frame::Body {
            forms.push((Form::Transform, "/tf".into()));
        }
        Ok(Boxes {
            settings,
            domain,
            forms,
            running: None,
        })
    }

    /// Joins before the first boxes come: others need a second to find the topics.
    fn on_wake(&mut self, _: Nanos, _: &mut Outputs<NoOutput>) -> Result<(), Error> {
        self.join()
    }

    fn on_input(&mut self, Input::Boxes(header, List(boxes)): Input, out: &mut Outputs<NoOutput>) -> Result<(), Error> {
        self.join()?;
        let (frame, boxes) = self.placed(&header, boxes)?;
        let Some((ros, writers)) = &mut self.running else {
            return Ok(());
        };
        ros.announce()?;
        for (form, writer) in writers {
            let mut payload = Vec::new();
            match (form, &header.pose) {
                (Form::Detections, _) => boxes::encode(&mut payload, header.stamp, &frame, &boxes),
                (Form::Markers, _) => boxes::encode_markers(&mut payload, header.stamp, &frame, "realo", &boxes),
                (Form::Objects, _) => objects::encode(&mut payload, header.stamp, &frame, &boxes),
                (Form::Transform, Some(Pose { map_from_frame, .. })) => {
                    pose::encode_transform(
                        &mut payload,
                        header.stamp,
                        &self.settings.world,
                        &header.frame,
                        map_from_frame,
                    );
                }
                (Form::Transform, None) => continue,
            }
            writer.write(payload)?;
            out.count(&PUBLISHED, &header.agent, 1);
        }
        Ok(())
    }
}

impl Boxes {
    fn join(&mut self) -> Result<(), Error> {
        if self.running.is_some() {
            return Ok(());
        }
        let mut ros = Ros::join(self.domain, self.settings.localhost, "realo_boxes")?;
        let quality = Quality {
            delivery: self.settings.reliability,
            depth: 10,
            latched: false,
        };
        let mut writers = Vec::new();
        for (form, topic) in &self.forms {
            writers.push((*form, ros.write(topic, form.kind(), quality)?));
        }
        self.running = Some((ros, writers));
        Ok(())
    }

    /// The boxes in the frame in which they are published, and its name.
    fn placed(
        &self,
        header: &Header,
        mut boxes: Vec<realo_schemas::Box3>,
    ) -> Result<(String, Vec<realo_schemas::Box3>), Error> {
        match (self.settings.frame, &header.pose) {
            (Frame::Body, _) => Ok((header.frame.to_string(), boxes)),
            (Frame::World, Some(pose)) => {
                transform_boxes(&pose.map_from_frame, &mut boxes);
                Ok((self.settings.world.clone(), boxes))
            }
            (Frame::World, None) => Err(format!("{header}: its frame has no pose: set `frame=body`").into()),
        }
    }
}

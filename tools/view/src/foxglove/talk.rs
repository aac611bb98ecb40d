//! What a client of Foxglove's protocol asks for, and the texts that it gets.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::feed::{Channel, Run};

/// Channels that a client may have at a time.
const MOST_SUBSCRIPTIONS: usize = 1024;
/// Complaints that wait for a client.
const MOST_COMPLAINTS: usize = 8;

/// A text of a client.
#[derive(Deserialize)]
#[serde(tag = "op", rename_all = "camelCase")]
enum Asked {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    #[serde(rename_all = "camelCase")]
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
    #[serde(other)]
    Other,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: u32,
}

/// How bad a thing is that a client is told.
#[derive(Clone, Copy)]
pub enum Level {
    Warning = 1,
    Error = 2,
}

/// What a client has asked for.
#[derive(Default)]
pub struct Talk {
    /// Subscriptions by channel.
    by_channel: BTreeMap<u32, u32>,
    /// Channels by subscription.
    by_id: BTreeMap<u32, u32>,
    /// Channels that it has not had anything of.
    fresh: BTreeSet<u32>,
    complaints: Vec<String>,
    /// The newest question whether somebody is there.
    pub ping: Option<Vec<u8>>,
    /// It is gone.
    pub left: bool,
}

impl Talk {
    /// Hears a text; `has` says whether there is a channel.
    pub fn hear(&mut self, text: &str, has: impl Fn(u32) -> bool) {
        match serde_json::from_str(text) {
            Ok(Asked::Subscribe { subscriptions }) => {
                for subscription in subscriptions {
                    self.subscribe(&subscription, &has);
                }
            }
            Ok(Asked::Unsubscribe { subscription_ids }) => {
                for id in subscription_ids {
                    if let Some(channel) = self.by_id.remove(&id) {
                        self.by_channel.remove(&channel);
                        self.fresh.remove(&channel);
                    }
                }
            }
            Ok(Asked::Other) => self.complain(
                Level::Warning,
                "this server shows a run: it takes `subscribe` and `unsubscribe`, and neither messages, parameters nor services",
            ),
            Err(error) => self.complain(Level::Error, &format!("expected a JSON object with `op`: {error}")),
        }
    }

    fn subscribe(&mut self, Subscription { id, channel_id }: &Subscription, has: &dyn Fn(u32) -> bool) {
        if !has(*channel_id) {
            return self.complain(Level::Warning, &format!("there is no channel {channel_id} any more"));
        }
        if self.by_id.contains_key(id) || self.by_channel.contains_key(channel_id) {
            let words = format!("subscription {id} or channel {channel_id} is in use: unsubscribe first");
            return self.complain(Level::Warning, &words);
        }
        if self.by_id.len() >= MOST_SUBSCRIPTIONS {
            return self.complain(Level::Error, &format!("at most {MOST_SUBSCRIPTIONS} subscriptions"));
        }
        self.by_id.insert(*id, *channel_id);
        self.by_channel.insert(*channel_id, *id);
        self.fresh.insert(*channel_id);
    }

    /// Hears bytes, which nobody asked for.
    pub fn hear_bytes(&mut self) {
        self.complain(Level::Warning, "this server takes no messages of clients");
    }

    fn complain(&mut self, level: Level, words: &str) {
        if self.complaints.len() < MOST_COMPLAINTS {
            self.complaints.push(status(level, words));
        }
    }

    /// Forgets all channels, as they are gone.
    pub fn forget(&mut self) {
        self.by_channel.clear();
        self.by_id.clear();
        self.fresh.clear();
    }

    /// The subscription of a channel, if there is one.
    pub fn subscription(&self, channel: u32) -> Option<u32> {
        self.by_channel.get(&channel).copied()
    }

    /// Takes the channels that it has not had anything of.
    pub fn take_fresh(&mut self) -> BTreeSet<u32> {
        std::mem::take(&mut self.fresh)
    }

    /// Takes what it is told of its own faults.
    pub fn take_complaints(&mut self) -> Vec<String> {
        std::mem::take(&mut self.complaints)
    }
}

/// The text that tells a client something.
pub fn status(level: Level, words: &str) -> String {
    json!({ "op": "status", "level": level as u8, "message": format!("realo: {words}") }).to_string()
}

/// The text that says what is shown.
pub fn server_info(run: &Run) -> String {
    let name = match &*run.name {
        "" => "realo, before its first run".to_string(),
        name => format!("realo, {name}"),
    };
    // The run's clock is not that of the wall.
    let session = format!("{}-{}", std::process::id(), run.number);
    json!({
        "op": "serverInfo",
        "name": name,
        "capabilities": ["time"],
        "supportedEncodings": [],
        "metadata": {},
        "sessionId": session,
    })
    .to_string()
}

/// The text that offers channels.
pub fn advertise(channels: &[Arc<Channel>]) -> String {
    #[derive(Serialize)]
    #[serde(rename_all = "camelCase")]
    struct Offered<'a> {
        id: u32,
        topic: &'a str,
        encoding: &'static str,
        schema_name: &'a str,
        schema: &'a str,
        schema_encoding: &'static str,
    }
    let offered: Vec<Offered> = channels
        .iter()
        .map(|channel| Offered {
            id: channel.id,
            topic: &channel.topic,
            encoding: "cdr",
            schema_name: &channel.schema_name,
            schema: &channel.schema,
            schema_encoding: "ros2msg",
        })
        .collect();
    json!({ "op": "advertise", "channels": offered }).to_string()
}

/// The text that takes channels back.
pub fn unadvertise(channels: &[u32]) -> String {
    json!({ "op": "unadvertise", "channelIds": channels }).to_string()
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    fn read(text: &str) -> Value {
        serde_json::from_str(text).unwrap()
    }

    #[test]
    fn channels_are_asked_for_and_given_back() {
        let mut talk = Talk::default();
        let text = r#"{"op":"subscribe","subscriptions":[{"id":0,"channelId":3},{"id":7,"channelId":5}]}"#;
        talk.hear(text, |_| true);
        assert_eq!(
            [3, 5, 4].map(|channel| talk.subscription(channel)),
            [Some(0), Some(7), None]
        );
        assert_eq!(talk.take_fresh(), [3, 5].into());
        talk.hear(r#"{"op":"unsubscribe","subscriptionIds":[0,99]}"#, |_| true);
        assert_eq!((talk.subscription(3), talk.subscription(5)), (None, Some(7)));
        assert!(talk.take_complaints().is_empty());
        talk.forget();
        assert_eq!(talk.subscription(5), None);
    }

    #[test]
    fn what_cannot_be_done_is_said_and_stays_bounded() {
        let mut talk = Talk::default();
        let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":1,"channelId":1}]}"#;
        for (text, level, words) in [
            ("junk", 2, "`op`"),
            ("{}", 2, "`op`"),
            (r#"{"op":"subscribe"}"#, 2, "subscriptions"),
            (
                r#"{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}"#,
                2,
                "-1",
            ),
            (
                r#"{"op":"getParameters","parameterNames":[]}"#,
                1,
                "neither messages, parameters",
            ),
            (
                r#"{"op":"subscribe","subscriptions":[{"id":0,"channelId":8}]}"#,
                1,
                "no channel 8",
            ),
        ] {
            talk.hear(text, |channel| channel < 2);
            let said = read(&talk.take_complaints()[0]);
            assert_eq!(
                (&said["op"], &said["level"]),
                (&json!("status"), &json!(level)),
                "{text}"
            );
            assert!(said["message"].as_str().unwrap().contains(words), "{text}: {said}");
        }
        talk.hear(subscribe, |_| true);
        talk.hear(subscribe, |_| true);
        assert!(talk.take_complaints()[0].contains("in use"));
        for id in 2..5000 {
            let text = format!(r#"{{"op":"subscribe","subscriptions":[{{"id":{id},"channelId":{id}}}]}}"#);
            talk.hear(&text, |_| true);
        }
        assert_eq!(talk.by_id.len(), MOST_SUBSCRIPTIONS);
        assert_eq!(talk.take_complaints().len(), MOST_COMPLAINTS);
    }

    #[test]
    fn channels_are_offered_with_their_schema() {
        let channel = Channel {
            id: 4,
            topic: "/cav1/\"points\"".into(),
            schema_name: "std_msgs/msg/String".into(),
            schema: "string data\n".into(),
        };
        let offered = read(&advertise(&[Arc::new(channel)]));
        let expected = json!({
            "id": 4, "topic": "/cav1/\"points\"", "encoding": "cdr", "schemaName": "std_msgs/msg/String",
            "schema": "string data\n", "schemaEncoding": "ros2msg",
        });
        assert_eq!(offered["channels"][0], expected);
        let info = read(&server_info(&Run {
            number: 2,
            name: "a".into(),
        }));
        assert_eq!(
            (&info["name"], &info["capabilities"]),
            (&json!("realo, a"), &json!(["time"]))
        );
        assert_ne!(info["sessionId"], read(&server_info(&Run::default()))["sessionId"]);
        assert_eq!(read(&unadvertise(&[1, 2]))["channelIds"], json!([1, 2]));
    }
}

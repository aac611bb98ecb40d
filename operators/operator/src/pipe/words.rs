//! Calls and replies.

use std::collections::BTreeMap;

use arrow_array::{Array, Int64Array, UInt64Array};
use arrow_buffer::Buffer;
use realo_schemas::report::{Channel, Fate, Fated};
use realo_schemas::{Message, Nanos, wire};
use serde::{Deserialize, Serialize};

use super::row::{Received, Row};
use crate::Loss;

/// What the driver asks of a program.
#[derive(Clone, Debug, PartialEq)]
pub enum Call {
    /// To take a message.
    Input {
        /// Name of the input.
        port: String,
        /// What comes there.
        message: Box<Message>,
    },
    /// A wake that the operator asked for.
    Wake,
    /// Nothing follows.
    End,
}

/// What came of a call.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reply {
    /// Why the operator could not take the message.
    pub error: Option<String>,
    /// Output and message, in order.
    pub sent: Vec<(String, Message)>,
    /// When the operator wishes to be called.
    pub wakes: Vec<Nanos>,
    /// What it counted.
    pub counts: Vec<(String, u64)>,
    /// What it said of messages that cross links, and of what was lost.
    pub reported: Reported,
}

/// What an operator says of messages that cross links, and of what was lost.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Reported {
    /// What became of messages.
    pub fates: Vec<Fated>,
    /// What channels carried.
    pub traffic: Vec<Channel>,
    /// More about those of its counters that are losses.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub losses: BTreeMap<String, Loss>,
    /// What fates mean at this operator.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub explained: BTreeMap<Fate, String>,
}

impl Call {
    /// The call's frame, in parts.
    ///
    /// # Errors
    /// What Arrow cannot write.
    pub fn to_parts(&self, now: Nanos) -> Result<Vec<Buffer>, String> {
        let (call, port) = match self {
            Call::Input { port, .. } => ("input", port.as_str()),
            Call::Wake => ("wake", ""),
            Call::End => ("end", ""),
        };
        let row = Row::default().text("call", call).text("port", port);
        let row = row.put("now", Int64Array::from(vec![now]));
        match self {
            Call::Input { message, .. } => row.put("message", wire::to_arrow(message)).into_parts(),
            _ => row.into_parts(),
        }
    }

    /// A call and its time.
    ///
    /// # Errors
    /// Why the frame is no call.
    pub fn from_bytes(bytes: Buffer) -> Result<(Call, Nanos), String> {
        let row = Received::from_bytes(bytes)?;
        let call = match row.text("call")? {
            "input" => Call::Input {
                port: row.text("port")?.into(),
                message: Box::new(message(&row, "message")?),
            },
            "wake" => Call::Wake,
            "end" => Call::End,
            other => return Err(format!("expected a call `input`, `wake` or `end`, found `{other}`")),
        };
        Ok((call, row.i64("now")?))
    }
}

impl Reply {
    /// The reply's frame, in parts.
    ///
    /// # Errors
    /// What Arrow cannot write.
    pub fn to_parts(&self) -> Result<Vec<Buffer>, String> {
        let reported = serde_json::to_string(&self.reported).map_err(|error| error.to_string())?;
        let row = Row::default()
            .text("error", self.error.as_deref().unwrap_or_default())
            .texts("ports", self.sent.iter().map(|(port, _)| port.as_str()))
            .list("wakes", Int64Array::from(self.wakes.clone()))
            .texts("counters", self.counts.iter().map(|(name, _)| name.as_str()))
            .list(
                "counts",
                UInt64Array::from_iter_values(self.counts.iter().map(|(_, n)| *n)),
            )
            .text("reported", &reported);
        let messages = self.sent.iter().enumerate();
        messages
            .fold(row, |row, (i, (_, message))| {
                row.put(&format!("message_{i}"), wire::to_arrow(message))
            })
            .into_parts()
    }

    /// What a program replied.
    ///
    /// # Errors
    /// Why the frame is no reply.
    pub fn from_bytes(bytes: Buffer) -> Result<Self, String> {
        let row = Received::from_bytes(bytes)?;
        let ports = row.texts("ports")?.into_iter().enumerate();
        let sent = ports.map(|(i, port)| Ok((port, message(&row, &format!("message_{i}"))?)));
        let sent = sent.collect::<Result<_, String>>()?;
        let (names, counts) = (row.texts("counters")?, row.u64s("counts")?);
        if names.len() != counts.len() {
            return Err(format!(
                "expected a count for each of {} counters, found {}",
                names.len(),
                counts.len()
            ));
        }
        let error = row.text("error")?;
        let reported =
            serde_json::from_str(row.text("reported")?).map_err(|error| format!("column `reported`: {error}"))?;
        Ok(Reply {
            reported,
            error: (!error.is_empty()).then(|| error.into()),
            sent,
            wakes: row.i64s("wakes")?,
            counts: names.into_iter().zip(counts).collect(),
        })
    }
}

fn message(row: &Received, column: &str) -> Result<Message, String> {
    let row: &dyn Array = row.struct_at(column)?;
    wire::from_arrow(row).map_err(|error| format!("`{column}` is not a realo message: {error}"))
}

#[cfg(test)]
#[path = "../../tests/common/replies.rs"]
mod replies;

#[cfg(test)]
mod tests {
    use super::replies::{boxes, reply, whole};
    use super::*;
    use crate::Meaning;

    fn frame(parts: Result<Vec<Buffer>, String>) -> Buffer {
        Buffer::from_vec(whole(parts))
    }

    #[test]
    fn calls_and_replies_come_back() {
        let (port, message) = ("ego".to_string(), Box::new(boxes("cav1", 1)));
        for call in [Call::Input { port, message }, Call::Wake, Call::End] {
            let (back, now) = Call::from_bytes(frame(call.to_parts(-7))).unwrap();
            assert_eq!((back, now), (call, -7));
        }
        for reply in [Reply::default(), reply(0), reply(9)] {
            assert_eq!(Reply::from_bytes(frame(reply.to_parts())).unwrap(), reply);
        }
    }

    #[test]
    fn losses_are_what_python_writes() {
        // As python/tests/test_operator.py has it.
        let words = r#"{"fates": [], "losses": {"late": {"meaning": "loss", "note": "boxes were late", "remedy": "wait longer",
            "agents": {"rsu1": {"count": 3, "of": 15}}}, "off": {"meaning": "log_fault", "note": "boxes have no pose", "remedy":
            "write poses", "agents": {"": {"count": 1, "of": 0}}}}}"#;
        let reported: Reported = serde_json::from_str(words).unwrap();
        let said = |counter: &str| {
            let loss = &reported.losses[counter];
            let agents = loss.worth_a_note().map(|(agent, share)| (agent, share.count, share.of));
            (loss.meaning, &*loss.note, agents.collect::<Vec<_>>())
        };
        assert_eq!(said("late"), (Meaning::Loss, "boxes were late", vec![("rsu1", 3, 15)]));
        assert_eq!(said("off"), (Meaning::LogFault, "boxes have no pose", vec![("", 1, 0)]));
    }

    #[test]
    fn says_what_a_reply_lacks() {
        let error = Reply::from_bytes(frame(Call::Wake.to_parts(0))).unwrap_err();
        assert!(error.contains("`ports`") && error.contains("it has: call"), "{error}");
        let error = Reply::from_bytes(Buffer::from(b"nonsense")).unwrap_err();
        assert!(error.contains("expected an Arrow stream"), "{error}");
    }
}

//! `metadata.yaml` of a bag of one file.

use realo_schemas::Nanos;

/// A topic of a bag.
pub struct Topic {
    /// Its name.
    pub name: String,
    /// Type of its messages, `package/msg/Type`.
    pub kind: String,
    /// How many there are.
    pub messages: u64,
}

/// The text, version 5, which rosbag2 of Humble writes and later ones read.
pub fn metadata(file: &str, topics: &[Topic], (first, last): (Nanos, Nanos)) -> String {
    let duration = last - first;
    let all: u64 = topics.iter().map(|topic| topic.messages).sum();
    let mut text = format!(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  duration:\n    nanoseconds: {duration}\n  \
         starting_time:\n    nanoseconds_since_epoch: {first}\n  message_count: {all}\n  topics_with_message_count:\n"
    );
    for Topic { name, kind, messages } in topics {
        text += &format!(
            "    - topic_metadata:\n        name: {name}\n        type: {kind}\n        serialization_format: cdr\n        \
             offered_qos_profiles: \"\"\n      message_count: {messages}\n"
        );
    }
    text += &format!(
        "  compression_format: \"\"\n  compression_mode: \"\"\n  relative_file_paths:\n    - {file}\n  files:\n    - path: {file}\n      \
         starting_time:\n        nanoseconds_since_epoch: {first}\n      duration:\n        nanoseconds: {duration}\n      \
         message_count: {all}\n"
    );
    text
}

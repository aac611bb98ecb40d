//! What rsu1 sends when it has features, boxes and a state for cav1.

use realo_schemas::Kind;

use super::{MS, SESSION, Seed, moment, offer, sends, station};

pub(super) fn seeds() -> Vec<Seed> {
    let mut rsu1 = station("rsu1", SESSION, false);
    rsu1.up(&"cav1".into(), moment(0));
    rsu1.offer(&offer(Kind::Features, 8, 1_500));
    rsu1.offer(&offer(Kind::Boxes, 1, 300));
    rsu1.offer(&offer(Kind::AgentState, 1, 200));
    let mut sent = sends(&mut rsu1, moment(0));
    sent.extend(sends(&mut rsu1, moment(600 * MS)));
    let seed = |(place, (topic, bytes)): (usize, (_, bytes::Bytes))| {
        Seed::open(topic, &format!("sent_{place}"), None, bytes.to_vec())
    };
    sent.into_iter().enumerate().map(seed).collect()
}

//! All poses of an agent, which label files have only at the sweeps: a table that other readers of the layout skip.

use std::fmt::Write;

use realo_logs::{Log, LogError, Stream};

/// The file, in the folder of the agent.
pub const FILE: &str = "poses.csv";

/// What the log has of the poses of an agent in its map, true ones and those that it believed, all digits kept.
///
/// # Errors
/// A log that cannot be read.
pub fn table(log: &Log, agent: &str) -> Result<String, LogError> {
    let mut text = "topic,stamp_ns,ready_ns,x,y,z,qx,qy,qz,qw\n".to_string();
    let wanted = [Stream::Pose, Stream::PoseTruth].map(|stream| (agent, stream));
    let wanted: Vec<_> = wanted
        .into_iter()
        .filter(|(agent, stream)| log.has(agent, *stream))
        .collect();
    let mut reader = log.read_all(&wanted)?;
    while let Some(entry) = reader.next()? {
        // What is no pose is counted when the log is played.
        let Ok(state) = entry.pose() else { continue };
        let [x, y, z] = state.map_from_body.translation.vector.into();
        let turn = state.map_from_body.rotation;
        let (topic, stamp, ready) = (entry.stream.as_str(), entry.stamp(), entry.ready());
        // Writing to a text does not fail.
        let _ = writeln!(
            text,
            "{topic},{stamp},{ready},{x},{y},{z},{},{},{},{}",
            turn.i, turn.j, turn.k, turn.w
        );
    }
    Ok(text)
}

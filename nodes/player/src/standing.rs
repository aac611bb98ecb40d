//! Roadside units that do not move: their pose holds where the log has none.

use realo_logs::{Entry, Log, LogError, MAX_GAP, Standing, Stream, is_posed};
use realo_schemas::{AgentState, Nanos};

/// Time between poses that are sent, ns.
pub const STEP: Nanos = 50_000_000;
/// After a hole in the log poses begin so long before the next message, ns.
const LEAD: Nanos = 500_000_000;

/// The pose of a unit, to be sent again and again.
pub struct Held {
    state: AgentState,
    next: Nanos,
    sent: u64,
}

impl Held {
    /// The pose of an agent that stands still and whose poses do not reach all of its sweeps.
    pub fn read(log: &Log, agent: &str, poses: Stream, from: Nanos) -> Result<Option<Self>, LogError> {
        let Some(standing) = Standing::read(log, agent, poses)? else {
            return Ok(None);
        };
        let lacks = lacks_poses(log, agent, &standing.stamps)?;
        Ok(lacks.then_some(Held {
            state: standing.state,
            next: from,
            sent: 0,
        }))
    }

    /// Begins another pass.
    pub fn rewind(&mut self, from: Nanos) {
        (self.next, self.sent) = (from, 0);
    }

    /// The next pose that is due until a time: its number, its time, and what it says.
    pub fn due(&mut self, until: Nanos) -> Option<(u64, Nanos, AgentState)> {
        if until.saturating_sub(self.next) > 2 * LEAD {
            self.next = until - LEAD;
        }
        (self.next <= until).then(|| {
            let due = (self.sent, self.next, self.state.clone());
            self.next += STEP;
            self.sent += 1;
            due
        })
    }
}

/// Whether a sweep has no pose, by its stamp or, of logs that say these beside the points alone, by the first and the last.
fn lacks_poses(log: &Log, agent: &str, poses: &[Nanos]) -> Result<bool, LogError> {
    let is_lost = |entry: &Entry| !is_posed(poses, entry.stamp(), MAX_GAP);
    if log.has(agent, Stream::Sweeps) {
        let mut reader = log.read_all(&[(agent, Stream::Sweeps)])?;
        while let Some(entry) = reader.next()? {
            if is_lost(&entry) {
                return Ok(true);
            }
        }
        return Ok(false);
    }
    if !log.has(agent, Stream::Points) {
        return Ok(false);
    }
    let first = log.read_all(&[(agent, Stream::Points)])?.next()?;
    let last = log.times(&Stream::Points.topic(agent))?.map_or(0, |(_, last)| last);
    let has_gaps = poses.array_windows().any(|[one, next]| next - one > MAX_GAP);
    let ends = poses.last().is_none_or(|pose| last.saturating_sub(*pose) > MAX_GAP);
    Ok(has_gaps || ends || first.is_some_and(|entry| is_lost(&entry)))
}

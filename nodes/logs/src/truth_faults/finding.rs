//! What is found, in words.

use std::fmt;

use super::{AHEAD, APART, MAX_OFFSET_M, ONE_IN, TRUTH_SHIFTED};

/// What is wrong with ground truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TruthFault {
    /// A track of both agents is of objects that lie more than 5 m apart, in the median so many m.
    Apart(f64),
    /// Parked objects are at other places by one agent than by the other, in the median so many m apart.
    Shifted(f64),
    /// An object that both agents have is of two tracks, or of none.
    Split,
    /// A track is of several objects of one message.
    Doubled,
    /// An object is there twice, under two tracks.
    Twice,
    /// The first agent's truth lacks objects ahead of it that the second one's has.
    Lacking,
}

/// A fault in the ground truth of one agent or two.
#[derive(Clone, Debug, PartialEq)]
pub struct TruthFinding {
    /// The agent, or both.
    pub agents: Vec<String>,
    /// What is wrong.
    pub fault: TruthFault,
    /// How often it was found.
    pub count: usize,
    /// Of how many positions of objects.
    pub of: usize,
}

impl fmt::Display for TruthFinding {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let TruthFinding { agents, count, of, .. } = self;
        let agents: Vec<String> = agents.iter().map(|agent| format!("`{agent}`")).collect();
        if self.fault == TruthFault::Lacking {
            let [own, other] = [0, 1].map(|index| agents.get(index).map(String::as_str).unwrap_or_default());
            return write!(
                f,
                "{count} of {of} objects that the truth of {other} has up to {AHEAD} m ahead of {own} are not in the truth of {own}: it \
                 must have all objects around {own}, those too that it does not see"
            );
        }
        let agents = agents.join(" and ");
        match self.fault {
            TruthFault::Twice => {
                return write!(
                    f,
                    "{count} of {of} objects in the truth of {agents} lie at the place of another one of their class: write each object once"
                );
            }
            TruthFault::Shifted(median) => {
                return write!(
                    f,
                    "{count} of {of} positions at which {agents} both have a parked object lie more than {MAX_OFFSET_M} m apart (median \
                     {median:.1} m): {}",
                    TRUTH_SHIFTED[1]
                );
            }
            TruthFault::Apart(median) => write!(
                f,
                "tracks of {agents} name different objects: of {of} positions of tracks that both have, {count} lie more than {APART} m \
                 apart (median {median:.1} m)"
            ),
            TruthFault::Split => write!(
                f,
                "{count} of {of} objects that {agents} both have are of two tracks or of none, so that points of one agent do not count \
                 for the object of the other"
            ),
            TruthFault::Doubled => write!(
                f,
                "{count} of {of} objects in the truth of {agents} have the track of another object of the same message"
            ),
            TruthFault::Lacking => Ok(()),
        }?;
        f.write_str("; give an object the same track in the truth of all agents, and no other object that track")
    }
}

pub(super) fn finding(agents: Vec<String>, fault: TruthFault, count: usize, of: usize) -> Option<TruthFinding> {
    (count * ONE_IN > of).then_some(TruthFinding {
        agents,
        fault,
        count,
        of,
    })
}

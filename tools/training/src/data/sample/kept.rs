//! Which beams and points of a sweep are kept.

use super::augmentation::Augmentation;
use crate::data::frame::{AgentSweep, Return};
use crate::random::Stream;

/// A beam is not dropped if so few would be left.
const FEWEST_BEAMS: usize = 16;

/// What is kept of a sweep: whole beams, and a share of their points by chance.
#[derive(Clone, Debug)]
pub(crate) struct Kept {
    /// By number of the beam; beams beyond are kept.
    pub(super) beams: Vec<bool>,
    pub(super) share: f64,
}

impl Kept {
    /// Everything.
    pub fn all() -> Self {
        Kept {
            beams: Vec::new(),
            share: 1.0,
        }
    }

    pub(super) fn draw(agent: &AgentSweep, share: f64, how: &Augmentation, draws: &mut Stream) -> Self {
        let mut kept = Kept {
            beams: Vec::new(),
            share,
        };
        let count = agent
            .points
            .iter()
            .map(|point| point.ring)
            .max()
            .map_or(0, |last| usize::from(last) + 1);
        if !draws.chance(how.drop_beams) || count < 2 * FEWEST_BEAMS {
            return kept;
        }
        kept.beams = match (draws.below(3), count / FEWEST_BEAMS) {
            (0, 4..) => every(4, count, draws),
            (0 | 1, _) => every(2, count, draws),
            _ => {
                let share = draws.between(0.5, 1.0);
                (0..count).map(|_| draws.chance(share)).collect()
            }
        };
        kept
    }

    pub(super) fn has(&self, point: &Return) -> bool {
        self.beams.get(usize::from(point.ring)).copied().unwrap_or(true)
    }

    /// Share of an agent's points that is kept.
    pub(super) fn of(&self, agent: &AgentSweep) -> f64 {
        let kept = agent.points.iter().filter(|point| self.has(point)).count();
        self.share * kept as f64 / agent.points.len().max(1) as f64
    }
}

/// Every n-th of so many beams.
fn every(n: usize, count: usize, draws: &mut Stream) -> Vec<bool> {
    let first = draws.below(n);
    (0..count).map(|beam| beam % n == first).collect()
}

//! The truth of a log's sweeps as a run would play it, and what the player counts meanwhile.

use std::path::Path;

use eyre::{Result, eyre};
use realo_operator::{Describe, Source};
use realo_player::{Output, Player, Settings};
use realo_results::NodeSummary;
use realo_schemas::{GroundTruth, Header};

/// Plays a log without its points.
pub struct TruthReader(Player);

impl TruthReader {
    /// `agents`: who may take part; all if empty.
    ///
    /// # Errors
    /// A log that cannot be played for this ego.
    pub fn open(log: &Path, ego: &str, agents: &[String]) -> Result<Self> {
        let config = Settings {
            log: log.into(),
            ego: ego.into(),
            agents: agents.to_vec(),
            points: false,
            ..Settings::default()
        };
        Player::new(config).map(TruthReader).map_err(|error| eyre!(error))
    }

    /// The truth of the ego's next sweep, in its true body frame; `None` at the end.
    ///
    /// # Errors
    /// Messages that cannot be read.
    pub fn next(&mut self) -> Result<Option<(Header, GroundTruth)>> {
        while let Some((_, output)) = Source::next(&mut self.0).map_err(|error| eyre!(error))? {
            if let Output::Truth(header, truth) = output {
                return Ok(Some((header, truth)));
            }
        }
        Ok(None)
    }

    /// What was lost so far, by the name of the node that counts it.
    pub fn losses(&self) -> (String, NodeSummary) {
        (
            Player::NAME.into(),
            NodeSummary::of_losses(Player::NAME, self.0.counts()),
        )
    }
}

//! What was exported, in words.

use std::fmt;
use std::path::PathBuf;

/// What was written, and what could not be.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Exported {
    /// The layout.
    pub kind: &'static str,
    /// The folder.
    pub path: PathBuf,
    /// Bytes of all files.
    pub bytes: u64,
    /// What was written of each agent.
    pub agents: Vec<ExportedAgent>,
    /// What was assumed, a line each.
    pub assumed: Vec<String>,
    /// Sweeps that were left out, with why, a line each.
    pub left_out: Vec<String>,
    /// What of the log the layout does not hold, a line each.
    pub lost: Vec<String>,
    /// The command that reads it back.
    pub read_back: String,
}

/// What was written of an agent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExportedAgent {
    /// Its name in the log.
    pub name: String,
    /// Where it is in the folder, in words.
    pub place: String,
    /// Height of its LiDAR over the ground, m; `None` of a layout without points.
    pub height_m: Option<f64>,
    /// Sweeps.
    pub sweeps: usize,
    /// Points of all sweeps.
    pub points: usize,
    /// Boxes of all sweeps.
    pub boxes: usize,
}

impl fmt::Display for Exported {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let megabytes = self.bytes as f64 / 1e6;
        writeln!(f, "{}: layout `{}`, {megabytes:.1} MB", self.path.display(), self.kind)?;
        for agent in &self.agents {
            let ExportedAgent {
                name,
                place,
                height_m,
                sweeps,
                points,
                boxes,
            } = agent;
            match height_m {
                Some(height) => writeln!(
                    f,
                    "  {name}: {place}, {sweeps} sweeps, {points} points, {boxes} boxes, LiDAR {height:.2} m over the ground"
                )?,
                None => writeln!(f, "  {name}: {place}, {sweeps} messages, {boxes} boxes")?,
            }
        }
        let parts = [
            ("assumed", &self.assumed),
            ("left out", &self.left_out),
            ("the layout does not hold", &self.lost),
        ];
        for (title, lines) in parts.iter().filter(|(_, lines)| !lines.is_empty()) {
            writeln!(f, "{title}:")?;
            lines.iter().try_for_each(|line| writeln!(f, "  {line}"))?;
        }
        write!(f, "read it back: {}", self.read_back)
    }
}

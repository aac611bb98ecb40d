//! How the fields of a topic's clouds are read: decided by its first clouds.

use realo_logs::cloud::{CloudReader, Look, TimeRule};
use realo_logs::intensity_scale;

/// Clouds that are looked at.
const LOOKED_AT: usize = 8;

/// What the first clouds showed.
#[derive(Default)]
pub struct Heads {
    looks: Vec<Look>,
    brightest: f32,
    seen: usize,
    decided: Option<(f32, Option<TimeRule>)>,
}

impl Heads {
    /// What intensities are multiplied by, and how times are read. The first clouds are read by what is known so far.
    ///
    /// # Errors
    /// Times that nothing explains.
    pub fn of(&mut self, reader: &CloudReader) -> Result<(f32, Option<TimeRule>), String> {
        if let Some(decided) = self.decided {
            return Ok(decided);
        }
        self.looks.extend(reader.look());
        self.brightest = self.brightest.max(reader.brightest().unwrap_or(0.0));
        self.seen += 1;
        let scale = intensity_scale(reader.intensity().unwrap_or_default(), self.brightest);
        let times = reader.time_rule(&self.looks);
        if self.seen >= LOOKED_AT {
            match &times {
                Ok(times) => self.decided = Some((scale, *times)),
                // One strange cloud does not spoil those that come.
                Err(_) => (self.looks, self.seen) = (Vec::new(), 0),
            }
        }
        Ok((scale, times?))
    }
}

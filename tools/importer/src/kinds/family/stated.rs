//! What label files say that the layout leaves open: keys that `realo-lab export` writes, and other readers skip.

use realo_logs::check_agent_name;
use serde_yaml::Value;

use super::frame_file::FrameFile;
use crate::ImportError;
use crate::scenes::Stated;
use crate::yaml::{numbers, text, what};

/// Key of the agent's name.
const NAME: &str = "agent_name";
/// Key of the height of the LiDAR over the ground, m.
const HEIGHT: &str = "lidar_height";
/// Key of the stamp of the sweep, ns since 1970.
const STAMP: &str = "stamp_ns";
/// Key of the outline of the agent in its body frame, m.
const FOOTPRINT: &str = "footprint";
/// No LiDAR is higher, m.
const MOST_HEIGHT: f64 = 50.0;
/// No outline reaches farther, m.
const MOST_REACH: f64 = 30.0;

impl FrameFile {
    /// The name of the agent, where the file says it.
    ///
    /// # Errors
    /// One that cannot name an agent.
    pub fn agent_name(&self) -> Result<Option<String>, ImportError> {
        let Some(value) = self.document.get(NAME) else {
            return Ok(None);
        };
        let name = text(value);
        match check_agent_name(&name) {
            Ok(()) => Ok(Some(name)),
            Err(reason) => Err(self.document.error(format!(
                "{NAME}: {reason}; or remove the key from all files of the agent"
            ))),
        }
    }

    /// All that it says of the sweep.
    ///
    /// # Errors
    /// What cannot be.
    pub fn stated(&self) -> Result<Stated, ImportError> {
        Ok(Stated {
            height: self.number(HEIGHT, &format!("0 to {MOST_HEIGHT} m"), height)?,
            stamp: self.number(STAMP, "a whole number of ns since 1970", stamp)?,
            footprint: self.number(
                FOOTPRINT,
                &format!("[x min, x max, y min, y max] in m within ±{MOST_REACH}, each pair rising"),
                outline,
            )?,
        })
    }

    fn number<T>(
        &self,
        key: &str,
        expected: &str,
        read: impl FnOnce(&Value) -> Option<T>,
    ) -> Result<Option<T>, ImportError> {
        let Some(value) = self.document.get(key) else {
            return Ok(None);
        };
        read(value).map(Some).ok_or_else(|| {
            let found = what(value);
            self.document.error(format!(
                "{key}: expected {expected}, found {found}; correct it, or remove the key"
            ))
        })
    }
}

fn height(value: &Value) -> Option<f64> {
    value.as_f64().filter(|height| (0.0..=MOST_HEIGHT).contains(height))
}

fn stamp(value: &Value) -> Option<i64> {
    value.as_i64().filter(|stamp| *stamp >= 0)
}

fn outline(value: &Value) -> Option<[f64; 4]> {
    let outline: [f64; 4] = numbers(value).ok()?.try_into().ok()?;
    let is_near = outline.iter().all(|metres| metres.abs() <= MOST_REACH);
    let [x0, x1, y0, y1] = outline;
    (is_near && x0 < x1 && y0 < y1).then_some(outline)
}

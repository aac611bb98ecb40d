//! What the first sweeps of an agent say of all of them: how bright they are, and how high the LiDAR is.

use realo_schemas::geometry::level_from_body;

use super::{Layout, RawSweep, Scene, SceneAgent, Stated};
use crate::clouds::{Brightest, LOOKED_AT};
use crate::level::{BELOW_A_SENSOR, Level, Plane};
use crate::{ImportError, Options};

/// Sweeps in which the ground is looked for.
const GROUNDS: usize = 3;

/// What is known of an agent.
#[derive(Default)]
pub struct Known {
    /// How its intensities become bytes.
    pub brightest: Brightest,
    /// Height of its LiDAR over the ground, m; 0 where its frames are levelled by the ground of each sweep.
    pub height: f64,
    /// How times of its points are read, in words, where its files leave that open.
    pub times: Option<String>,
    /// Its outline, m, where its files say it.
    pub footprint: Option<[f64; 4]>,
    /// What its files say besides what all do, in words.
    pub said: Vec<&'static str>,
}

impl Known {
    /// Reads the first sweeps of an agent; what cannot be read is reported where all sweeps are read.
    ///
    /// # Errors
    /// No ground, where its height is needed.
    pub fn of(layout: &dyn Layout, scene: &Scene, agent: &SceneAgent, options: &Options) -> Result<Self, ImportError> {
        let (mut heights, mut reason) = (Vec::new(), None);
        let mut brightest = Brightest::of_range(options.intensity_range);
        let (mut by_files, mut times) = (Stated::default(), None);
        let wanted = agent.sweeps.iter().filter(|(number, _)| options.wants_frame(**number));
        let needs_ground = options.level != Level::Ground && options.height_m.is_none();
        for (_, files) in wanted.take(LOOKED_AT) {
            let Ok(sweep) = layout.sweep(files, options) else {
                continue;
            };
            brightest.look_at(&sweep.points.intensity, &sweep.points.intensity_from);
            times = times.or_else(|| sweep.points.times.clone());
            by_files = by_files.or(sweep.stated);
            if needs_ground && by_files.height.is_none() && heights.len() < GROUNDS {
                match height(&sweep, options.level) {
                    Ok(height) => heights.push(height),
                    Err(error) => reason = Some((files.cloud.clone(), error)),
                }
            }
        }
        heights.sort_by(f64::total_cmp);
        let stated = options.height_m.or(by_files.height.filter(|_| needs_ground));
        let height = match (stated, heights.get(heights.len() / 2), reason) {
            (Some(height), ..) => height,
            (None, Some(height), _) => *height,
            (None, None, Some((cloud, reason))) => {
                let (agent, scene) = (&agent.name, &scene.name);
                let reason = format!(
                    "height of the LiDAR of `{agent}` in scene `{scene}`: {reason}, or give it, as --height 1.9, which is then that of all LiDARs"
                );
                return Err(ImportError::content(&cloud, reason));
            }
            (None, None, None) => 0.0,
        };
        let said = [
            (by_files.stamp.is_some(), "stamps"),
            (by_files.footprint.is_some(), "outlines"),
            (by_files.height.is_some_and(|said| said == height), "heights of LiDARs"),
        ];
        Ok(Known {
            brightest,
            height,
            times,
            footprint: by_files.footprint,
            said: said
                .into_iter()
                .filter(|(is_said, _)| *is_said)
                .map(|(_, word)| word)
                .collect(),
        })
    }
}

impl Stated {
    /// With what another sweep of the agent says, where this one does not.
    fn or(self, other: Stated) -> Stated {
        Stated {
            height: self.height.or(other.height),
            stamp: self.stamp.or(other.stamp),
            footprint: self.footprint.or(other.footprint),
        }
    }
}

/// Height of a LiDAR over the ground, m.
fn height(sweep: &RawSweep, level: Level) -> Result<f64, String> {
    let level_from_lidar = match level {
        Level::Pose => level_from_body(&sweep.map_from_lidar.rotation),
        Level::Ground | Level::None => nalgebra::UnitQuaternion::identity(),
    };
    let points = &sweep.points;
    let points = points.x.iter().zip(&points.y).zip(&points.z);
    let points = points.map(|((x, y), z)| (level_from_lidar * nalgebra::Vector3::new(*x, *y, *z)).into());
    Ok(-Plane::of_ground(points, BELOW_A_SENSOR)?.offset)
}

//! What of a sweep goes on.

use std::ops::Range;

use realo_schemas::PointCloud;
use realo_schemas::geometry::Motion;

/// The part of the ground plane that an agent's own body covers, in its body frame, m; bounds inclusive, any height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OwnBody {
    /// Along x.
    pub x: [f32; 2],
    /// Along y.
    pub y: [f32; 2],
}

impl OwnBody {
    /// What V2X-Real leaves out.
    pub const V2X_REAL: OwnBody = OwnBody {
        x: [-1.95, 2.95],
        y: [-1.1, 1.1],
    };

    fn contains(&self, x: f32, y: f32) -> bool {
        x >= self.x[0] && x <= self.x[1] && y >= self.y[0] && y <= self.y[1]
    }
}

/// A sweep without what does not belong to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Cleaned {
    /// The points.
    pub cloud: PointCloud,
    /// Points whose coordinates were not finite.
    pub nan: u64,
    /// Points on the agent itself.
    pub own_body: u64,
}

/// Drops points that are not finite or on the agent's own body, and moves the others to the body frame at the stamp.
///
/// The own body is looked for before points are moved: it keeps its place in the body frame at each point's own time.
/// Columns that stay as they are are shared, not copied.
pub fn clean(cloud: &PointCloud, own_body: Option<OwnBody>, motion: Option<&Motion>) -> Cleaned {
    let Kept { runs, nan, own_body } = keep(cloud, own_body);
    let cloud = match runs[..] {
        [ref all] if all.len() == cloud.len() => cloud.clone(),
        _ => PointCloud {
            x: pick(&cloud.x, &runs).into(),
            y: pick(&cloud.y, &runs).into(),
            z: pick(&cloud.z, &runs).into(),
            intensity: pick(&cloud.intensity, &runs).into(),
            time: pick(&cloud.time, &runs).into(),
            ring: pick(&cloud.ring, &runs).into(),
        },
    };
    let cloud = match motion {
        None => cloud,
        Some(motion) => {
            let [x, y, z] = motion.at_stamp([&cloud.x, &cloud.y, &cloud.z], &cloud.time);
            PointCloud {
                x: x.into(),
                y: y.into(),
                z: z.into(),
                ..cloud
            }
        }
    };
    Cleaned { cloud, nan, own_body }
}

/// Which points stay, as runs of indices.
struct Kept {
    runs: Vec<Range<usize>>,
    nan: u64,
    own_body: u64,
}

fn keep(cloud: &PointCloud, body: Option<OwnBody>) -> Kept {
    let (mut runs, mut nan, mut own_body, mut start) = (Vec::new(), 0, 0, 0);
    for (at, ((x, y), z)) in cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter()).enumerate() {
        let finite = x.is_finite() & y.is_finite() & z.is_finite();
        let own = body.is_some_and(|body| body.contains(*x, *y));
        if finite & !own {
            continue;
        }
        // A point that is no number is none of the body's either.
        nan += u64::from(!finite);
        own_body += u64::from(finite);
        if start < at {
            runs.push(start..at);
        }
        start = at + 1;
    }
    if start < cloud.len() {
        runs.push(start..cloud.len());
    }
    Kept { runs, nan, own_body }
}

fn pick<T: Copy>(column: &[T], runs: &[Range<usize>]) -> Vec<T> {
    let mut picked = Vec::with_capacity(runs.iter().map(Range::len).sum());
    runs.iter()
        .for_each(|run| picked.extend_from_slice(&column[run.clone()]));
    picked
}

#[cfg(test)]
mod tests {
    use super::*;

    const BODY: OwnBody = OwnBody::V2X_REAL;

    fn cloud(points: &[[f32; 3]]) -> PointCloud {
        let column = |i: usize| points.iter().map(|p| p[i]).collect::<Vec<f32>>();
        let n = points.len();
        let numbers: Vec<u8> = (0..n as u8).collect();
        PointCloud::new(column(0), column(1), column(2), numbers, vec![0; n], vec![0u16; n]).unwrap()
    }

    #[test]
    fn drops_points_that_are_no_numbers_or_on_the_own_body() {
        let points = [
            [10.0, 0.0, 0.0],
            [f32::NAN, 0.0, 0.0],
            [5.0, f32::INFINITY, 0.0],
            [5.0, 0.0, f32::NEG_INFINITY],
            [2.95, 1.1, 99.0],
            [-1.95, -1.1, -99.0],
            [2.951, 0.0, 0.0],
            [0.0, -1.101, 0.0],
        ];
        let cleaned = clean(&cloud(&points), Some(BODY), None);
        assert_eq!((cleaned.nan, cleaned.own_body), (3, 2));
        assert_eq!(cleaned.cloud.intensity.to_vec(), [0, 6, 7]);
        assert_eq!(cleaned.cloud.x.to_vec(), [10.0, 2.951, 0.0]);
        assert_eq!(clean(&cloud(&points), None, None).own_body, 0);
    }

    #[test]
    fn columns_of_a_clean_cloud_are_shared() {
        let cloud = cloud(&[[10.0, 0.0, 0.0], [11.0, 0.0, 0.0]]);
        let cleaned = clean(&cloud, Some(BODY), None);
        assert_eq!(cleaned.cloud, cloud);
        assert_eq!(cleaned.cloud.time.inner().as_ptr(), cloud.time.inner().as_ptr());
    }

    #[test]
    fn an_empty_cloud_stays_empty() {
        let cleaned = clean(&PointCloud::empty(), Some(BODY), None);
        assert_eq!(
            cleaned,
            Cleaned {
                cloud: PointCloud::empty(),
                nan: 0,
                own_body: 0
            }
        );
    }
}

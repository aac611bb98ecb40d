//! What of a sweep goes on.

use realo_schemas::PointCloud;

use crate::Motion;

/// The part of the ground plane that an agent's own body covers, in its body frame, m; bounds inclusive, any height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OwnBody {
    /// Along x.
    pub x: [f32; 2],
    /// Along y.
    pub y: [f32; 2],
}

impl OwnBody {
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
pub fn clean(cloud: &PointCloud, own_body: Option<OwnBody>, motion: Option<&Motion>) -> Cleaned {
    let n = cloud.len();
    let (mut x, mut y, mut z) = (Vec::with_capacity(n), Vec::with_capacity(n), Vec::with_capacity(n));
    let (mut intensity, mut time, mut ring) = (Vec::with_capacity(n), Vec::with_capacity(n), Vec::with_capacity(n));
    let (mut nan, mut own) = (0, 0);
    let points = cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter());
    let rest = cloud.intensity.iter().zip(cloud.time.iter()).zip(cloud.ring.iter());
    for (((px, py), pz), ((pi, pt), pr)) in points.zip(rest) {
        // Not finite if any of them is not.
        if !(px.is_finite() & py.is_finite() & pz.is_finite()) {
            nan += 1;
            continue;
        }
        if own_body.is_some_and(|body| body.contains(*px, *py)) {
            own += 1;
            continue;
        }
        let point = [*px, *py, *pz];
        let [mx, my, mz] = motion.map_or(point, |motion| motion.at_stamp(point, *pt));
        x.push(mx);
        y.push(my);
        z.push(mz);
        intensity.push(*pi);
        time.push(*pt);
        ring.push(*pr);
    }
    let (x, y, z) = (x.into(), y.into(), z.into());
    let cloud = PointCloud {
        x,
        y,
        z,
        intensity: intensity.into(),
        time: time.into(),
        ring: ring.into(),
    };
    Cleaned {
        cloud,
        nan,
        own_body: own,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BODY: OwnBody = OwnBody {
        x: [-1.95, 2.95],
        y: [-1.1, 1.1],
    };

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

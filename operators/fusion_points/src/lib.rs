//! Early fusion: brings the points of selected collaborators to the ego's body frame and puts them behind the ego's own.
//!
//! The transform is `ego_from_sender` of the two stamps, from the poses in the headers; times are offsets from the ego's
//! stamp. The motion of objects between the stamps is not removed.

use realo_fusion::{Collaborator, Input, Pairing, Set};
use realo_operator::{Counter, Describe, Error, Operator, Outputs, Settings};
use realo_schemas::geometry::transform_cloud;
use realo_schemas::{Header, Nanos, PointCloud};
use serde::{Deserialize, Serialize};

/// No LiDAR sees further, m: sweeps that have all points beyond are in another unit or frame.
const REACH: f32 = 300.0;

const EMPTY_SWEEPS: Counter = Counter::log_fault(
    "empty_sweeps",
    "sweeps that have no point within 300 m of the ego, so that they add nothing",
    "sweeps have no point within 300 m of the ego, so that they added nothing",
    "points are expected in metres, in the body frame of their agent (docs/reference/log-format.md)",
);

/// Settings of [`FusionPoints`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Collaborators that a fusion takes, the nearest to the ego; null = all.
    pub max_collaborators: Option<usize>,
    /// Points that the sender projected stay where it put them; the ego's motion since is not removed.
    pub as_sent: bool,
}

/// One cloud of the ego's points and, behind them, the collaborators' in the ego's frame.
///
/// `stamp`: the ego's, ns. With `as_sent` their points stay where they are.
pub fn merge(ego: &PointCloud, stamp: Nanos, collaborators: &[Collaborator<PointCloud>], as_sent: bool) -> PointCloud {
    if collaborators.is_empty() {
        return ego.clone();
    }
    let placed: Vec<PointCloud> = collaborators
        .iter()
        .map(|collaborator| {
            let cloud = if as_sent {
                collaborator.payload.clone()
            } else {
                transform_cloud(&collaborator.ego_from_sender, &collaborator.payload)
            };
            later(cloud, collaborator.header.stamp - stamp)
        })
        .collect();
    let all = || std::iter::once(ego).chain(&placed);
    PointCloud {
        x: joined(all().map(|cloud| &cloud.x[..])).into(),
        y: joined(all().map(|cloud| &cloud.y[..])).into(),
        z: joined(all().map(|cloud| &cloud.z[..])).into(),
        intensity: joined(all().map(|cloud| &cloud.intensity[..])).into(),
        time: joined(all().map(|cloud| &cloud.time[..])).into(),
        ring: joined(all().map(|cloud| &cloud.ring[..])).into(),
    }
}

fn joined<'a, T: Copy + 'a>(columns: impl Iterator<Item = &'a [T]>) -> Vec<T> {
    columns.collect::<Vec<_>>().concat()
}

/// The cloud with times that count from `by` ns earlier.
fn later(cloud: PointCloud, by: Nanos) -> PointCloud {
    let clamp = |time: Nanos| time.clamp(i32::MIN.into(), i32::MAX.into()) as i32;
    let time: Vec<i32> = cloud.time.iter().map(|time| clamp(Nanos::from(*time) + by)).collect();
    PointCloud {
        time: time.into(),
        ..cloud
    }
}

/// Counts the sweeps of a set that have no point within reach of the ego.
fn count_empty(set: &Set<PointCloud>, merged: &PointCloud, out: &mut Outputs<Output>) {
    let others = set
        .collaborators
        .iter()
        .map(|other| (&other.header.agent, &other.payload));
    let mut first = 0;
    for (agent, cloud) in std::iter::once((&set.header.agent, &set.ego)).chain(others) {
        let own = first..first + cloud.len();
        first = own.end;
        let near = |i: usize| [merged.x[i], merged.y[i]].iter().all(|metres| metres.abs() < REACH);
        let is_empty = !own.clone().any(near);
        out.count_of(&EMPTY_SWEEPS, agent, u64::from(is_empty), 1);
        if is_empty {
            out.found(&EMPTY_SWEEPS, agent, || match own.len() {
                0 => "the first has no points".into(),
                all => format!("the first has {all} points, all beyond or not finite"),
            });
        }
    }
}

/// Early fusion: brings collaborators' points to the ego's frame, behind its own.
#[derive(Describe)]
#[stage(input = Input<PointCloud>, counters(realo_fusion::OVER_LIMIT_MESSAGES, realo_fusion::REJECTED_MESSAGES, realo_fusion::OTHER_LEVEL, EMPTY_SWEEPS))]
pub struct FusionPoints {
    settings: Settings,
    pairing: Pairing<PointCloud>,
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The ego's points, then the collaborators', in the ego's frame.
    Clouds(Header, PointCloud),
}

impl Operator for FusionPoints {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(FusionPoints {
            settings,
            pairing: Pairing::default(),
        })
    }

    fn on_input(&mut self, input: Input<PointCloud>, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Some(mut set) = self.pairing.take(input, self.settings.max_collaborators)? else {
            return Ok(());
        };
        if self.settings.as_sent {
            set.reject_other_frames();
        }
        let merged = merge(&set.ego, set.header.stamp, &set.collaborators, self.settings.as_sent);
        count_empty(&set, &merged, out);
        set.send(Output::Clouds, merged, out);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
    use realo_engine::testkit::FusionCase;
    use realo_schemas::report::Fate;
    use realo_schemas::{Boxes, Kind, Message, Pose, Selection};

    use super::*;

    const MS: Nanos = 1_000_000;

    fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(x, y, 12.0),
            UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
        )
    }

    fn cloud(points: &[[f32; 3]]) -> PointCloud {
        let column = |axis: usize| points.iter().map(|p| p[axis]).collect::<Vec<f32>>();
        let n = points.len();
        PointCloud::new(column(0), column(1), column(2), vec![9; n], vec![100; n], vec![1u16; n]).unwrap()
    }

    fn header(agent: &str, seq: u64, stamp: Nanos, map_from_body: Option<Isometry3<f64>>) -> Header {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Points, seq, stamp, stamp + 50 * MS);
        header.pose = map_from_body.map(Pose::exact);
        header.to = Some("cav1".into());
        header
    }

    /// Who, and what became of its message.
    type Reported = Vec<(String, Fate)>;

    /// Feeds one set of an ego 100 km from the map's origin.
    fn fuse(settings: Settings, entries: Vec<Message>) -> (PointCloud, Reported) {
        let mut operator = FusionPoints::new(settings).unwrap();
        let mut out = Outputs::at(200 * MS);
        let ego = header("cav1", 7, 100 * MS, Some(pose(1e5, -1e5, 0.4)));
        let sweep = Message::new(ego.clone(), cloud(&[[1.0, 2.0, 3.0]]));
        let selection = Message::new(ego, Selection { query: 7, entries });
        operator.on_message(Input::<PointCloud>::EGO, sweep, &mut out).unwrap();
        operator
            .on_message(Input::<PointCloud>::SELECTIONS, selection, &mut out)
            .unwrap();
        let mut sent = out.take_sent().into_iter();
        let (port, merged) = sent.next().unwrap();
        assert_eq!(
            (port, merged.header.kind, merged.header.seq),
            (Output::CLOUDS, Kind::Points, 7)
        );
        assert!(sent.next().is_none());
        let reported = out
            .take_fates()
            .into_iter()
            .map(|fated| (fated.message.from, fated.fate));
        (merged.into_parts().unwrap().1, reported.collect())
    }

    fn reported<const N: usize>(expected: [(&str, Fate); N]) -> Reported {
        expected.map(|(agent, fate)| (agent.to_string(), fate)).into()
    }

    #[test]
    fn points_of_collaborators_follow_in_the_egos_frame_by_name() {
        let map_from_ego = pose(1e5, -1e5, 0.4);
        let still = Point3::new(1e5 + 20.0, -1e5 + 5.0, 13.0);
        let seen_from = |map_from_body: Isometry3<f64>| {
            let point = map_from_body.inverse() * still;
            cloud(&[[point.x as f32, point.y as f32, point.z as f32]])
        };
        let (near, far) = (pose(1e5 + 10.0, -1e5, 2.0), pose(1e5 + 40.0, -1e5 + 30.0, -1.0));
        let entries = vec![
            Message::new(header("rsu1", 3, 60 * MS, Some(far)), seen_from(far)),
            Message::new(header("cav2", 3, 101 * MS, Some(near)), seen_from(near)),
        ];
        let (merged, fates) = fuse(Settings::default(), entries);
        let both = reported([("cav2", Fate::Used), ("rsu1", Fate::Used)]);
        assert_eq!((merged.len(), fates), (3, both));
        assert_eq!([merged.x[0], merged.y[0], merged.z[0]], [1.0, 2.0, 3.0]);
        let expected = map_from_ego.inverse() * still;
        for i in [1, 2] {
            let off = (Point3::new(merged.x[i], merged.y[i], merged.z[i]).cast::<f64>() - expected).norm();
            assert!(off < 1e-4, "{off} m");
        }
        assert_eq!(merged.time.to_vec(), [100, 100 + 1_000_000, 100 - 40_000_000]);
    }

    #[test]
    fn projected_points_stay_where_the_sender_put_them() {
        let far = pose(1e5 + 40.0, -1e5 + 30.0, -1.0);
        let mut projected = header("rsu1", 3, 60 * MS, Some(far));
        projected.frame = header("cav1", 0, 0, None).frame;
        let not_projected = header("rsu2", 3, 60 * MS, Some(far));
        let entries = vec![
            Message::new(projected, cloud(&[[5.0, 6.0, 7.0]])),
            Message::new(not_projected, cloud(&[[8.0, 9.0, 9.0]])),
        ];
        let settings = Settings {
            as_sent: true,
            ..Settings::default()
        };
        let (merged, fates) = fuse(settings, entries);
        assert_eq!([merged.x[1], merged.y[1], merged.z[1]], [5.0, 6.0, 7.0]);
        let expected = reported([("rsu1", Fate::Used), ("rsu2", Fate::Rejected)]);
        assert_eq!((merged.len(), fates), (2, expected), "rsu2 did not project");
    }

    #[test]
    fn sweeps_that_add_nothing_are_counted_by_agent() {
        let ego = header("cav1", 7, 100 * MS, Some(pose(0.0, 0.0, 0.0)));
        let sender = |agent| header(agent, 3, 60 * MS, Some(pose(0.0, 0.0, 0.0)));
        let entries = vec![
            Message::new(sender("good"), cloud(&[[f32::NAN; 3], [5.0, 1.0, 0.0]])),
            Message::new(sender("millimetres"), cloud(&[[5000.0, 1000.0, 0.0]])),
            Message::new(sender("none"), cloud(&[])),
        ];
        let mut operator = FusionPoints::new(Settings::default()).unwrap();
        let mut out = Outputs::at(200 * MS);
        operator
            .on_message(
                Input::<PointCloud>::EGO,
                Message::new(ego.clone(), cloud(&[[f32::NAN; 3]])),
                &mut out,
            )
            .unwrap();
        operator
            .on_message(
                Input::<PointCloud>::SELECTIONS,
                Message::new(ego, Selection { query: 7, entries }),
                &mut out,
            )
            .unwrap();
        assert_eq!(out.counted("empty_sweeps"), 3);
    }

    #[test]
    fn the_ego_alone_is_its_own_cloud() {
        let (merged, _) = fuse(Settings::default(), Vec::new());
        assert_eq!(merged, cloud(&[[1.0, 2.0, 3.0]]));
    }

    #[test]
    fn who_is_over_the_limit_or_cannot_be_placed_is_reported() {
        let entries = vec![
            Message::new(header("cav2", 3, 60 * MS, None), cloud(&[[0.0; 3]])),
            Message::new(header("rsu1", 3, 60 * MS, Some(pose(0.0, 0.0, 0.0))), Boxes(Vec::new())),
            Message::new(
                header("rsu2", 3, 60 * MS, Some(pose(1e5, -1e5, 0.0))),
                cloud(&[[0.0; 3]]),
            ),
            Message::new(
                header("rsu3", 3, 60 * MS, Some(pose(1e5, -1e5, 0.0))),
                cloud(&[[0.0; 3]]),
            ),
        ];
        let settings = Settings {
            max_collaborators: Some(1),
            ..Settings::default()
        };
        let (merged, fates) = fuse(settings, entries);
        assert_eq!(merged.len(), 2);
        let expected = reported([
            ("rsu2", Fate::Used),
            ("cav2", Fate::Rejected),
            ("rsu1", Fate::Rejected),
            ("rsu3", Fate::OverLimit),
        ]);
        assert_eq!(fates, expected);
    }

    #[test]
    fn holds_what_every_fusion_owes_its_graph() {
        let at = |agent, x| {
            let header = header(agent, 3, 60 * MS, Some(pose(1e5 + x, -1e5, 0.3)));
            Message::new(header, cloud(&[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
        };
        let own = cloud(&[[1.0, 2.0, 3.0]]);
        let case = FusionCase {
            args: vec![],
            ego: Message::new(header("cav1", 7, 100 * MS, Some(pose(1e5, -1e5, 0.4))), own.clone()),
            entries: vec![at("rsu1", 20.0), at("cav2", -7.0)],
            alone: own.into(),
        };
        case.check::<FusionPoints>();
    }
}

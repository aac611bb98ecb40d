//! One message of a selection on its way through the guard.

use nalgebra::{Isometry3, Matrix3, Matrix6, Translation3, Vector2};
use realo_assignment::AssignmentError;
use realo_schemas::geometry::{relative, yaw_of};
use realo_schemas::{Box3, Boxes, Header, Message, Name, Nanos, Payload, Pose, from_seconds, to_seconds};

use crate::boxes::{Ego, Judgement, Limits, Origin, Said, judge};
use crate::constellation::lay_over;
use crate::fit::Stated;
use crate::map_boxes::{MapContent, without_cells_of};
use crate::objects::{Object, objects};
use crate::overlay::judge_points;
use crate::record::Record;
use crate::shift::Shift;
use crate::sight::Sight;
use crate::verdict::Reason;

/// A message that came with a selection.
pub(crate) struct Entry {
    message: Message,
    /// What its map shows, where that was looked for.
    shown: Option<MapContent>,
    origin: Option<Origin>,
    had_no_pose: bool,
    had_wrong_covariance: bool,
}

/// The same with what was found of it.
pub(crate) struct Guarded {
    entry: Entry,
    judgement: Option<Judgement>,
}

impl Entry {
    /// Takes a message and what its map shows. Without a pose it is placed by the ego's objects, if `constellations` is set.
    ///
    /// # Errors
    /// [`AssignmentError`] for more objects than an assignment takes.
    pub fn of(
        ego: &Header,
        mut message: Message,
        shown: Option<MapContent>,
        known: &[Object],
        limits: &Limits,
        constellations: bool,
    ) -> Result<Self, AssignmentError> {
        let had_wrong_covariance = drop_wrong_covariance(&mut message.header);
        let ego_pose = ego.pose.as_ref();
        let map_from_ego = ego_pose.map(|pose| pose.map_from_frame);
        let had_no_pose = message.header.pose.is_none();
        if let (true, true, Some(map_from_ego), Some(boxes)) = (
            had_no_pose,
            constellations,
            map_from_ego,
            boxes(&message.payload, shown.as_ref()),
        ) {
            let theirs = objects(boxes, &Isometry3::identity(), 0.0, limits.max_boxes);
            if let Some(fit) = lay_over(known, &theirs, &limits.noise)? {
                message.header.pose = Some(Pose::exact(map_from_ego * fit.shift.isometry()));
            }
        }
        let origin = ego_pose.and_then(|pose| origin(pose, ego.stamp, &message.header));
        Ok(Entry {
            had_no_pose: had_no_pose && origin.is_some(),
            origin,
            message,
            shown,
            had_wrong_covariance,
        })
    }

    /// What is found of it.
    ///
    /// # Errors
    /// [`AssignmentError`] for more objects than an assignment takes.
    pub fn judge(self, ego: &Sight, record: Record, limits: &Limits) -> Result<Guarded, AssignmentError> {
        let payload = &self.message.payload;
        let said = boxes(payload, self.shown.as_ref()).filter(|_| ego.has_boxes);
        let judgement = match (&self.origin, payload, said) {
            (Some(origin), _, Some(said)) => {
                let (objects, own, view) = (&ego.known, ego.own, ego.view.as_ref());
                let is_map = matches!(payload, Payload::FeatureMap(_));
                // What a map shows stays where it was.
                let limits = Limits {
                    moves: limits.moves && !is_map,
                    ..*limits
                };
                let said = Said {
                    boxes: said,
                    impossible: self.shown.as_ref().map_or(0, |shown| shown.impossible),
                };
                let mut judgement = judge(&said, &Ego { objects, own, view }, origin, &record, &limits)?;
                if let Payload::FeatureMap(map) = payload {
                    let free: Vec<&Box3> = judgement.free_indices.iter().map(|index| &said.boxes[*index]).collect();
                    judgement.kept = without_cells_of(&free, map).into();
                }
                Some(judgement)
            }
            (Some(origin), Payload::PointCloud(cloud), None) => ego
                .sweep()
                .map(|sweep| judge_points(cloud, &sweep, origin, &record, limits)),
            _ => None,
        };
        Ok(Guarded { entry: self, judgement })
    }
}

/// The boxes of a message, or of its map.
fn boxes<'a>(payload: &'a Payload, shown: Option<&'a MapContent>) -> Option<&'a [Box3]> {
    match payload {
        Payload::Boxes(Boxes(said)) => Some(said),
        Payload::FeatureMap(_) => Some(&shown?.boxes),
        _ => None,
    }
}

fn origin(ego: &Pose, stamp: Nanos, header: &Header) -> Option<Origin> {
    let map_from_ego = &ego.map_from_frame;
    let pose = header.pose.as_ref()?;
    let ego_from_sender = relative(map_from_ego, &pose.map_from_frame);
    let sender = match header.sender_position() {
        Some(position) => map_from_ego.inverse_transform_point(&position.into()).coords,
        None => ego_from_sender.translation.vector,
    };
    let sender = Vector2::new(sender.x, sender.y);
    Some(Origin {
        ego_from_sender,
        sender,
        age_s: to_seconds(stamp.saturating_sub(header.stamp)),
        stated: stated(ego, pose, sender.norm()),
    })
}

/// How sure a collaborator's place is in the ego's frame, `metres` away: by what it says of its pose, and the ego of its own. An ego that
/// says nothing is taken to be sure.
fn stated(ego: &Pose, pose: &Pose, metres: f64) -> Option<Stated> {
    let variances = |covariance: &[f64; 36]| [0.5 * (covariance[0] + covariance[7]), covariance[35]];
    let [place, heading] = variances(pose.covariance.as_ref()?);
    let of_ego = ego.covariance.as_ref().filter(|covariance| is_covariance(covariance));
    let [ego_place, ego_heading] = of_ego.map_or([0.0; 2], |covariance| variances(covariance));
    Some(Stated {
        place_m: (place + ego_place + metres * metres * ego_heading).sqrt(),
        heading_rad: (heading + ego_heading).sqrt(),
    })
}

/// Whether these may be a covariance: finite numbers, and variances that are not negative.
fn is_covariance(covariance: &[f64; 36]) -> bool {
    covariance.iter().all(|number| number.is_finite()) && (0..6).all(|axis| covariance[7 * axis] >= 0.0)
}

/// Forgets a covariance that is none; whether it was one.
fn drop_wrong_covariance(header: &mut Header) -> bool {
    let Some(pose) = &mut header.pose else { return false };
    let is_wrong = pose
        .covariance
        .as_ref()
        .is_some_and(|covariance| !is_covariance(covariance));
    if is_wrong {
        pose.covariance = None;
    }
    is_wrong
}

impl Guarded {
    /// Whose it is.
    pub fn agent(&self) -> &Name {
        &self.entry.message.header.agent
    }

    /// Its header.
    pub fn header(&self) -> &Header {
        &self.entry.message.header
    }

    /// What was found of it; `None` for what cannot be checked.
    pub fn judgement(&self) -> Option<&Judgement> {
        self.judgement.as_ref()
    }

    /// Whether it had no pose and was placed.
    pub fn had_no_pose(&self) -> bool {
        self.entry.had_no_pose
    }

    /// Whether its pose came with a covariance that is none.
    pub fn had_wrong_covariance(&self) -> bool {
        self.entry.had_wrong_covariance
    }

    /// Whether its pose is corrected.
    pub fn is_moved(&self) -> bool {
        self.judgement
            .as_ref()
            .is_some_and(|judgement| judgement.rise != 0.0 || judgement.shift != Shift::none(judgement.shift.pivot))
    }

    /// Whether the ego's objects say where its agent is, and nothing speaks against it.
    pub fn is_confirmed(&self) -> bool {
        self.judgement
            .as_ref()
            .is_some_and(|judgement| judgement.reason.is_none() && judgement.covariance.is_some())
    }

    /// Whether more objects may say where its agent is.
    pub fn is_open(&self) -> bool {
        let is_condemned =
            |judgement: &Judgement| matches!(judgement.reason, Some(Reason::Distrusted | Reason::Scattered));
        self.judgement
            .as_ref()
            .is_some_and(|judgement| judgement.covariance.is_none() && !is_condemned(judgement))
    }

    /// Its boxes in the ego's frame.
    pub fn objects(&self) -> impl Iterator<Item = &Object> {
        self.judgement.iter().flat_map(|judgement| &judgement.objects)
    }

    /// Judges it once more, by more objects.
    ///
    /// # Errors
    /// [`AssignmentError`] for more objects than an assignment takes.
    pub fn again(self, ego: &Sight, record: Record, limits: &Limits) -> Result<Self, AssignmentError> {
        self.entry.judge(ego, record, limits)
    }

    /// Adds what was found to what is known of its agent.
    pub fn remember(&self, record: &mut Record) {
        let Some(judgement) = &self.judgement else { return };
        record.observe(judgement.shares.confirmed(), judgement.shares.contradicted);
        record.observe_apart(&judgement.shares.apart);
        if judgement.covariance.is_some() {
            record.observe_pose(judgement.shift.metres());
        }
        if judgement.ahead_s != record.clock_s() {
            record.observe_clock(judgement.ahead_s - record.clock_s());
        }
    }

    /// The message with what was corrected.
    pub fn into_message(self, ego: &Header) -> Message {
        let Entry {
            mut message, origin, ..
        } = self.entry;
        let Some(judgement) = self.judgement else {
            return message;
        };
        let is_moved = judgement.shift != Shift::none(judgement.shift.pivot) || judgement.rise != 0.0;
        let map_from_ego = ego.pose.as_ref().map(|pose| pose.map_from_frame);
        if is_moved
            && let (Some(origin), Some(map_from_ego), Some(pose)) = (origin, map_from_ego, &mut message.header.pose)
        {
            let rise = Translation3::new(0.0, 0.0, judgement.rise);
            pose.map_from_frame = map_from_ego * rise * judgement.shift.isometry() * origin.ego_from_sender;
            let found = judgement
                .covariance
                .map(|covariance| in_map(&covariance, yaw_of(&map_from_ego.rotation)));
            pose.covariance = found.or(pose.covariance.take());
        }
        message.header.stamp = message.header.stamp.saturating_sub(from_seconds(judgement.ahead_s));
        message.payload = judgement.kept;
        message
    }
}

/// A covariance of x, y and yaw in the ego's frame as one of a pose in `map`, row-major over x, y, z, roll, pitch, yaw. Of the others nothing
/// is known: they keep 0.
fn in_map(covariance: &Matrix3<f64>, yaw: f64) -> Box<[f64; 36]> {
    let (sin, cos) = libm::sincos(yaw);
    let turn = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
    let turned = turn * covariance * turn.transpose();
    let mut all = Matrix6::zeros();
    for (row, to) in [0, 1, 5].into_iter().enumerate() {
        for (column, at) in [0, 1, 5].into_iter().enumerate() {
            all[(to, at)] = turned[(row, column)];
        }
    }
    Box::new(std::array::from_fn(|place| all[(place / 6, place % 6)]))
}

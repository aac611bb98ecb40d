//! What becomes of a collaborator's points: they are laid over what the ego's own sweep shows.

use nalgebra::{Isometry3, Matrix3, Point3, Vector2, Vector3};
use realo_schemas::PointCloud;

use crate::boxes::{Judgement, Limits, Origin};
use crate::cells::{Overlay, standing};
use crate::record::Record;
use crate::shift::Shift;
use crate::sight::Sweep;
use crate::verdict::{Reason, Shares};
use crate::view::{Seen, View};

/// Cells that the ego has to see to say anything.
const CHECKED: usize = 40;
/// Share of the cells that the ego sees in which something has to stand, to confirm a place, and below which it is contradicted.
const CONFIRMED: f64 = 0.6;
const CONTRADICTED: f64 = 0.4;
/// By how much a motion has to be better than the stated place, and than any other motion.
const BETTER: f64 = 0.06;
const CLEAR: f64 = 0.02;
/// What a message says for its sender at most, in boxes.
const SAYS: f64 = 5.0;
/// Standard deviations of a place and a heading that cells give, m and rad.
const SIGMA: [f64; 2] = [0.25, 0.01];
/// Cells in which heights of the ground are compared, m, along a side, and how many both need.
const PATCH_M: f64 = 4.0;
const PATCHES: usize = 25;
const COMMON: usize = 6;
/// Points so low over the ground of whoever measured are of the ground, m.
const LOW_M: f64 = 0.3;
/// Heights that differ by less are left as they are, m.
const LEVEL_M: f64 = 0.15;

/// Judges a sweep by the ego's own.
pub(crate) fn judge_points(
    cloud: &PointCloud,
    own: &Sweep,
    origin: &Origin,
    record: &Record,
    limits: &Limits,
) -> Judgement {
    let view = own.view;
    let places = standing(cloud, &origin.ego_from_sender);
    let none = Shift::none(origin.sender);
    let overlay = own.ground.lay(&places, origin.sender, &limits.reach);
    let shift = overlay.filter(is_better).map_or(none, |overlay| overlay.shift);
    let place = shift.mover();
    let count = |what: Seen| places.iter().filter(|at| view.at(&place(at)) == what).count();
    let [something, free] = [Seen::Something, Seen::Free].map(count);
    let checked = something + free;
    let share = something as f64 / checked.max(1) as f64;
    let is_found = checked >= CHECKED && share >= CONFIRMED;
    let contradicted = if checked >= CHECKED {
        (CONFIRMED - share).max(0.0) * SAYS / CONFIRMED
    } else {
        0.0
    };
    let shares = Shares {
        paired: if checked >= CHECKED { share * SAYS } else { 0.0 },
        something: 0.0,
        contradicted,
        checked: [checked, free],
        ..Shares::default()
    };
    let mut after = record.clone();
    after.observe(shares.confirmed(), shares.contradicted);
    let is_contradicted = checked >= CHECKED && share < CONTRADICTED;
    let reason = match is_contradicted {
        true => Some(Reason::Contradicted),
        false => shares.reason(
            is_found,
            after.trust(),
            0.0,
            record.pose_error_m(origin.stated.map(|stated| stated.place_m)),
        ),
    };
    let sigma = Vector3::new(SIGMA[0], SIGMA[0], SIGMA[1]).map(|sigma| sigma * sigma);
    let rise = rise(cloud, own.cloud, &(shift.isometry() * origin.ego_from_sender));
    let (kept, free) = without_ghosts(cloud, view, &origin.ego_from_sender, &shift);
    Judgement {
        reason,
        shift,
        rise,
        covariance: is_found.then(|| Matrix3::from_diagonal(&sigma)),
        ahead_s: 0.0,
        shares,
        kept: kept.into(),
        objects: Vec::new(),
        free,
        free_indices: Vec::new(),
        implausible: 0,
        excess: 0,
        all: cloud.len() as u64,
    }
}

fn is_better(overlay: &Overlay) -> bool {
    overlay.score > overlay.stated + BETTER && overlay.score > overlay.runner_up + CLEAR
}

/// What has to be added to the heights of their points, m, so that the ground lies where the ego's does; 0 where too little of it is seen by
/// both.
fn rise(theirs: &PointCloud, own: &PointCloud, ego_from_sender: &Isometry3<f64>) -> f64 {
    let (own, theirs) = (heights(own, &Isometry3::identity()), heights(theirs, ego_from_sender));
    let both = own
        .iter()
        .zip(&theirs)
        .filter_map(|(own, theirs)| Some((*own)? - (*theirs)?));
    let mut differences: Vec<f64> = both.collect();
    differences.sort_by(f64::total_cmp);
    let middle = differences.get(differences.len() / 2).copied().unwrap_or(0.0);
    if differences.len() >= COMMON && middle.abs() > LEVEL_M {
        middle
    } else {
        0.0
    }
}

/// Mean heights of the ground in patches around the ego, in its frame.
fn heights(cloud: &PointCloud, ego_from_body: &Isometry3<f64>) -> Vec<Option<f64>> {
    let mut sums = vec![(0.0, 0u32); PATCHES * PATCHES];
    for index in 0..cloud.len() {
        let point = Point3::new(cloud.x[index], cloud.y[index], cloud.z[index]).cast::<f64>();
        // What is not a number is not low.
        if point.z.is_nan() || point.z.abs() > LOW_M {
            continue;
        }
        let at = ego_from_body * point;
        let [x, y] = [at.x, at.y].map(|along| (along / PATCH_M + PATCHES as f64 / 2.0).floor());
        if x >= 0.0 && y >= 0.0 && x < PATCHES as f64 && y < PATCHES as f64 {
            let (sum, count) = &mut sums[y as usize * PATCHES + x as usize];
            *sum += at.z;
            *count += 1;
        }
    }
    sums.into_iter()
        .map(|(sum, count)| (count >= 5).then(|| sum / f64::from(count)))
        .collect()
}

/// The cloud without points that stand where the ego sees that nothing does, and how many those are.
fn without_ghosts(
    cloud: &PointCloud,
    view: &View,
    ego_from_sender: &Isometry3<f64>,
    shift: &Shift,
) -> (PointCloud, u64) {
    let place = shift.mover();
    let stays = |index: &usize| {
        let point = Point3::new(cloud.x[*index], cloud.y[*index], cloud.z[*index]).cast::<f64>();
        let at = ego_from_sender * point;
        point.z < LOW_M || view.at(&place(&Vector2::new(at.x, at.y))) != Seen::Free
    };
    let kept: Vec<usize> = (0..cloud.len()).filter(stays).collect();
    let gone = (cloud.len() - kept.len()) as u64;
    if gone == 0 {
        return (cloud.clone(), 0);
    }
    let of = |column: &[f32]| kept.iter().map(|index| column[*index]).collect::<Vec<f32>>().into();
    let left = PointCloud {
        x: of(&cloud.x),
        y: of(&cloud.y),
        z: of(&cloud.z),
        intensity: kept
            .iter()
            .map(|index| cloud.intensity[*index])
            .collect::<Vec<u8>>()
            .into(),
        time: kept.iter().map(|index| cloud.time[*index]).collect::<Vec<i32>>().into(),
        ring: kept.iter().map(|index| cloud.ring[*index]).collect::<Vec<u16>>().into(),
    };
    (left, gone)
}

//! Who walks together, and how.

use crate::bodies::Class;
use crate::path::{Motion, Pose2};
use crate::place::SIDES;
use crate::random::Stream;
use crate::traffic::touch;
use crate::traffic::walking::{APART, Gait};

/// Two who walk side by side keep this far from the middle between them, m.
pub(super) const ABREAST: f64 = 0.37;

/// Between those who walk behind each other, m.
const BEHIND: f64 = 0.3;

/// One of those who walk together.
pub(super) struct Member {
    pub class: Class,
    pub size: [f64; 3],
    /// How far behind the first and to the left of the common way, m.
    pub back: f64,
    pub aside: f64,
}

/// Those who walk together, the first first.
pub(super) struct Party {
    pub members: Vec<Member>,
    pub speed: f64,
}

impl Party {
    pub(super) fn draw(draws: &mut Stream, groups: f64, prams: f64) -> Self {
        let count = if draws.chance(groups) { companions(draws) } else { 1 };
        let mut party = Party {
            members: Vec::new(),
            speed: f64::INFINITY,
        };
        for _ in 0..count {
            let Gait {
                mut class,
                mut size,
                speed,
            } = Gait::draw(draws);
            party.speed = party.speed.min(speed);
            if class == Class::Pedestrian && draws.chance(prams) {
                class = Class::Pram;
                size = class.labelled_size(draws);
                party.speed = party.speed.min(1.3);
            }
            party.members.push(Member {
                class,
                size,
                back: 0.0,
                aside: 0.0,
            });
        }
        party
    }

    /// Lines them up in one or in two files.
    pub(super) fn line_up(&mut self, abreast: bool) {
        let files = if abreast { 2 } else { 1 };
        for i in 0..self.members.len() {
            let back = match i.checked_sub(files) {
                Some(before) => {
                    let before = &self.members[before];
                    before.back + 0.5 * (before.size[0] + self.members[i].size[0]) + BEHIND
                }
                None => 0.5 * (self.members[i].size[0] - self.members[0].size[0]).max(0.0),
            };
            let member = &mut self.members[i];
            member.back = back;
            member.aside = if abreast { ABREAST * SIDES[i % 2] } else { 0.0 };
        }
    }

    /// How far the last walks behind the first, m.
    pub(super) fn tail(&self) -> f64 {
        self.members.iter().map(|member| member.back).fold(0.0, f64::max)
    }
}

/// How many go or stand together: two to six.
fn companions(draws: &mut Stream) -> usize {
    match draws.unit() {
        u if u < 0.5 => 2,
        u if u < 0.75 => 3,
        u if u < 0.88 => 4,
        u if u < 0.95 => 5,
        _ => 6,
    }
}

/// How far from somebody's middle others keep theirs, m.
pub(super) fn margin(class: Class, size: [f64; 3]) -> f64 {
    match class {
        Class::Pram => 0.5 * (size[0] * size[0] + size[1] * size[1]).sqrt(),
        _ => 0.5 * APART,
    }
}

/// The motion of somebody beside the common way; `None` where it bends too sharply for him.
pub(super) fn beside(leader: &Motion, member: &Member) -> Option<Motion> {
    /// Nobody is slowed down to less than this share in a bend.
    const LEAST: f64 = 0.3;
    let pieces: Vec<(f64, f64, f64)> = leader.path.pieces().collect();
    let scale = |curvature: f64| 1.0 - curvature * member.aside;
    if pieces
        .iter()
        .any(|(from, to, curvature)| to > from && scale(*curvature) < LEAST)
    {
        return None;
    }
    // Distances along his own way where the pieces begin.
    let mut own = vec![0.0];
    for (from, to, curvature) in &pieces {
        own.push(own[own.len() - 1] + (to - from) * scale(*curvature));
    }
    let ticks = leader.ticks.iter().map(|(s, v)| {
        let s = s - member.back;
        let k = pieces.partition_point(|(from, ..)| *from <= s).max(1) - 1;
        let (from, _, curvature) = pieces[k];
        (own[k] + (s - from) * scale(curvature), v * scale(curvature))
    });
    Some(Motion {
        path: leader.path.parallel(member.aside),
        first: leader.first,
        ticks: ticks.collect(),
    })
}

/// Whether two of some who stand touch.
pub(super) fn collides(members: &[Member], poses: &[Pose2]) -> bool {
    let pairs = (0..poses.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    pairs
        .into_iter()
        .any(|(i, j)| touch(poses[i], members[i].size, poses[j], members[j].size))
}

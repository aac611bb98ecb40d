//! Truths of two agents side by side.

use std::collections::{BTreeMap, BTreeSet};

use super::{APART, MAX_OFFSET_M, MIN_POSITIONS, Placed, SAME_PLACE};

/// What two agents' truths have in common.
#[derive(Default)]
pub(super) struct Pair {
    /// By track: how far apart both say that it is, m.
    shared: BTreeMap<u64, Vec<f64>>,
    pub positions: usize,
    pub split: usize,
    /// Of each of the two: objects ahead of it that the other's truth has and its own has not, and all that the other's has there.
    pub lacking: [[usize; 2]; 2],
}

/// The upper median; 0 if empty.
pub(super) fn median(mut of: Vec<f64>) -> f64 {
    of.sort_by(f64::total_cmp);
    of.get(of.len() / 2).copied().unwrap_or(0.0)
}

impl Pair {
    /// Takes what two agents have at about one time.
    pub(super) fn compare(&mut self, own: &[Placed], others: &[Placed]) {
        let tracks = |objects: &[Placed]| {
            objects
                .iter()
                .filter_map(|object| object.track)
                .collect::<BTreeSet<u64>>()
        };
        let both: BTreeSet<u64> = &tracks(own) & &tracks(others);
        let place = |objects: &[Placed], track: u64| {
            let known = objects.iter().find(|object| object.track == Some(track));
            known.map(|object| object.place)
        };
        for track in &both {
            if let (Some(one), Some(other)) = (place(own, *track), place(others, *track)) {
                let far = (one - other).norm();
                if far.is_finite() {
                    self.shared.entry(*track).or_default().push(far);
                    self.positions += 1;
                }
            }
        }
        let alone = |object: &&Placed| object.track.is_none_or(|track| !both.contains(&track));
        let (own, others): (Vec<&Placed>, Vec<&Placed>) = (
            own.iter().filter(alone).collect(),
            others.iter().filter(alone).collect(),
        );
        let mutual = own.iter().filter(|one| {
            nearest(one, &others)
                .is_some_and(|other| nearest(other, &own).is_some_and(|back| std::ptr::eq(back, **one)))
        });
        self.split += mutual.count();
    }

    /// Positions of tracks that are of different objects, more than 5 m apart, and the median of these distances, m. A track is if
    /// most of its positions are apart.
    pub(super) fn apart(&self) -> (usize, f64) {
        let mut apart = Vec::new();
        for distances in self.shared.values() {
            let far = distances.iter().copied().filter(|far| *far > APART);
            let far: Vec<f64> = far.collect();
            if 2 * far.len() > distances.len() {
                apart.extend(far);
            }
        }
        (apart.len(), median(apart))
    }

    /// The median offset of parked objects, m, the number of positions above [`MAX_OFFSET_M`], and of all positions. `None` if the
    /// median is within it or fewer than two tracks are parked. Tracks above [`APART`] are of different objects and left out.
    pub(super) fn shifted(&self, is_parked: impl Fn(u64) -> bool) -> Option<(f64, usize, usize)> {
        let known = self
            .shared
            .iter()
            .filter(|(track, far)| far.len() >= MIN_POSITIONS && is_parked(**track));
        let medians = known.map(|(_, far)| (median(far.clone()), far));
        let of_one: Vec<(f64, &Vec<f64>)> = medians.filter(|(median, _)| *median <= APART).collect();
        let middle = median(of_one.iter().map(|(median, _)| *median).collect());
        let all = || of_one.iter().flat_map(|(_, far)| far.iter());
        let shifted = all().filter(|far| **far > MAX_OFFSET_M).count();
        (of_one.len() > 1 && middle > MAX_OFFSET_M).then(|| (middle, shifted, all().count()))
    }
}

/// The nearest of the same class, if that is at the same place.
fn nearest<'a>(of: &Placed, among: &[&'a Placed]) -> Option<&'a Placed> {
    let far = |other: &Placed| (other.place - of.place).norm();
    let alike = among
        .iter()
        .filter(|other| other.class == of.class && far(other) <= SAME_PLACE);
    alike.min_by(|one, other| far(one).total_cmp(&far(other))).copied()
}

//! Which things may be met by the rays of a wedge, nearest first.

/// Where a thing may be met, rounded outwards.
#[derive(Clone, Copy)]
pub(super) struct Extent {
    /// First and last bin of azimuth.
    pub bins: [i16; 2],
    /// Bounds of the slope of rays that meet it.
    pub low: f32,
    pub high: f32,
    /// Smallest distance over ground, m.
    pub near: f64,
}

/// Things by wedge.
pub(super) struct Table {
    /// `things[starts[wedge]..starts[wedge + 1]]`, as they were given.
    starts: Vec<u32>,
    things: Vec<u32>,
}

impl Table {
    /// `wedges`: first and last bin of azimuth of each, both rising from one to the next; `things`: those of each thing, in
    /// the order in which they are to be visited.
    pub fn new(wedges: &[[i16; 2]], things: impl Iterator<Item = [i16; 2]> + Clone) -> Self {
        let wedges_of = |[from, to]: [i16; 2]| {
            let first = wedges.partition_point(|wedge| wedge[1] < from);
            first..wedges.partition_point(|wedge| wedge[0] <= to).max(first)
        };
        let mut starts = vec![0u32; wedges.len() + 1];
        for bins in things.clone() {
            starts[1..][wedges_of(bins)].iter_mut().for_each(|count| *count += 1);
        }
        for k in 1..starts.len() {
            starts[k] += starts[k - 1];
        }
        let mut listed = vec![0; starts[wedges.len()] as usize];
        let mut next = starts.clone();
        for (index, bins) in things.enumerate() {
            for next in &mut next[wedges_of(bins)] {
                listed[*next as usize] = index as u32;
                *next += 1;
            }
        }
        Table { starts, things: listed }
    }

    /// The things that rays of a wedge may meet.
    pub fn of(&self, wedge: usize) -> impl Iterator<Item = usize> {
        let [from, to] = [wedge, wedge + 1].map(|k| self.starts[k] as usize);
        self.things[from..to].iter().map(|index| *index as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_for_each_wedge_what_it_can_meet_in_order() {
        let wedges = [[0, 12], [8, 22], [18, 31]];
        let things = [[5, 6], [0, 40], [9, 17], [12, 18], [31, 31], [13, 17], [33, 40]];
        let table = Table::new(&wedges, things.into_iter());
        let of = |wedge| table.of(wedge).collect::<Vec<_>>();
        assert_eq!(of(0), [0, 1, 2, 3]);
        assert_eq!(of(1), [1, 2, 3, 5]);
        assert_eq!(of(2), [1, 3, 4]);
    }
}

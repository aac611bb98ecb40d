//! What may be met in which azimuth, nearest first.

/// Entries that are looked at together.
const TOGETHER: usize = 8;

const BITS: [u32; TOGETHER] = [1, 2, 4, 8, 16, 32, 64, 128];

/// What decides whether something is looked at, rounded outwards: least distance over ground, m, and bounds of the slope
/// of rays that can meet it.
#[derive(Clone, Copy)]
pub(super) struct Bounds {
    pub near: f32,
    pub low: f32,
    pub high: f32,
}

/// Bounds of some things of a bin; what is left over can never be met.
#[derive(Clone, Copy)]
struct Block {
    near: [f32; TOGETHER],
    low: [f32; TOGETHER],
    high: [f32; TOGETHER],
    index: [u32; TOGETHER],
}

const EMPTY: Block = Block {
    near: [f32::INFINITY; TOGETHER],
    low: [f32::INFINITY; TOGETHER],
    high: [f32::NEG_INFINITY; TOGETHER],
    index: [0; TOGETHER],
};

/// Things by bin of azimuth.
pub(super) struct Table {
    /// `blocks[starts[bin]..starts[bin + 1]]`: what is in a bin, nearest first.
    starts: Vec<u32>,
    blocks: Vec<Block>,
}

/// A table that is being filled.
pub(super) struct TableOf {
    table: Table,
    fill: Vec<u32>,
}

impl TableOf {
    /// Room for things that will be added with these first and last bins.
    pub fn new(bins: usize, all: impl Iterator<Item = [usize; 2]>) -> Self {
        let mut counts = vec![0u32; bins];
        for [from, to] in all {
            counts[from..=to].iter_mut().for_each(|count| *count += 1);
        }
        let mut starts = Vec::with_capacity(bins + 1);
        let mut start = 0;
        starts.push(start);
        for count in &counts {
            start += count.div_ceil(TOGETHER as u32);
            starts.push(start);
        }
        let blocks = vec![EMPTY; start as usize];
        counts.fill(0);
        TableOf {
            table: Table { starts, blocks },
            fill: counts,
        }
    }

    /// Adds something to all bins from the first to the last; what is nearer comes before.
    pub fn add(&mut self, [from, to]: [usize; 2], bounds: Bounds, index: u32) {
        let starts = &self.table.starts[from..=to];
        for (fill, start) in self.fill[from..=to].iter_mut().zip(starts) {
            let block = &mut self.table.blocks[*start as usize + *fill as usize / TOGETHER];
            let place = *fill as usize % TOGETHER;
            block.near[place] = bounds.near;
            block.low[place] = bounds.low;
            block.high[place] = bounds.high;
            block.index[place] = index;
            *fill += 1;
        }
    }

    pub fn finish(self) -> Table {
        self.table
    }
}

impl Table {
    /// Visits what a ray of a slope may meet before `limit`, nearest first; `level` is the ray's length over ground. The
    /// visitor returns the new limit where the ray met something.
    #[inline(always)]
    pub fn each(
        &self,
        bin: usize,
        slope: f32,
        mut limit: f64,
        level: f64,
        mut visit: impl FnMut(u32, f64) -> Option<f64>,
    ) {
        let bin = bin.min(self.starts.len() - 2);
        let mut reach = (limit * level) as f32;
        for block in &self.blocks[self.starts[bin] as usize..self.starts[bin + 1] as usize] {
            if block.near[0] > reach {
                break;
            }
            let mut bits = [0u32; TOGETHER];
            for k in 0..TOGETHER {
                let meets = (block.near[k] <= reach) & (block.low[k] <= slope) & (block.high[k] >= slope);
                // A choice among constants, not a shift: every processor does eight at once.
                bits[k] = if meets { BITS[k] } else { 0 };
            }
            let mut mask = bits.iter().fold(0, |all, bit| all | bit);
            while mask != 0 {
                let k = mask.trailing_zeros() as usize;
                mask &= mask - 1;
                if block.near[k] <= reach
                    && let Some(met) = visit(block.index[k], limit)
                {
                    limit = met;
                    reach = (limit * level) as f32;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn visits_in_order_what_a_ray_can_meet() {
        let bounds = |near: f32, low: f32| Bounds {
            near,
            low,
            high: low + 1.0,
        };
        let things: Vec<([usize; 2], Bounds)> = (0..20)
            .map(|k| ([0, k % 3], bounds(k as f32, if k % 4 == 0 { 5.0 } else { 0.0 })))
            .collect();
        let mut table = TableOf::new(3, things.iter().map(|(bins, _)| *bins));
        for (index, (bins, bounds)) in things.iter().enumerate() {
            table.add(*bins, *bounds, index as u32);
        }
        let table = table.finish();
        let visited = |bin, slope, limit, stop: u32| {
            let mut seen = Vec::new();
            table.each(bin, slope, limit, 1.0, |index, _| {
                seen.push(index);
                (index == stop).then_some(f64::from(stop) + 2.5)
            });
            seen
        };
        assert_eq!(visited(0, 0.5, 9.5, 99), [1, 2, 3, 5, 6, 7, 9]);
        assert_eq!(visited(2, 5.5, 100.0, 99), [8]);
        assert_eq!(visited(2, 0.5, 100.0, 99), [2, 5, 11, 14, 17]);
        assert_eq!(visited(0, 0.5, 100.0, 5), [1, 2, 3, 5, 6, 7]);
    }
}

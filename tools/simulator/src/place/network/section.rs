//! Cross-sections of roads: lanes, bays and pavements.

use std::f64::consts::PI;

use crate::place::verge::VergeKind;

/// Right and left of a line.
pub(crate) const SIDES: [f64; 2] = [-1.0, 1.0];

/// How cars stand in a row of bays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bays {
    /// Between the kerb and a car's axis, rad: 0 for cars behind each other, a right angle for cars side by side.
    pub angle: f64,
    /// From the lane's edge to the kerb, m.
    pub depth: f64,
    /// From one bay to the next, m.
    pub pitch: f64,
}

impl Bays {
    pub const PARALLEL: Bays = Bays {
        angle: 0.0,
        depth: 2.3,
        pitch: 6.0,
    };

    pub const SQUARE: Bays = Bays {
        angle: PI / 2.0,
        depth: 5.3,
        pitch: 2.65,
    };

    /// Bays at a slant.
    pub fn slanted(degrees: f64) -> Bays {
        let angle = degrees.to_radians();
        let (sin, cos) = libm::sincos(angle);
        Bays {
            angle,
            depth: 5.0 * sin + 2.2 * cos,
            pitch: 2.65 / sin,
        }
    }
}

/// A road's cross-section.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Section {
    /// Driving lanes along the line and against it.
    pub lanes: [usize; 2],
    /// Width of a driving lane, m.
    pub width: f64,
    /// Between the two directions, m; raised where it is wider than 1 m and the place has kerbs.
    pub median: f64,
    /// Width of the cycle lanes on both sides, m; 0 for none.
    pub cycle: f64,
    /// What is paved beyond the outermost lanes, m.
    pub shoulder: f64,
    /// Bays beyond the right and the left kerb line.
    pub bays: [Option<Bays>; 2],
    /// Widths of the pavements, m; 0 for none.
    pub pavement: [f64; 2],
    /// Speed limit, m/s.
    pub limit: f64,
    /// What lies beside it, and how deep it is free, m.
    pub beside: [(VergeKind, f64); 2],
}

/// A lane of a cross-section.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Strip {
    /// Of its middle, m.
    pub offset: f64,
    pub width: f64,
    /// Along the road's line.
    pub forward: bool,
    /// Number among the driving lanes of its direction, from the middle of the road; `None` for cycle lanes.
    pub index: Option<usize>,
}

impl Section {
    /// A street of one lane in each direction with pavements.
    pub fn street(width: f64, limit: f64) -> Section {
        Section {
            lanes: [1, 1],
            width,
            median: 0.0,
            cycle: 0.0,
            shoulder: 0.25,
            bays: [None; 2],
            pavement: [3.5; 2],
            limit,
            beside: [(VergeKind::Park, 12.0); 2],
        }
    }

    /// Half the width between the kerb lines, without bays, m.
    pub fn half(&self) -> f64 {
        let lanes = (self.lanes[0] + self.lanes[1]) as f64 * self.width;
        0.5 * (lanes + self.median) + self.cycle + self.shoulder
    }

    /// Depth of the bays on a side, m.
    pub fn bay_depth(&self, side: usize) -> f64 {
        self.bays[side].map_or(0.0, |bays| bays.depth)
    }

    /// From the line to the far edge of the pavement, m.
    pub fn outer(&self, side: usize) -> f64 {
        self.half() + self.bay_depth(side) + self.pavement[side]
    }

    /// The strip of a wide pavement on which things stand and nobody walks, from and to, m behind the kerb; vehicles reach
    /// over the kerb where they turn and park.
    pub fn strip(&self, side: usize) -> Option<[f64; 2]> {
        (self.pavement[side] >= 3.3).then_some([0.55, 1.35])
    }

    /// Offset of the median's middle, m.
    pub fn middle(&self) -> f64 {
        let [forward, backward] = self.lanes.map(|n| n as f64 * self.width);
        0.5 * (forward - backward)
    }

    /// All lanes.
    pub fn strips(&self) -> Vec<Strip> {
        let middle = self.middle();
        let mut strips = Vec::new();
        for (direction, sign) in [(0, -1.0), (1, 1.0)] {
            let forward = direction == 0;
            for index in 0..self.lanes[direction] {
                strips.push(Strip {
                    offset: middle + sign * (0.5 * self.median + (index as f64 + 0.5) * self.width),
                    width: self.width,
                    forward,
                    index: Some(index),
                });
            }
            if self.cycle > 0.0 && self.lanes[direction] > 0 {
                strips.push(Strip {
                    offset: sign * (self.half() - self.shoulder - 0.5 * self.cycle),
                    width: self.cycle,
                    forward,
                    index: None,
                });
            }
        }
        strips
    }
}

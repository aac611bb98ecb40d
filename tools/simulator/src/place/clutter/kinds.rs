//! What lines roads and grows behind them, by the kind of verge.

use crate::place::VergeKind;

/// What a stretch of a verge is lined with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Lining {
    Hedge,
    /// A low wall with a hedge behind it.
    WalledHedge,
    Shrubs,
    Trees,
    /// High grass with a shrub here and there.
    Grass,
    Wall,
    Rail,
    Fence,
    /// Bollards, signs, lamps, bins, cabinets.
    Furniture,
    Bicycles,
    Shelter,
    Works,
    Bare,
}

/// How often stretches have what lining, by the kind of the verge; weights.
pub(super) fn linings(kind: VergeKind) -> &'static [(Lining, f64)] {
    use Lining::*;
    match kind {
        VergeKind::Garden => &[
            (Hedge, 5.0),
            (WalledHedge, 3.0),
            (Shrubs, 3.0),
            (Trees, 2.0),
            (Wall, 3.0),
            (Fence, 1.5),
            (Furniture, 1.5),
            (Works, 0.3),
            (Bare, 1.0),
        ],
        VergeKind::Street => &[
            (Furniture, 3.0),
            (Bicycles, 3.0),
            (Shelter, 0.5),
            (Hedge, 3.0),
            (Shrubs, 3.0),
            (Trees, 2.0),
            (Wall, 1.0),
            (Fence, 0.7),
            (Works, 0.6),
            (Bare, 1.0),
        ],
        VergeKind::Park => &[
            (Hedge, 3.0),
            (WalledHedge, 1.5),
            (Shrubs, 5.0),
            (Trees, 4.0),
            (Grass, 2.0),
            (Wall, 2.5),
            (Fence, 1.0),
            (Furniture, 1.5),
            (Bicycles, 0.5),
            (Shelter, 0.3),
            (Works, 0.3),
            (Bare, 1.0),
        ],
        VergeKind::Field => &[
            (Grass, 5.0),
            (Shrubs, 3.0),
            (Trees, 2.0),
            (Hedge, 1.0),
            (Rail, 1.0),
            (Fence, 1.0),
            (Furniture, 1.0),
            (Bare, 2.0),
        ],
        VergeKind::Embankment => &[
            (Rail, 5.0),
            (Shrubs, 4.0),
            (Grass, 2.0),
            (Fence, 1.0),
            (Trees, 1.0),
            (Furniture, 0.7),
            (Works, 0.4),
        ],
        VergeKind::Median => &[
            (Hedge, 4.0),
            (Rail, 2.0),
            (Fence, 2.0),
            (Shrubs, 1.5),
            (Trees, 0.7),
            (Works, 0.3),
            (Bare, 1.5),
        ],
        VergeKind::CarPark => &[
            (Hedge, 3.0),
            (Shrubs, 2.0),
            (Furniture, 2.0),
            (Wall, 1.0),
            (Fence, 1.0),
            (Bicycles, 1.0),
            (Trees, 1.0),
            (Bare, 2.0),
        ],
        VergeKind::Kerb => &[
            (Hedge, 6.0),
            (Bicycles, 3.0),
            (Furniture, 3.0),
            (Fence, 0.3),
            (Bare, 0.3),
        ],
    }
}

/// What there is behind the first row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Growth {
    /// With a stone here and there.
    Weed,
    Shrub,
    LowWall,
    Tree,
}

/// How much of each there is on 100 m² of free ground, by the kind of the verge.
pub(super) fn growth(kind: VergeKind) -> [(Growth, f64); 4] {
    let [weeds, shrubs, low_walls, trees] = match kind {
        VergeKind::Garden => [50.0, 20.0, 5.0, 3.6],
        VergeKind::Street => [60.0, 33.0, 7.0, 4.0],
        VergeKind::Park => [42.0, 14.5, 6.0, 3.2],
        VergeKind::Field => [22.0, 5.5, 6.0, 1.2],
        VergeKind::Embankment => [14.0, 5.0, 3.0, 1.0],
        VergeKind::CarPark => [38.0, 19.0, 1.5, 1.8],
        VergeKind::Median | VergeKind::Kerb => [0.0; 4],
    };
    [
        (Growth::Weed, weeds),
        (Growth::Shrub, shrubs),
        (Growth::LowWall, low_walls),
        (Growth::Tree, trees),
    ]
}

/// How often a verge has a row of trees over whatever lines it, by its kind.
pub(super) fn tree_lined(kind: VergeKind) -> f64 {
    match kind {
        VergeKind::Garden => 0.55,
        VergeKind::Street => 0.3,
        VergeKind::Park => 0.7,
        VergeKind::Field => 0.65,
        VergeKind::Embankment => 0.5,
        VergeKind::Median => 0.5,
        VergeKind::CarPark => 0.5,
        VergeKind::Kerb => 0.75,
    }
}

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

/// Linings and how often stretches of a verge have them, as weights.
type Linings = [(Lining, f64)];

const GARDEN: &Linings = &[
    (Lining::Hedge, 5.0),
    (Lining::WalledHedge, 3.0),
    (Lining::Shrubs, 3.0),
    (Lining::Trees, 2.0),
    (Lining::Wall, 3.0),
    (Lining::Fence, 1.5),
    (Lining::Furniture, 1.5),
    (Lining::Works, 0.3),
    (Lining::Bare, 1.0),
];
const STREET: &Linings = &[
    (Lining::Furniture, 3.0),
    (Lining::Bicycles, 3.0),
    (Lining::Shelter, 0.5),
    (Lining::Hedge, 3.0),
    (Lining::Shrubs, 3.0),
    (Lining::Trees, 2.0),
    (Lining::Wall, 1.0),
    (Lining::Fence, 0.7),
    (Lining::Works, 0.6),
    (Lining::Bare, 1.0),
];
const PARK: &Linings = &[
    (Lining::Hedge, 3.0),
    (Lining::WalledHedge, 1.5),
    (Lining::Shrubs, 5.0),
    (Lining::Trees, 4.0),
    (Lining::Grass, 2.0),
    (Lining::Wall, 2.5),
    (Lining::Fence, 1.0),
    (Lining::Furniture, 1.5),
    (Lining::Bicycles, 0.5),
    (Lining::Shelter, 0.3),
    (Lining::Works, 0.3),
    (Lining::Bare, 1.0),
];
const FIELD: &Linings = &[
    (Lining::Grass, 5.0),
    (Lining::Shrubs, 3.0),
    (Lining::Trees, 2.0),
    (Lining::Hedge, 1.0),
    (Lining::Rail, 1.0),
    (Lining::Fence, 1.0),
    (Lining::Furniture, 1.0),
    (Lining::Bare, 2.0),
];
const EMBANKMENT: &Linings = &[
    (Lining::Rail, 5.0),
    (Lining::Shrubs, 4.0),
    (Lining::Grass, 2.0),
    (Lining::Fence, 1.0),
    (Lining::Trees, 1.0),
    (Lining::Furniture, 0.7),
    (Lining::Works, 0.4),
];
const MEDIAN: &Linings = &[
    (Lining::Hedge, 4.0),
    (Lining::Rail, 2.0),
    (Lining::Fence, 2.0),
    (Lining::Shrubs, 1.5),
    (Lining::Trees, 0.7),
    (Lining::Works, 0.3),
    (Lining::Bare, 1.5),
];
const CAR_PARK: &Linings = &[
    (Lining::Hedge, 3.0),
    (Lining::Shrubs, 2.0),
    (Lining::Furniture, 2.0),
    (Lining::Wall, 1.0),
    (Lining::Fence, 1.0),
    (Lining::Bicycles, 1.0),
    (Lining::Trees, 1.0),
    (Lining::Bare, 2.0),
];
const KERB: &Linings = &[
    (Lining::Hedge, 6.0),
    (Lining::Bicycles, 3.0),
    (Lining::Furniture, 3.0),
    (Lining::Fence, 0.3),
    (Lining::Bare, 0.3),
];

/// How often stretches have what lining, by the kind of the verge.
pub(super) fn linings(kind: VergeKind) -> &'static Linings {
    match kind {
        VergeKind::Garden => GARDEN,
        VergeKind::Street => STREET,
        VergeKind::Park => PARK,
        VergeKind::Field => FIELD,
        VergeKind::Embankment => EMBANKMENT,
        VergeKind::Median => MEDIAN,
        VergeKind::CarPark => CAR_PARK,
        VergeKind::Kerb => KERB,
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

//! The places that there are.

use super::error::Error;
use crate::random::Stream;

/// Which place is built.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Scenario {
    /// Two straight roads that cross squarely under traffic lights, between houses.
    #[default]
    Intersection,
    /// A straight road with a signalised crossing for pedestrians, between houses.
    Corridor,
    /// Two bent roads that cross at a slant, with lights or without, in the open.
    Junction,
    /// A road that ends at another, at a slant.
    Tee,
    /// Three or four roads that meet in a ring.
    Roundabout,
    /// A winding road with entries.
    Curve,
    /// Narrow streets between gardens, cars parked on both sides.
    Residential,
    /// Three lanes each way at up to 100 km/h, in a bend, with an entry.
    Motorway,
    /// A car park with its street.
    CarPark,
    /// A boulevard with a planted median.
    Avenue,
    /// A winding road over open, sloping land, without kerbs.
    Rural,
    /// A shopping street: many walkers, vans at the kerb.
    Market,
    /// One of all these, as the place's number says.
    Mixed,
    /// Streets around a block, with a canyon in which satellite receivers have no position; `mixed` does not draw it.
    Loop,
}

impl Scenario {
    /// All that `mixed` draws from.
    pub const PLACES: [Scenario; 12] = [
        Scenario::Intersection,
        Scenario::Corridor,
        Scenario::Junction,
        Scenario::Tee,
        Scenario::Roundabout,
        Scenario::Curve,
        Scenario::Residential,
        Scenario::Motorway,
        Scenario::CarPark,
        Scenario::Avenue,
        Scenario::Rural,
        Scenario::Market,
    ];

    /// All that there are, but for `mixed`.
    pub const ALL: [Scenario; 13] = {
        let [a, b, c, d, e, f, g, h, i, j, k, l] = Self::PLACES;
        [a, b, c, d, e, f, g, h, i, j, k, l, Scenario::Loop]
    };

    /// The places of [`Scenario::PLACES`] whose roads run at any angle: all but the two on a grid.
    pub const NETWORKS: [Scenario; 10] = {
        let [_, _, networks @ ..] = Self::PLACES;
        networks
    };

    /// Its name, as it is asked for.
    pub fn name(self) -> &'static str {
        match self {
            Scenario::Intersection => "intersection",
            Scenario::Corridor => "corridor",
            Scenario::Junction => "junction",
            Scenario::Tee => "tee",
            Scenario::Roundabout => "roundabout",
            Scenario::Curve => "curve",
            Scenario::Residential => "residential",
            Scenario::Motorway => "motorway",
            Scenario::CarPark => "car_park",
            Scenario::Avenue => "avenue",
            Scenario::Rural => "rural",
            Scenario::Market => "market",
            Scenario::Mixed => "mixed",
            Scenario::Loop => "loop",
        }
    }

    /// The scenario of a name.
    ///
    /// # Errors
    /// [`Error::UnknownScenario`] lists the names.
    pub fn from_name(name: &str) -> Result<Self, Error> {
        let mut all = Self::ALL.into_iter().chain([Scenario::Mixed]);
        all.find(|scenario| scenario.name() == name)
            .ok_or_else(|| Error::UnknownScenario { found: name.into() })
    }

    /// The place that is built for a place's number: what `mixed` draws, else itself.
    pub fn resolve(self, place: u64) -> Self {
        match self {
            Scenario::Mixed => Self::PLACES[Stream::new(place, "scenario", 0).below(Self::PLACES.len())],
            own => own,
        }
    }
}

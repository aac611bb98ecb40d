use std::io;
use std::path::PathBuf;

/// Why a map cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The system does not let it be read.
    #[error("{}: cannot be read: {reason}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        reason: io::Error,
    },
    /// The system does not let it be written.
    #[error("{}: cannot be written: {reason}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system says.
        reason: io::Error,
    },
    /// It is not a sound map.
    #[error("{}: {flaw}", path.display())]
    Unsound {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        flaw: Flaw,
    },
}

/// What is wrong with the bytes of a map.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Flaw {
    /// Something else.
    #[error("expected a map, which begins with `REALOMAP`, found another file; make one by `realo map build`")]
    Foreign,
    /// A map of another program version.
    #[error("expected a map of version {expected}, found version {found}; build the map again by this program")]
    Version {
        /// The version that is read.
        expected: u32,
        /// The file's.
        found: u32,
    },
    /// It was cut, or something was added.
    #[error("expected {expected} bytes by what its head says, found {found}; copy or build the map again")]
    Length {
        /// Bytes by the head.
        expected: u128,
        /// Bytes of the file.
        found: usize,
    },
    /// Its bytes changed.
    #[error(
        "its checksum is {expected:08x}, that of its bytes {found:08x}: it was damaged; copy or build the map again"
    )]
    Checksum {
        /// As the file says.
        expected: u32,
        /// As its bytes give.
        found: u32,
    },
    /// A number that no map has.
    #[error("`{field}`: expected {expected}, found {found}; build the map again")]
    Field {
        /// Its name.
        field: &'static str,
        /// What it may be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
}

/// A setting that cannot be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("setting `{name}`: expected {min} to {max}, found {found}")]
pub struct SettingError {
    /// Its name.
    pub name: &'static str,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// What it is.
    pub found: f64,
}

impl SettingError {
    /// Checks that a setting is within a range.
    pub(crate) fn check(name: &'static str, found: f64, min: f64, max: f64) -> Result<(), Self> {
        match found >= min && found <= max {
            true => Ok(()),
            false => Err(SettingError { name, min, max, found }),
        }
    }
}

/// Why a sweep cannot be added to a map.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BuildError {
    /// A pose that is no place.
    #[error(
        "the sweep of `{agent}` at {stamp} ns: expected a pose of finite numbers within {MAX_PLACE_M:e} m, found {found:?}"
    )]
    Pose {
        /// Whose sweep it is.
        agent: String,
        /// The sweep's stamp.
        stamp: i64,
        /// The position.
        found: [f64; 3],
    },
    /// A sweep too far from the first.
    #[error(
        "the sweep of `{agent}` at {stamp} ns: expected it within {limit} m of the map's origin, found it {found:.0} m away; \
         build a map of its own there, or take larger voxels"
    )]
    Far {
        /// Whose sweep it is.
        agent: String,
        /// The sweep's stamp.
        stamp: i64,
        /// How far a map reaches, m.
        limit: f64,
        /// How far it is, m.
        found: f64,
    },
    /// Nothing was seen often enough.
    #[error(
        "no voxel was seen often enough: {cells} cells in {sweeps} sweeps, expected each in {min_sweeps} sweeps over {apart_s} s or \
         longer; give a longer drive"
    )]
    Empty {
        /// Cells that were hit.
        cells: usize,
        /// Sweeps that were added.
        sweeps: u64,
        /// Sweeps that must hit a voxel.
        min_sweeps: u32,
        /// Seconds from the first to the last of them.
        apart_s: f64,
    },
}

/// Positions are within this of the origin of their frame, m.
pub(crate) const MAX_PLACE_M: f64 = 1e8;

/// Why a sweep cannot be aligned with a map.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// Too few points.
    #[error("expected a sweep of {expected} points or more in {} m, found {found}", .range_m.map(|m| m.to_string()).join(" to "))]
    FewPoints {
        /// Points that it takes, after sampling.
        expected: usize,
        /// Points that there are.
        found: usize,
        /// Ranges that count, m.
        range_m: [f64; 2],
    },
    /// A guess that is no pose.
    #[error("expected a guess of finite numbers, found {0:?}")]
    Guess([f64; 3]),
    /// A guess that is not on the map.
    #[error(
        "expected a guess within {limit:.0} m of the map's origin, found it {found:.0} m away: is it the map of another place?"
    )]
    OffMap {
        /// How far a map reaches, m.
        limit: f64,
        /// How far the guess is, m.
        found: f64,
    },
}

//! Why something cannot cross.

use realo_operator::config::ConfigError;
use realo_schemas::{Name, Nanos};

/// Why a message cannot be put into bytes.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EncodeError {
    /// A payload that no link carries, or a header of another kind than its payload.
    #[error(
        "a {payload} whose header says `{kind}` cannot be sent: links carry points, features, boxes and agent_state"
    )]
    Content {
        /// Type of the payload.
        payload: &'static str,
        /// Kind in the header.
        kind: &'static str,
    },
    /// More of something than its field can count.
    #[error("{field}: {found}, at most {limit} fit")]
    TooMany {
        /// What there is too much of.
        field: &'static str,
        /// How much.
        found: usize,
        /// How much fits.
        limit: usize,
    },
    /// A number that is not finite, or a quaternion that is not of length 1.
    #[error("{0}: a number is not finite, or a quaternion is not of length 1")]
    NotFinite(&'static str),
    /// A map of which some cells are to cross, but that does not tell which.
    #[error(
        "feature map: `budget_bytes` and `min_confidence` choose cells by how sure the map is of each, which it does not tell: \
         say `confidence=true` to its pillar-encoder"
    )]
    NoConfidence,
    /// A map that is too great without any cell.
    #[error("feature map: {needed} bytes without any cell: expected a `budget_bytes` above that, found {budget}")]
    Budget {
        /// Bytes that it takes.
        needed: usize,
        /// Bytes that it may take.
        budget: usize,
    },
    /// A budget that follows the link, without a max.
    #[error("setting `follow`: expected `budget_bytes`, the max of a budget that follows the link, found none")]
    NoMax,
    /// A word of something else than a sender's own packets.
    #[error(
        "input `on_air`: expected a report of topic `on_air`, found `{0}`: wire the output `on_air` of a link or radio"
    )]
    Topic(String),
    /// A channel that 255 finite steps do not span.
    #[error("feature map: channel {channel} goes from {min} to {most}, too far for int8: send it with `elements=f32`")]
    Range {
        /// The channel.
        channel: usize,
        /// Its smallest number.
        min: f32,
        /// Its largest number.
        most: f32,
    },
    /// A step that clouds cannot have.
    #[error("setting `step_m`: expected 0 or a step from 0.000001 to 1 m, found {0}")]
    Step(f64),
    /// A setting outside its range.
    #[error(transparent)]
    Settings(#[from] ConfigError),
    /// A level that zstd does not have.
    #[error("setting `zstd`: expected null or a level from -7 to 19 that is not 0, found 0")]
    NoLevel,
    /// What zstd could not compress.
    #[error("zstd: {0}")]
    Zstd(String),
    /// A feature map without elements.
    #[error("a feature map of {0:?} rows, columns and channels has no elements")]
    Empty([u32; 3]),
    /// Columns or data whose length is not what the payload says.
    #[error("{field}: {found} bytes of data, its dimensions say {expected}")]
    Length {
        /// What it is.
        field: &'static str,
        /// Bytes that are there.
        found: usize,
        /// Bytes that should be.
        expected: u128,
    },
    /// Boxes whose place on Earth is not known.
    #[error(
        "boxes in frame `{0}` without a pose: a CPM says where on Earth they are; send them behind `localization`, or with `boxes=plain`"
    )]
    Nowhere(Name),
    /// A sender that a CPM cannot place.
    #[error(
        "`{field}` of the sender: a CPM takes {expected}, found {found}: see the setting `origin`, or send with `boxes=plain`"
    )]
    Place {
        /// What of its place.
        field: &'static str,
        /// What it may be.
        expected: &'static str,
        /// What it is.
        found: f64,
    },
    /// A stamp that a CPM cannot tell.
    #[error("stamp {0} ns since 1970: a CPM tells times from 2004 to 2143: send boxes of this log with `boxes=plain`")]
    Stamp(Nanos),
    /// What the encoding rules refused.
    #[error("CPM: {0}")]
    Uper(String),
}

/// Why bytes from a link were refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DecodeError {
    /// The bytes end too early.
    #[error("bytes end in `{field}`: {needed} more needed, {left} left")]
    Truncated {
        /// What was being read.
        field: &'static str,
        /// Bytes that it takes.
        needed: u64,
        /// Bytes that there were.
        left: usize,
    },
    /// Bytes after the end of the content.
    #[error("{0} bytes follow the end of the content")]
    Trailing(usize),
    /// A field with a value that it cannot have.
    #[error("`{field}`: expected {expected}, found {found}")]
    Value {
        /// The field.
        field: &'static str,
        /// What it may be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// A text that is not UTF-8.
    #[error("`{0}` is not UTF-8")]
    Text(&'static str),
    /// A codec that this decoder does not have.
    #[error(
        "codec chain [{0}] is unknown; this decoder reads chains of cells, f16, int8 or step and delta, shuffle and zstd that end with plain, and cpm alone"
    )]
    Codec(String),
    /// A packet by another release.
    #[error("`version`: expected {expected}, found {found}: run one release of realo at both ends of the link")]
    Version {
        /// That of this decoder.
        expected: u8,
        /// That of the packet.
        found: u8,
    },
    /// Compressed bytes that do not make as many as the shape of a map or the number of points asks for.
    #[error("`{field}`: expected a zstd frame of {length} bytes, found: {found}")]
    Zstd {
        /// The field.
        field: &'static str,
        /// Bytes that there should be.
        length: usize,
        /// What there was.
        found: String,
    },
    /// A map beyond the limit.
    #[error(
        "feature map of {shape:?} rows, columns and channels takes {size} bytes, at most {limit} are made (setting `max_bytes`)"
    )]
    Expanded {
        /// Rows, columns, channels.
        shape: [u32; 3],
        /// Its bytes in memory.
        size: u128,
        /// The limit.
        limit: usize,
    },
    /// A quantised cloud beyond the limit.
    #[error("cloud of {count} points takes {size} bytes, at most {limit} are made (setting `max_bytes`)")]
    Points {
        /// Number of points.
        count: usize,
        /// Its bytes in memory.
        size: usize,
        /// The limit.
        limit: usize,
    },
    /// A packet beyond the limit.
    #[error("packet of {bytes} bytes, at most {limit} are taken (setting `max_bytes`)")]
    Oversized {
        /// Its size.
        bytes: usize,
        /// The limit.
        limit: usize,
    },
    /// A packet whose header and bytes disagree.
    #[error("forged: the packet's header says {field} {header}, its bytes say {content}")]
    Forged {
        /// The field.
        field: &'static str,
        /// According to the packet's header.
        header: String,
        /// According to the bytes.
        content: String,
    },
    /// Bytes that are no CPM.
    #[error("CPM: `{part}`: expected what TS 103 324 v2.1.1 says, in UPER without headers around it, found: {found}")]
    Cpm {
        /// The part of the message.
        part: &'static str,
        /// What is wrong with it.
        found: String,
    },
    /// A CPM from elsewhere than the map is.
    #[error(
        "CPM: `referencePosition` is {far_km:.0} km away from the map's origin, {limit_km} km at most: give both ends the map's own `origin`"
    )]
    Elsewhere {
        /// How far away.
        far_km: f64,
        /// How far it may be.
        limit_km: f64,
    },
}

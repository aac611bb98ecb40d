//! What crosses a link, as bytes: the transmission encoder and decoder, and the layout that they share.
//!
//! `transmission-encoder`
//!
//! `transmission-decoder`
//!
//! Of maps that tell how sure their maker is of each cell those may cross that `min_confidence` and `budget_bytes` choose. Maps of f32
//! are quantised, shuffled and compressed as the settings `elements`, `shuffle` and `zstd` say, and come out as
//! f32 again; maps of other elements are not quantised. With the setting `step_m` coordinates of points cross as whole steps, all
//! columns as differences, shuffled and compressed; without it they are exact. With `boxes=cpm` boxes cross as a message of ETSI
//! ([`cpm`]) in place of the layout below. docs/reference/packets.md says why, how exactly, and what is refused. Both stages time the steps
//! of a cloud and of a feature map ([`realo_operator::Steps`]).
//!
//! # Layout of the codec `plain`, version 2
//! It is the last one of a packet's codec chain; before it stand those of `f16` or `int8`, `shuffle` and `zstd` that the elements
//! of a map went through, or of `step`, `delta`, `shuffle` and `zstd` that the points of a cloud did, which the bytes say as well.
//!
//! Little endian, no padding. A *text* is a length (u8) and that many bytes of UTF-8. A *pose* is x y z (f64, m) and
//! the unit quaternion x y z w (f64). A *triangle* of a symmetric matrix is its upper triangle by rows, f32.
//!
//! Envelope:
//!
//! | bytes | content |
//! |---|---|
//! | 2 | `rl` |
//! | u8 | version, 2 |
//! | u8 | content: 1 points, 2 features, 3 boxes, 4 agent_state |
//! | u8 | flags: 1 pose, 2 covariance of the pose, 4 a frame other than `<agent>/body` |
//! | u64 | seq |
//! | i64 | stamp, ns |
//! | text | agent |
//! | text | frame (flag 4) |
//! | 56 | pose of the frame in `map` at the stamp (flag 1) |
//! | 84 | triangle of its 6×6 covariance (flag 2) |
//! | 24 | position of the sender in `map` at the stamp, m, where the frame is not its own (flag 8) |
//!
//! Boxes: count (u16), number of classes (u8), a text per class; then per box flags (u8: 1 velocity, 2 track as u32,
//! 4 track as u64, 8 covariance), class (u8), centre x y z, length width height, yaw, score (f32 each), velocity x y z
//! (f32), track, triangle of the 3×3 covariance. A box takes 34 to 78 bytes; 50 boxes with everything known fit 4 KB
//! as long as their track ids fit 32 bits.
//!
//! Points: count (u32), flags (u8: 1 time, 2 ring, 4 quantised, 8 zstd, with 4 only), then the columns x, y, z (f32, m),
//! intensity (u8), time (i32, ns from the stamp), ring (u16). Without its column every time or ring is 0.
//!
//! Quantised points (flag 4): step (f64, m), whether lanes follow (u8, 0 or 1); for each column that crosses its smallest number (i32)
//! and a width (u8, bytes, no more than the column's type has); then planes of count bytes each: of the lanes, if they follow, and of
//! each column as many as it is wide. With flag 8 each plane is a length (u32) and a zstd frame. The plane of lanes has the difference
//! of each point's lane from that of the point before, modulo 256. A coordinate is a number of steps. A number of a column is its smallest
//! one plus a sum modulo 256 to the power of the width: that of the differences up to it in its lane, or up to it in the column
//! where there are no lanes. Differences 0, -1, 1, -2 and so on cross as 0, 1, 2, 3; first byte 0 of all, then byte 1.
//!
//! AgentState: flags (u8: 1 covariance, 2 velocity, 4 angular rate), status (u8: 0 truth, 1 recorded, 2 extrapolated, 3 init,
//! 4 tracking, 5 dead reckoning, 6 lost), pose, triangle of the 6×6 covariance, velocity x y z (f64, m/s in `map`), angular rate x y z (f64, rad/s).
//!
//! Features: rows, columns, channels (u32), cell (f64, m), origin x y (f64, m), element type of the map (u8: 0 f32, 1 f16,
//! 2 bf16, 3 u8), model (text: its name and a hash of model file and weights), conversion of f32 (u8: 0 none, 1 f16, 2 int8),
//! flags (u8: 1 shuffled, 2 zstd, 4 some cells only). With flag 4: how many cells cross (u32), a bit for each cell of the map, the first
//! in the lowest bit of the first byte, and for each that crosses the root of its confidence in 255ths (u8, at least 1); with flag 2
//! the bits and confidences are a length (u32) and a zstd frame. Without a cell that crosses nothing follows. With int8 the columns smallest number and step (f32) of the channels, of which a number is
//! smallest + code × step; with flag 2 a length (u32) and a zstd frame of the elements, else the elements. They come cell by cell that
//! crosses, `[rows, columns, channels]`; shuffled, first byte 0 of every cell, then byte 1, and so on.
//!
//! Nothing else of a header crosses: the receiver's own clock, times and trace stay with the packet's header.

mod agent_state;
mod boxes;
mod budget;
mod bytes;
mod cells;
mod codec;
mod compression;
pub mod cpm;
mod decoder;
mod elements;
mod encoder;
mod envelope;
mod error;
mod features;
mod points;
mod shuffle;

pub use budget::Budget;
pub use codec::{CODEC, Content, Decoder, Dropped, Encoder};
pub use decoder::{Settings as DecoderSettings, TransmissionDecoder};
pub use encoder::{BoxesLayout, Settings as EncoderSettings, TransmissionEncoder};
pub use error::{DecodeError, EncodeError};

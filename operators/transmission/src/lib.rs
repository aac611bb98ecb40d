//! What crosses a link, as bytes: the transmission encoder and decoder, and the layout that they share.
//!
//! `transmission-encoder`
//!
//! | port | direction | types | meaning |
//! |---|---|---|---|
//! | `messages` | in, latest | PointCloud, FeatureMap, Boxes, EgoState | what an agent says |
//! | `packets` | out | Packet | the same as bytes |
//!
//! `transmission-decoder`
//!
//! | port | direction | types | meaning |
//! |---|---|---|---|
//! | `packets` | in, latest | Packet | what a link delivered |
//! | `messages` | out | PointCloud, FeatureMap, Boxes, EgoState | what the sender said |
//!
//! # Feature maps
//! The encoder makes maps of f32 small in up to three steps (arguments `elements`, `shuffle`, `zstd`):
//!
//! 1. *quantisation*: `int8` takes the range of each channel in this map and writes the nearest of 256 evenly spaced
//!    numbers from its least to its greatest, off by at most half a step (a 510th of the range). That is affine: maps behind a ReLU
//!    have no number below 0, and codes symmetric about 0 would waste half of their range; where the least one is 0, as it nearly
//!    always is, 0 stays exactly 0. `f16` is off by at most 2⁻¹¹ of the number, or 2⁻²⁵ below 2⁻¹⁴; what is beyond ±65,504
//!    becomes ±65,504 and is counted as `bounded_features`. `f32` is exact.
//! 2. *shuffling*: the bytes of the same place in each cell lie together, so that a channel is one run. Most cells are empty
//!    and alike, and neighbours are similar: zstd finds them sooner.
//! 3. *compression* by zstd.
//!
//! The decoder undoes them and gives a map of f32 again. A map of other elements than f32 crosses without the first step, as
//! it is. A map with a number that is not finite is neither sent nor taken. The learned compressor is part of the model,
//! before all this (see `realo-nn`).
//!
//! Both time their steps ([`realo_operator::Steps`]): `quantisation`, `shuffling`, `compression`, `serialisation` (shape, scales,
//! bytes) and `packaging` (the envelope); `parsing`, `deserialisation`, `decompression`, `unshuffling`, `dequantisation`. Maps are in
//! the host's memory, so there is no copy from a device.
//!
//! # Layout, version 2
//! [`CODEC`] in words of a packet's codec chain, behind the steps that the elements of a map went through.
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
//! | u8 | content: 1 points, 2 features, 3 boxes, 4 ego_state |
//! | u8 | flags: 1 pose, 2 covariance of the pose, 4 a frame other than `<agent>/body` |
//! | u64 | seq |
//! | i64 | stamp, ns |
//! | text | agent |
//! | text | frame (flag 4) |
//! | 56 | pose of the frame in `map` at the stamp (flag 1) |
//! | 84 | triangle of its 6×6 covariance (flag 2) |
//!
//! Boxes: count (u16), number of classes (u8), a text per class; then per box flags (u8: 1 velocity, 2 track as u32,
//! 4 track as u64, 8 covariance), class (u8), centre x y z, length width height, yaw, score (f32 each), velocity x y z
//! (f32), track, triangle of the 3×3 covariance. A box takes 34 to 78 bytes; 50 boxes with everything known fit 4 KB
//! as long as their track ids fit 32 bits.
//!
//! Points: count (u32), flags (u8: 1 time, 2 ring), then the columns x, y, z (f32, m), intensity (u8), time (i32, ns
//! from the stamp), ring (u16). Without its column every time or ring is 0.
//!
//! EgoState: flags (u8: 1 covariance, 2 velocity, 4 angular rate), status (u8: 0 truth, 1 recorded, 2 extrapolated),
//! pose, triangle of the 6×6 covariance, velocity x y z (f64, m/s in `map`), angular rate x y z (f64, rad/s).
//!
//! Features: rows, columns, channels (u32), cell (f64, m), origin x y (f64, m), element type of the map (u8: 0 f32, 1 f16,
//! 2 bf16, 3 u8), model (text: its name and a hash of model file and weights), conversion (u8: 0 none, 1 f16, 2 int8), flags (u8: 1 shuffled, 2 zstd); for int8 the columns least
//! number and step (f32) of the channels; with flag 2 a length (u32) and so many bytes that zstd makes the elements of; else
//! the elements. A number is least + code × step. Elements come as `[rows, columns, channels]`; shuffled, the bytes of a cell are
//! the rows and the cells the columns of a matrix.
//!
//! Nothing else of a header crosses: the receiver's own clock, times and trace stay with the packet's header.

mod boxes;
mod bytes;
mod codec;
mod decoder;
mod ego_state;
mod elements;
mod encoder;
mod envelope;
mod features;
mod points;
mod shuffle;

pub use bytes::{DecodeError, EncodeError};
pub use codec::{CODEC, Content, Decoder, Dropped, Encoder};
pub use decoder::{DecoderConfig, TransmissionDecoder};
pub use elements::Elements;
pub use encoder::{EncoderConfig, TransmissionEncoder};

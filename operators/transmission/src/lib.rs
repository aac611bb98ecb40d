//! What crosses a link, as bytes: the transmission encoder and decoder, and the plain codec that they share.
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
//! # Layout of the codec `plain`, version 1
//! Little endian, no padding. A *text* is a length (u8) and that many bytes of UTF-8. A *pose* is x y z (f64, m) and
//! the unit quaternion x y z w (f64). A *triangle* of a symmetric matrix is its upper triangle by rows, f32.
//!
//! Envelope:
//!
//! | bytes | content |
//! |---|---|
//! | 2 | `rl` |
//! | u8 | version, 1 |
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
//! Features: rows, columns, channels (u32), cell (f64, m), origin x y (f64, m), element type (u8: 0 f32, 1 f16, 2 bf16,
//! 3 u8), model (text), the elements.
//!
//! Nothing else of a header crosses: the receiver's own clock, times and trace stay with the packet's header.

mod boxes;
mod bytes;
mod codec;
mod decoder;
mod ego_state;
mod encoder;
mod envelope;
mod features;
mod points;

pub use bytes::{DecodeError, EncodeError};
pub use codec::{CODEC, Columns, Content, Dropped, decode, encode};
pub use decoder::{DecoderConfig, TransmissionDecoder};
pub use encoder::{EncoderConfig, TransmissionEncoder};

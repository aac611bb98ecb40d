//! Reads bags of ROS 1 and ROS 2, and says what is in them.
//!
//! [`open`] gives a [`Bag`]: connections (topic, type, serialisation) and messages (connection, log time, bytes). Bags of ROS 1 are plain
//! or in chunks of bz2 or lz4. Bags of ROS 2 are folders or single files of SQLite or MCAP, compressed by zstd as files or message by
//! message, and may be split. Captures of packets are bags too, and packets of LiDARs are clouds ([`packets`]). [`messages`] has what the messages say, in either serialisation. [`Together`] reads several as one. [`survey`] lists the topics of a bag,
//! and [`Draft`] is a first [`map_file::MapFile`], which says whose topics are which.
//!
//! No length in a file is believed: what a file may take of memory is bounded by its size.

mod db3;
mod draft;
mod error;
pub mod map_file;
mod mcap;
pub mod messages;
mod open;
mod pack;
pub mod packets;
mod pcap;
mod recordings;
mod rosbag1;
mod rosbag2;
mod source;
mod sqlite;
mod survey;
mod together;

pub use draft::{Draft, counts_from_start, shortest};
pub use error::BagError;
pub use open::{PICKLE, is_pickle, open, recognise};
pub use packets::decoded;
pub use source::{Bag, Connection, Encoding, Message, Messages};
pub use survey::{Survey, TopicSurvey, is_static, printable, survey};
pub use together::Together;

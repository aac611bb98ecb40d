//! Reads and writes logs: MCAP files of standard ROS 2 messages, which Foxglove and rerun open too.
//!
//! | topic | type | content |
//! |---|---|---|
//! | `/<agent>/points` | `sensor_msgs/msg/PointCloud2` | a sweep in `<agent>/body`: x y z (f32, m), intensity (u8), time (i32, ns from the stamp), ring (u16) |
//! | `/<agent>/sweeps` | `std_msgs/msg/Header` | that a sweep was taken; lets a reader pass over the points |
//! | `/<agent>/pose` | `geometry_msgs/msg/PoseWithCovarianceStamped` | map from body, as the agent believes; covariance 0: unknown |
//! | `/<agent>/pose_truth` | the same | map from body, exactly |
//! | `/<agent>/imu` | `sensor_msgs/msg/Imu` | angular rates and specific forces of its inertial unit |
//! | `/<agent>/fix` | `sensor_msgs/msg/NavSatFix` | positions of its satellite receiver |
//! | `/<agent>/wheels` | `geometry_msgs/msg/TwistWithCovarianceStamped` | the speed of its wheels: `twist.linear.x` |
//! | `/<agent>/detections` | `vision_msgs/msg/Detection3DArray` | detections that were recorded for a sweep, in `<agent>/body` |
//! | `/<agent>/own_labels` | the same | objects that the agent's own side labelled, in its true body frame |
//! | `/<agent>/ground_truth` | the same | all objects at a sweep's stamp, in the agent's true body frame; `id` is the track |
//! | `/<agent>/detections_info`, `/<agent>/ground_truth_info` | `realo_msgs/msg/BoxesInfo` | companion: exact headings, velocities, covariances, the agent's own point counts, whether the frame is scored |
//! | `/<agent>/own_labels_info` | `realo_msgs/msg/BoxesInfo` | the same of own labels |
//! | `/<agent>/ground_truth_views`, `/<agent>/own_labels_views` | `realo_msgs/msg/Views` | where the objects could be labelled: images of cameras, in the same frame |
//! | `/<agent>/ground_truth_markers` | `visualization_msgs/msg/MarkerArray` | for viewers |
//! | `/<agent>/packets` | `realo_msgs/msg/SentPacket` | what the agent gives to the link of a sweep, computed beforehand ([`LogCopy`]) |
//! | `/tf` | `tf2_msgs/msg/TFMessage` | for viewers: map from body as believed |
//! | `/tf_static` | `tf2_msgs/msg/TFMessage` | of others: how frames lie in each other |
//!
//! Log time is when a message existed (a sweep: its end); the header's stamp, or the publish time where that is 0, is the
//! measurement's; the message's sequence
//! counts per topic from 0. Messages of one sweep (points, detections, truth) share their stamp. Chunks are zstd, at
//! most 0.5 s long, and never hold clouds or packets beside other messages. A log that was cut is read up to the time before which
//! neither clouds nor anything else is missing. The metadata record `realo` at the beginning says what
//! the log is ([`LogInfo`]); `realo_end` lists the scored frames. `docs/reference/log-format.md` has all that a writer must know.
//!
//! Points that others wrote in the frame of their sensor are brought to the body frame by `/tf_static` and `/tf`. No
//! length in a file is believed: what a file may take of memory is bounded by its size.

mod box_faults;
pub mod boxes;
pub mod cdr;
mod clocks;
pub mod cloud;
mod describe;
mod error;
mod findings;
mod foreign;
mod frames;
mod gaps;
mod geodesy;
mod info;
mod level;
pub mod limits;
mod log;
mod log_writer;
mod map_points;
mod mcap_file;
mod mcap_writer;
mod merge;
pub mod motion;
mod motion_faults;
mod motion_stuck;
mod motion_turns;
pub mod objects;
pub mod outline;
mod owner;
pub mod packets;
pub mod pose;
mod poses;
mod precomputed;
mod rebase;
mod records;
mod repeats;
pub mod scene;
mod schema;
pub mod shell;
mod stamps;
mod sweeps;
mod times;
mod timing;
mod topics;
mod tracks;
mod truth_faults;
pub mod views;
mod words;

pub use boxes::{BoxesInfo, WRONG_HEADINGS, WrongHeadings};
pub use clocks::{BEHIND_MOST, PeerClock, Step, clock_words, kind_of_clock};
pub use describe::{Described, Description, RecordingDescription, TopicInfo, describe, describe_any};
pub use error::LogError;
pub use findings::{SWEEPS_OF_TWO_TOPICS, UNDECLARED, WRONG_COVARIANCES, sweeps_of_one_topic};
pub use frames::{Frames, NoWay, Way, bare};
pub use gaps::{Bare, Gaps, Lack, Missing, SWEEPS_MISSING, SWEEPS_WITHOUT_DETECTIONS};
pub use geodesy::MapOrigin;
pub use info::{
    AgentInfo, AgentKind, ClockError, LOG_RECORD, Levelled, LogInfo, check_name as check_agent_name, program,
};
pub use level::{Attitude, Attitudes, LEVEL, level_state, levelled_while_played, need_level};
pub use log::{Entry, Log, LogReader};
pub use log_writer::{ANTENNA_FRAME, AXLE_FRAME, IMU_FRAME, LogWriter, sensor_frame};
pub use map_points::{TRANSFORMS_DIFFER, TransformsApart};
pub use mcap_file::{ChannelInfo, McapFile, Messages, RawMessage, Truncation};
pub use mcap_writer::{ChannelId, ChunkGroup, Failure, McapWriter, Output};
pub use merge::{Merge, Moved};
pub use motion::{FixReading, ImuReading, WheelReading};
pub use motion_faults::MOTION_UNUSABLE;
pub use owner::{Owner, refuse_foreign};
pub use packets::SentPacket;
pub use poses::{MAX_GAP, Standing, is_posed, pose_track, pose_tracks};
pub use precomputed::{LaneStage, LogCopy, Precomputed};
pub use rebase::RebasedStream;
pub use schema::Schema;
pub use stamps::same;
pub use sweeps::{SweepsInfo, intensity_scale};
pub use timing::{Outside, no_common_time};
pub use topics::Stream;
pub use tracks::track_of;
pub use truth_faults::{TRUTH_SHIFTED, TruthFault, TruthFinding, truth_faults};
pub use words::{nearest_words, side};

/// Name of the metadata record of a recording of a run.
pub const RECORDING_RECORD: &str = "realo_recording";

use crate::Schema;
use crate::mcap_writer::ChunkGroup;

/// One of an agent's topics.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Stream {
    /// What the agent believes of its pose.
    Pose,
    /// Its true pose.
    PoseTruth,
    /// Samples of its inertial unit.
    Imu,
    /// Positions of its satellite receiver.
    Fix,
    /// Speeds of its wheels.
    Wheels,
    /// That a sweep was taken, and when.
    Sweeps,
    /// The sweep's points.
    Points,
    /// Recorded detections.
    Detections,
    /// Their companion.
    DetectionsInfo,
    /// Where own labels could be.
    OwnLabelsViews,
    /// What the agent's own side labelled, in its true body frame.
    OwnLabels,
    /// Their companion.
    OwnLabelsInfo,
    /// Where ground truth could be.
    GroundTruthViews,
    /// Ground truth in the agent's true body frame.
    GroundTruth,
    /// Its companion.
    GroundTruthInfo,
    /// Ground truth for viewers.
    GroundTruthMarkers,
    /// What the agent sends of its sweeps, computed beforehand.
    Packets,
}

impl Stream {
    /// Every stream; at equal log times messages are read in this order.
    pub const ALL: [Stream; 17] = [
        Stream::Pose,
        Stream::PoseTruth,
        Stream::Imu,
        Stream::Fix,
        Stream::Wheels,
        Stream::Sweeps,
        Stream::Points,
        Stream::Detections,
        Stream::DetectionsInfo,
        Stream::OwnLabelsViews,
        Stream::OwnLabels,
        Stream::OwnLabelsInfo,
        Stream::GroundTruthViews,
        Stream::GroundTruth,
        Stream::GroundTruthInfo,
        Stream::GroundTruthMarkers,
        Stream::Packets,
    ];

    /// The part of the topic behind the agent's name.
    pub fn as_str(self) -> &'static str {
        match self {
            Stream::Pose => "pose",
            Stream::PoseTruth => "pose_truth",
            Stream::Imu => "imu",
            Stream::Fix => "fix",
            Stream::Wheels => "wheels",
            Stream::Sweeps => "sweeps",
            Stream::Points => "points",
            Stream::Detections => "detections",
            Stream::DetectionsInfo => "detections_info",
            Stream::OwnLabelsViews => "own_labels_views",
            Stream::OwnLabels => "own_labels",
            Stream::OwnLabelsInfo => "own_labels_info",
            Stream::GroundTruthViews => "ground_truth_views",
            Stream::GroundTruth => "ground_truth",
            Stream::GroundTruthInfo => "ground_truth_info",
            Stream::GroundTruthMarkers => "ground_truth_markers",
            Stream::Packets => "packets",
        }
    }

    /// The topic of an agent.
    pub fn topic(self, agent: &str) -> String {
        format!("/{agent}/{}", self.as_str())
    }

    /// Type of its messages.
    pub fn schema(self) -> Schema {
        match self {
            Stream::Pose | Stream::PoseTruth => Schema::PoseWithCovarianceStamped,
            Stream::Imu => Schema::Imu,
            Stream::Fix => Schema::NavSatFix,
            Stream::Wheels => Schema::TwistWithCovarianceStamped,
            Stream::Sweeps => Schema::Header,
            Stream::Points => Schema::PointCloud2,
            Stream::Detections | Stream::OwnLabels | Stream::GroundTruth => Schema::Detection3DArray,
            Stream::DetectionsInfo | Stream::OwnLabelsInfo | Stream::GroundTruthInfo => Schema::BoxesInfo,
            Stream::OwnLabelsViews | Stream::GroundTruthViews => Schema::Views,
            Stream::GroundTruthMarkers => Schema::MarkerArray,
            Stream::Packets => Schema::SentPacket,
        }
    }

    /// Whether it is one of an agent's motion sensors, whose messages are joined with no sweep.
    pub fn is_motion(self) -> bool {
        matches!(self, Stream::Imu | Stream::Fix | Stream::Wheels)
    }

    pub(crate) fn group(self) -> ChunkGroup {
        ChunkGroup::of(&self.schema().name())
    }
}

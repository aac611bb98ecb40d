//! ROS 2 message definitions, with everything nested in them, as MCAP schemas of encoding `ros2msg` want them.

/// A message type of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Schema {
    /// LiDAR sweeps.
    PointCloud2,
    /// That a sweep was taken, and when.
    Header,
    /// Poses of agents.
    PoseWithCovarianceStamped,
    /// Samples of inertial units.
    Imu,
    /// Positions of satellite receivers.
    NavSatFix,
    /// Speeds of wheels.
    TwistWithCovarianceStamped,
    /// Boxes.
    Detection3DArray,
    /// What `Detection3DArray` cannot say of its boxes.
    BoxesInfo,
    /// Where objects could be labelled.
    Views,
    /// Boxes for viewers.
    MarkerArray,
    /// Frames for viewers.
    TfMessage,
    /// Outlines of agents, in recordings.
    PolygonStamped,
    /// JSON documents.
    String,
    /// Headers of what crossed a link.
    PacketInfo,
    /// What an agent sent, computed beforehand.
    SentPacket,
    /// Boxes for Foxglove's viewers, while a run goes on; not in logs.
    SceneUpdate,
    /// Boxes for Autoware; not in logs.
    DetectedObjects,
}

impl Schema {
    /// The types of logs.
    const ALL: [Schema; 15] = [
        Schema::PointCloud2,
        Schema::Header,
        Schema::PoseWithCovarianceStamped,
        Schema::Imu,
        Schema::NavSatFix,
        Schema::TwistWithCovarianceStamped,
        Schema::Detection3DArray,
        Schema::BoxesInfo,
        Schema::Views,
        Schema::MarkerArray,
        Schema::TfMessage,
        Schema::PolygonStamped,
        Schema::String,
        Schema::PacketInfo,
        Schema::SentPacket,
    ];

    /// The schema of a name, if it is one of logs.
    pub fn named(name: &str) -> Option<Self> {
        Schema::ALL.into_iter().find(|schema| schema.name() == name)
    }

    /// Name in MCAP, `package/msg/Type`.
    pub fn name(self) -> String {
        self.short().replacen('/', "/msg/", 1)
    }

    /// Definition text.
    pub fn text(self) -> String {
        let mut order = vec![self.short()];
        let mut text = String::new();
        let mut at = 0;
        while let Some(name) = order.get(at).copied() {
            let definition = definition(name);
            if at > 0 {
                text.push_str(&format!("{}\nMSG: {name}\n", "=".repeat(80)));
            }
            text.push_str(definition);
            let nested = DEFINITIONS
                .iter()
                .map(|(name, _)| *name)
                .filter(|nested| uses(definition, nested));
            let new: Vec<&str> = nested.filter(|nested| !order.contains(nested)).collect();
            order.extend(new);
            at += 1;
        }
        text
    }

    fn short(self) -> &'static str {
        match self {
            Schema::PointCloud2 => "sensor_msgs/PointCloud2",
            Schema::Header => "std_msgs/Header",
            Schema::PoseWithCovarianceStamped => "geometry_msgs/PoseWithCovarianceStamped",
            Schema::Imu => "sensor_msgs/Imu",
            Schema::NavSatFix => "sensor_msgs/NavSatFix",
            Schema::TwistWithCovarianceStamped => "geometry_msgs/TwistWithCovarianceStamped",
            Schema::Detection3DArray => "vision_msgs/Detection3DArray",
            Schema::BoxesInfo => "realo_msgs/BoxesInfo",
            Schema::Views => "realo_msgs/Views",
            Schema::MarkerArray => "visualization_msgs/MarkerArray",
            Schema::TfMessage => "tf2_msgs/TFMessage",
            Schema::PolygonStamped => "geometry_msgs/PolygonStamped",
            Schema::String => "std_msgs/String",
            Schema::PacketInfo => "realo_msgs/PacketInfo",
            Schema::SentPacket => "realo_msgs/SentPacket",
            Schema::SceneUpdate => "foxglove_msgs/SceneUpdate",
            Schema::DetectedObjects => "autoware_perception_msgs/DetectedObjects",
        }
    }
}

fn definition(name: &str) -> &'static str {
    let found = DEFINITIONS.iter().find(|(known, _)| *known == name);
    found.expect("every schema is in the table").1
}

fn uses(definition: &str, name: &str) -> bool {
    let kinds = definition.lines().filter_map(|line| line.split([' ', '[']).next());
    kinds.into_iter().any(|kind| kind == name)
}

const DEFINITIONS: &[(&str, &str)] = &[
    ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
    ("std_msgs/String", "string data\n"),
    ("std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n"),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    (
        "geometry_msgs/Quaternion",
        "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    ),
    (
        "geometry_msgs/Pose",
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    ),
    (
        "geometry_msgs/PoseWithCovariance",
        "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    ),
    (
        "geometry_msgs/PoseWithCovarianceStamped",
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
    ),
    (
        "geometry_msgs/Twist",
        "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    ),
    (
        "geometry_msgs/TwistWithCovariance",
        "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    ),
    (
        "geometry_msgs/TwistWithCovarianceStamped",
        "std_msgs/Header header\ngeometry_msgs/TwistWithCovariance twist\n",
    ),
    (
        "sensor_msgs/Imu",
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n\
         geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n\
         geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    ),
    (
        "sensor_msgs/NavSatStatus",
        "int8 STATUS_UNKNOWN=-2\nint8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\nint8 STATUS_SBAS_FIX=1\nint8 STATUS_GBAS_FIX=2\n\
         int8 status\nuint16 SERVICE_UNKNOWN=0\nuint16 SERVICE_GPS=1\nuint16 SERVICE_GLONASS=2\nuint16 SERVICE_COMPASS=4\n\
         uint16 SERVICE_GALILEO=8\nuint16 service\n",
    ),
    (
        "sensor_msgs/NavSatFix",
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\nfloat64 altitude\n\
         float64[9] position_covariance\nuint8 COVARIANCE_TYPE_UNKNOWN=0\nuint8 COVARIANCE_TYPE_APPROXIMATED=1\n\
         uint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2\nuint8 COVARIANCE_TYPE_KNOWN=3\nuint8 position_covariance_type\n",
    ),
    (
        "geometry_msgs/Transform",
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    ),
    (
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    ),
    ("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms\n"),
    ("geometry_msgs/Point32", "float32 x\nfloat32 y\nfloat32 z\n"),
    ("geometry_msgs/Polygon", "geometry_msgs/Point32[] points\n"),
    (
        "geometry_msgs/PolygonStamped",
        "std_msgs/Header header\ngeometry_msgs/Polygon polygon\n",
    ),
    (
        "sensor_msgs/PointField",
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n\
         uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    ),
    (
        "sensor_msgs/PointCloud2",
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n\
         uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
    ),
    (
        "sensor_msgs/CompressedImage",
        "std_msgs/Header header\nstring format\nuint8[] data\n",
    ),
    ("vision_msgs/ObjectHypothesis", "string class_id\nfloat64 score\n"),
    (
        "vision_msgs/ObjectHypothesisWithPose",
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    ),
    (
        "vision_msgs/BoundingBox3D",
        "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    ),
    (
        "vision_msgs/Detection3D",
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n\
         string id\n",
    ),
    (
        "vision_msgs/Detection3DArray",
        "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
    ),
    ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n"),
    ("visualization_msgs/MeshFile", "string filename\nuint8[] data\n"),
    (
        "visualization_msgs/Marker",
        "int32 ARROW=0\nint32 CUBE=1\nint32 SPHERE=2\nint32 CYLINDER=3\nint32 LINE_STRIP=4\nint32 LINE_LIST=5\n\
         int32 CUBE_LIST=6\nint32 SPHERE_LIST=7\nint32 POINTS=8\nint32 TEXT_VIEW_FACING=9\nint32 MESH_RESOURCE=10\n\
         int32 TRIANGLE_LIST=11\nint32 ADD=0\nint32 MODIFY=0\nint32 DELETE=2\nint32 DELETEALL=3\n\
         std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n\
         geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\n\
         bool frame_locked\ngeometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n\
         sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\nstring text\n\
         string mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n",
    ),
    (
        "visualization_msgs/MarkerArray",
        "visualization_msgs/Marker[] markers\n",
    ),
    (
        "realo_msgs/BoxesInfo",
        "# What Detection3DArray cannot say of its boxes; entry i belongs to detection i.\n\
         std_msgs/Header header\n\
         # Number of the sweep, per agent from the log's beginning.\n\
         uint64 seq\n\
         # Whether the frame is scored.\n\
         bool key\n\
         # Map from frame, where known: x y z, quaternion x y z w.\n\
         float64[] pose\n\
         # Headings, rad, as they were before they became quaternions.\n\
         float64[] yaw\n\
         # Three numbers per box, m/s in the header's frame; NaN where unknown.\n\
         float64[] velocity\n\
         # Nine numbers per box over (x, y, yaw), row-major; NaN where unknown.\n\
         float64[] covariance\n\
         # Agents whose points are counted.\n\
         string[] agents\n\
         # Points per box and agent, row-major; empty where nobody counted.\n\
         uint32[] points\n",
    ),
    (
        "realo_msgs/Views",
        "# What cameras have in their images: where objects could be labelled. One entry of each list, or so many as it says, \
         per view.\n\
         std_msgs/Header header\n\
         # Frame from camera (x right, y down, z ahead): x y z, quaternion x y z w.\n\
         float64[] pose\n\
         # Focal lengths in x and y, pixels.\n\
         float64[] focal\n\
         # Principal point x, y, pixels.\n\
         float64[] center\n\
         # Width, height of the image, pixels.\n\
         uint32[] size\n\
         # How far what is in the image may lie beside it at the stamp, m.\n\
         float64[] margin\n",
    ),
    (
        "realo_msgs/PacketInfo",
        "# The header of a message on a link.\n\
         std_msgs/Header header\n\
         string agent\nstring to\nstring kind\nuint64 seq\n\
         # When it was ready at the recorder's input, ns.\n\
         int64 ready\n\
         # Codecs, first applied first, and the size they left.\n\
         string[] codec\nuint64 bytes\n",
    ),
    (
        "realo_msgs/SentPacket",
        "# A message as its sender gave it to the link. The header's frame is that of the content.\n\
         std_msgs/Header header\n\
         # points, features or boxes, and the number of the sweep.\n\
         string kind\nuint64 seq\n\
         # Codecs, first applied first.\n\
         string[] codec\nuint8[] data\n",
    ),
    (
        "autoware_perception_msgs/ObjectClassification",
        "uint8 UNKNOWN=0\nuint8 CAR=1\nuint8 TRUCK=2\nuint8 BUS=3\nuint8 TRAILER=4\nuint8 MOTORCYCLE=5\nuint8 BICYCLE=6\n\
         uint8 PEDESTRIAN=7\nuint8 label\nfloat32 probability\n",
    ),
    (
        "autoware_perception_msgs/DetectedObjectKinematics",
        "uint8 UNAVAILABLE=0\nuint8 SIGN_UNKNOWN=1\nuint8 AVAILABLE=2\n\
         geometry_msgs/PoseWithCovariance pose_with_covariance\nbool has_position_covariance\nuint8 orientation_availability\n\
         geometry_msgs/TwistWithCovariance twist_with_covariance\nbool has_twist\nbool has_twist_covariance\n",
    ),
    (
        "autoware_perception_msgs/Shape",
        "uint8 BOUNDING_BOX=0\nuint8 CYLINDER=1\nuint8 POLYGON=2\nuint8 type\ngeometry_msgs/Polygon footprint\n\
         geometry_msgs/Vector3 dimensions\n",
    ),
    (
        "autoware_perception_msgs/DetectedObject",
        "float32 existence_probability\nautoware_perception_msgs/ObjectClassification[] classification\n\
         autoware_perception_msgs/DetectedObjectKinematics kinematics\nautoware_perception_msgs/Shape shape\n",
    ),
    (
        "autoware_perception_msgs/DetectedObjects",
        "std_msgs/Header header\nautoware_perception_msgs/DetectedObject[] objects\n",
    ),
    (
        "foxglove_msgs/SceneUpdate",
        "foxglove_msgs/SceneEntityDeletion[] deletions\nfoxglove_msgs/SceneEntity[] entities\n",
    ),
    (
        "foxglove_msgs/SceneEntityDeletion",
        "uint8 MATCHING_ID=0\nuint8 ALL=1\nbuiltin_interfaces/Time timestamp\nuint8 type\nstring id\n",
    ),
    (
        "foxglove_msgs/SceneEntity",
        "builtin_interfaces/Time timestamp\nstring frame_id\nstring id\nbuiltin_interfaces/Duration lifetime\n\
         bool frame_locked\nfoxglove_msgs/KeyValuePair[] metadata\nfoxglove_msgs/ArrowPrimitive[] arrows\n\
         foxglove_msgs/CubePrimitive[] cubes\nfoxglove_msgs/SpherePrimitive[] spheres\n\
         foxglove_msgs/CylinderPrimitive[] cylinders\nfoxglove_msgs/LinePrimitive[] lines\n\
         foxglove_msgs/TriangleListPrimitive[] triangles\nfoxglove_msgs/TextPrimitive[] texts\n\
         foxglove_msgs/ModelPrimitive[] models\n",
    ),
    ("foxglove_msgs/KeyValuePair", "string key\nstring value\n"),
    ("foxglove_msgs/Color", "float64 r\nfloat64 g\nfloat64 b\nfloat64 a\n"),
    (
        "foxglove_msgs/ArrowPrimitive",
        "geometry_msgs/Pose pose\nfloat64 shaft_length\nfloat64 shaft_diameter\nfloat64 head_length\n\
         float64 head_diameter\nfoxglove_msgs/Color color\n",
    ),
    (
        "foxglove_msgs/CubePrimitive",
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\nfoxglove_msgs/Color color\n",
    ),
    (
        "foxglove_msgs/SpherePrimitive",
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\nfoxglove_msgs/Color color\n",
    ),
    (
        "foxglove_msgs/CylinderPrimitive",
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\nfloat64 bottom_scale\nfloat64 top_scale\n\
         foxglove_msgs/Color color\n",
    ),
    (
        "foxglove_msgs/LinePrimitive",
        "uint8 LINE_STRIP=0\nuint8 LINE_LOOP=1\nuint8 LINE_LIST=2\nuint8 type\ngeometry_msgs/Pose pose\n\
         float64 thickness\nbool scale_invariant\ngeometry_msgs/Point[] points\nfoxglove_msgs/Color color\n\
         foxglove_msgs/Color[] colors\nuint32[] indices\n",
    ),
    (
        "foxglove_msgs/TriangleListPrimitive",
        "geometry_msgs/Pose pose\ngeometry_msgs/Point[] points\nfoxglove_msgs/Color color\n\
         foxglove_msgs/Color[] colors\nuint32[] indices\n",
    ),
    (
        "foxglove_msgs/TextPrimitive",
        "geometry_msgs/Pose pose\nbool billboard\nfloat64 font_size\nbool scale_invariant\n\
         foxglove_msgs/Color color\nstring text\n",
    ),
    (
        "foxglove_msgs/ModelPrimitive",
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nfoxglove_msgs/Color color\nbool override_color\n\
         string url\nstring media_type\nuint8[] data\n",
    ),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_hold_every_nested_type_once() {
        let text = Schema::MarkerArray.text();
        for nested in [
            "visualization_msgs/Marker",
            "sensor_msgs/CompressedImage",
            "builtin_interfaces/Time",
        ] {
            assert_eq!(text.matches(&format!("MSG: {nested}\n")).count(), 1, "{nested}\n{text}");
        }
        assert!(text.starts_with("visualization_msgs/Marker[] markers\n====="));
        assert_eq!(Schema::TfMessage.name(), "tf2_msgs/msg/TFMessage");
    }
}

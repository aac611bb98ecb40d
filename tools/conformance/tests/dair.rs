//! The known answer on real data: late fusion of the recorded labels of eleven DAIR-V2X-C pairs, through the operators.
//! Reads `$REALO_SHARED/data/dair`, which is in the layout of the original dataset.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion};
use realo_evaluator::Evaluator;
use realo_fusion_boxes::FusionBoxes;
use realo_nms::Nms;
use realo_operator::{Describe, Operator, Outputs, PortId, StageInputs};
use realo_schemas::report::from_report;
use realo_schemas::{Box3, Boxes, GroundTruth, Header, Kind, Message, Name, Payload, Pose, Report, Selection};
use realo_scoring::{Evaluation, EvaluationReport, frame_scores};
use serde_json::Value;

struct Pair {
    name: String,
    map_from_vehicle: Isometry3<f64>,
    map_from_roadside: Isometry3<f64>,
    vehicle: Vec<Box3>,
    roadside: Vec<Box3>,
    truth: Vec<Box3>,
}

fn read(path: PathBuf) -> Value {
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

fn pose(value: &Value, offset: [f64; 2]) -> Isometry3<f64> {
    let rotation = Matrix3::from_fn(|row, column| number(&value["rotation"][row][column]));
    let [x, y, z] = [0, 1, 2].map(|axis| number(&value["translation"][axis][0]));
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Isometry3::from_parts(Translation3::new(x + offset[0], y + offset[1], z), rotation)
}

fn is_vehicle(label: &Value) -> bool {
    ["car", "van", "truck", "bus"]
        .iter()
        .any(|class| label["type"].as_str().unwrap().eq_ignore_ascii_case(class))
}

fn box3(label: &Value, center: [f64; 3], [length, width, height]: [f64; 3], yaw: f64) -> Box3 {
    Box3 {
        center,
        length,
        width,
        height,
        yaw,
        velocity: None,
        class: label["type"].as_str().unwrap().into(),
        score: 1.0,
        track: None,
        covariance: None,
    }
}

/// Boxes of one side, in its sensor's frame.
fn labels(path: PathBuf) -> Vec<Box3> {
    let object = |label: &Value| {
        let center = ["x", "y", "z"].map(|axis| number(&label["3d_location"][axis]));
        let extent = ["l", "w", "h"].map(|axis| number(&label["3d_dimensions"][axis]));
        box3(label, center, extent, number(&label["rotation"]))
    };
    let labels = read(path);
    labels
        .as_array()
        .unwrap()
        .iter()
        .filter(|label| is_vehicle(label))
        .map(object)
        .collect()
}

/// Cooperative labels: eight points each in the world, front-left first.
fn truth(path: PathBuf, vehicle_from_map: &Isometry3<f64>) -> Vec<Box3> {
    let object = |label: &Value| {
        let points = label["world_8_points"].as_array().unwrap().iter();
        let points: Vec<Point3<f64>> = points
            .map(|point| vehicle_from_map * Point3::from([0, 1, 2].map(|axis| number(&point[axis]))))
            .collect();
        let center = points.iter().map(|point| point.coords).sum::<nalgebra::Vector3<f64>>() / 8.0;
        // The mean of the four edges in each direction.
        let edge = |pairs: [[usize; 2]; 4]| pairs.map(|[from, to]| points[to] - points[from]);
        let length = |edges: [nalgebra::Vector3<f64>; 4]| edges.iter().map(|edge| edge.norm()).sum::<f64>() / 4.0;
        let along = edge([[3, 0], [2, 1], [7, 4], [6, 5]]);
        let extent = [
            length(along),
            length(edge([[0, 1], [3, 2], [4, 5], [7, 6]])),
            length(edge([[0, 4], [1, 5], [2, 6], [3, 7]])),
        ];
        let heading = along.iter().sum::<nalgebra::Vector3<f64>>();
        box3(label, center.into(), extent, libm::atan2(heading.y, heading.x))
    };
    let labels = read(path);
    labels
        .as_array()
        .unwrap()
        .iter()
        .filter(|label| is_vehicle(label))
        .map(object)
        .collect()
}

fn pairs(root: &Path) -> Vec<Pair> {
    let index = read(root.join("cooperative/data_info.json"));
    let stem = |value: &Value| {
        Path::new(value.as_str().unwrap())
            .file_stem()
            .unwrap()
            .to_str()
            .unwrap()
            .to_string()
    };
    let pair = |entry: &Value| {
        let (vehicle, roadside) = (
            stem(&entry["vehicle_pointcloud_path"]),
            stem(&entry["infrastructure_pointcloud_path"]),
        );
        let calibration =
            |side: &str, kind: &str, frame: &str| read(root.join(format!("{side}/calib/{kind}/{frame}.json")));
        let offset = ["delta_x", "delta_y"].map(|axis| entry["system_error_offset"][axis].as_f64().unwrap_or(0.0));
        let novatel_from_lidar = pose(
            &calibration("vehicle-side", "lidar_to_novatel", &vehicle)["transform"],
            [0.0; 2],
        );
        let map_from_vehicle =
            pose(&calibration("vehicle-side", "novatel_to_world", &vehicle), [0.0; 2]) * novatel_from_lidar;
        Pair {
            map_from_roadside: pose(
                &calibration("infrastructure-side", "virtuallidar_to_world", &roadside),
                offset,
            ),
            vehicle: labels(root.join(format!("vehicle-side/label/lidar/{vehicle}.json"))),
            roadside: labels(root.join(format!("infrastructure-side/label/virtuallidar/{roadside}.json"))),
            truth: truth(
                root.join(format!("cooperative/label_world/{vehicle}.json")),
                &map_from_vehicle.inverse(),
            ),
            map_from_vehicle,
            name: vehicle,
        }
    };
    let mut pairs: Vec<Pair> = index.as_array().unwrap().iter().map(pair).collect();
    pairs.sort_by(|a, b| a.name.cmp(&b.name));
    pairs
}

fn configured<O: Operator>(args: &[&str]) -> O {
    let args: Vec<String> = args.iter().map(|arg| arg.to_string()).collect();
    O::new(realo_operator::config::parse::<<O as Describe>::Settings>(&args).unwrap()).unwrap()
}

/// Hands a message to an input of an operator and returns what it sends on its first output.
fn through<O: Operator>(operator: &mut O, input: &str, message: Message) -> Option<Message> {
    let port = O::Input::PORTS.iter().position(|port| port.name == input).unwrap();
    let mut out = Outputs::at(message.header.ready);
    operator.on_message(PortId(port), message, &mut out).unwrap();
    out.take_sent()
        .into_iter()
        .find(|(port, _)| *port == PortId(0))
        .map(|(_, message)| message)
}

fn header(agent: &str, kind: Kind, seq: u64, pose: &Isometry3<f64>) -> Header {
    let stamp = 100_000_000 * seq as i64;
    let mut header = Header::origin(&"dair".into(), &agent.into(), kind, seq, stamp, stamp);
    header.pose = Some(Pose::exact(*pose));
    header
}

#[derive(Clone, Copy, PartialEq)]
enum Who {
    Vehicle,
    Roadside,
    Both,
}

/// Runs the graph of late fusion by hand: each side's NMS, fusion, joint NMS, evaluator.
fn late_fusion(pairs: &[Pair], who: Who) -> Evaluation {
    let (mut ego_nms, mut nms): (Nms, Nms) = (configured(&[]), configured(&[]));
    let mut fusion: FusionBoxes = configured(&[]);
    let mut joint_nms: Nms = configured(&["region=[-100, 100, -40, 40]"]);
    let mut evaluator: Evaluator = configured(&["protocol=dair"]);
    for (pair, seq) in pairs.iter().zip(0u64..) {
        let ego = header("vehicle", Kind::Boxes, seq, &pair.map_from_vehicle);
        let own = if who == Who::Roadside {
            Vec::new()
        } else {
            pair.vehicle.clone()
        };
        let own = through(&mut ego_nms, "proposals", Message::new(ego.clone(), Boxes(own))).unwrap();
        let other = Message::new(
            header("roadside", Kind::Boxes, seq, &pair.map_from_roadside),
            Boxes(pair.roadside.clone()),
        );
        let entries = if who == Who::Vehicle {
            vec![]
        } else {
            vec![through(&mut nms, "proposals", other).unwrap()]
        };
        assert!(through(&mut fusion, "ego", own).is_none());
        let fused = through(&mut fusion, "selections", Message::new(ego, Selection { query: seq, entries })).unwrap();
        let boxes = through(&mut joint_nms, "proposals", fused).unwrap();
        let truth = GroundTruth {
            boxes: pair.truth.clone(),
            agents: vec![Name::from("vehicle"), Name::from("roadside")],
            points: vec![],
            ego_footprint: None,
            key: true,
            ..GroundTruth::default()
        };
        let truth_header = header("vehicle", Kind::Truth, seq, &pair.map_from_vehicle);
        assert!(through(&mut evaluator, "truth", Message::new(truth_header, truth)).is_none());
        assert!(through(&mut evaluator, "boxes", boxes).is_none());
    }
    let mut out = Outputs::at(0);
    evaluator.on_end(&mut out).unwrap();
    let Payload::Report(report) = out.take_sent().remove(0).1.payload else {
        panic!("no report")
    };
    let report: Report = report;
    from_report::<EvaluationReport>(&report).unwrap().evaluation
}

/// (objects, true, false) at IoU 0.5 by pair.
fn counts(evaluation: &Evaluation, pairs: &[Pair]) -> BTreeMap<String, (u64, u64, u64)> {
    let frames = frame_scores(evaluation).into_iter().zip(pairs);
    frames
        .map(|(frame, pair)| {
            let counts = frame.counts["vehicle"]["0.5"];
            (
                pair.name.clone(),
                (counts.total, counts.true_positives, counts.false_positives),
            )
        })
        .collect()
}

#[test]
fn late_fusion_of_dair_gives_the_known_counts() {
    let Some(sample) = skipped::shared("data/dair") else {
        return;
    };
    let pairs = pairs(&sample);
    assert_eq!(pairs.len(), 11);
    let [vehicle, roadside, both] =
        [Who::Vehicle, Who::Roadside, Who::Both].map(|who| counts(&late_fusion(&pairs, who), &pairs));
    // Objects; vehicle true; roadside true, false; both true. Nothing else is false.
    let expected = [
        ("015372", 15, 14, 6, 0, 15),
        ("015383", 15, 14, 2, 4, 15),
        ("015385", 19, 15, 5, 3, 18),
        ("015400", 16, 8, 9, 0, 16),
        ("015401", 14, 6, 9, 0, 14),
        ("015402", 14, 6, 9, 0, 14),
        ("015403", 17, 7, 10, 0, 17),
        ("015404", 15, 6, 9, 0, 15),
        ("015405", 14, 5, 9, 0, 14),
        ("015428", 18, 6, 12, 0, 18),
        ("015442", 14, 5, 9, 0, 14),
    ];
    for (pair, total, by_vehicle, by_roadside, wrong, by_both) in expected {
        assert_eq!(vehicle[pair], (total, by_vehicle, 0), "{pair}, vehicle");
        assert_eq!(roadside[pair], (total, by_roadside, wrong), "{pair}, roadside");
        assert_eq!(both[pair], (total, by_both, 0), "{pair}, both");
    }
    let sum = |counts: &BTreeMap<String, (u64, u64, u64)>| {
        counts
            .values()
            .fold((0, 0, 0), |sum, pair| (sum.0 + pair.0, sum.1 + pair.1, sum.2 + pair.2))
    };
    assert_eq!(
        [sum(&vehicle), sum(&roadside), sum(&both)],
        [(171, 92, 0), (171, 89, 7), (171, 170, 0)]
    );
}

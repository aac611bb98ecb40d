//! Boxes as `vision_msgs/msg/Detection3DArray`, its companion `realo_msgs/msg/BoxesInfo`, and markers for viewers.

use nalgebra::Isometry3;
use realo_schemas::geometry::{normalize_yaw, yaw_of};
use realo_schemas::{Box3, Boxes, Name, Nanos};

use crate::cdr::{CdrError, CdrReader, CdrWriter};
use crate::pose::{isometry, parts};
use crate::tracks::track_of;

/// What is said of headings that cannot be right, after how many of how many: what happened, and what to try.
pub const WRONG_HEADINGS: [&str; 2] = [
    "have another heading by the `yaw` of their companion than by their quaternion, or a `yaw` beyond ±4π, and the `yaw` was used",
    "write the heading as both, in radians",
];
/// A `yaw` and a quaternion that differ more are two headings, rad.
const SAME_HEADING: f64 = 0.02;
/// What is further is not a heading, rad.
const MAX_YAW: f64 = 4.0 * std::f64::consts::PI + SAME_HEADING;

/// Boxes whose heading cannot be right.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WrongHeadings {
    /// How many there are.
    pub count: u64,
    /// Both headings of the first, in words.
    pub first: String,
}

impl WrongHeadings {
    /// Adds what was found elsewhere, later.
    pub fn add(&mut self, other: &WrongHeadings) {
        self.count += other.count;
        if self.first.is_empty() {
            self.first.clone_from(&other.first);
        }
    }

    /// Takes a box, by its heading from the quaternion (NaN without one) and from the companion.
    fn note(&mut self, by_quaternion: f64, yaw: f64) {
        let Some(words) = heading_fault(by_quaternion, yaw) else {
            return;
        };
        self.count += 1;
        if self.first.is_empty() {
            self.first = words;
        }
    }
}

/// Why a heading cannot be right, in words. One that is not finite is no plausible box.
fn heading_fault(by_quaternion: f64, yaw: f64) -> Option<String> {
    let is_apart = |yaw: f64| normalize_yaw(yaw - by_quaternion).abs() > SAME_HEADING;
    let is_right = yaw.abs() <= MAX_YAW && (by_quaternion.is_nan() || !is_apart(yaw));
    if !yaw.is_finite() || is_right {
        return None;
    }
    let degrees = match (std::f64::consts::TAU..=720.0).contains(&yaw.abs())
        && !by_quaternion.is_nan()
        && !is_apart(yaw.to_radians())
    {
        true => ": looks like degrees",
        false => "",
    };
    let quaternion = match by_quaternion.is_nan() {
        true => "no quaternion".to_string(),
        false => format!("a quaternion of {by_quaternion:.3} rad"),
    };
    let yaw = if yaw.abs() < 1e6 {
        format!("{yaw:.3}")
    } else {
        format!("{yaw:.3e}")
    };
    Some(format!("a `yaw` of {yaw} rad and {quaternion}{degrees}"))
}

/// What a `Detection3DArray` cannot say of its boxes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BoxesInfo {
    /// Number of the sweep; `u64::MAX` where no sweep has the stamp.
    pub seq: u64,
    /// Whether the frame is scored.
    pub key: bool,
    /// Where the boxes' frame lies in `map`, where known.
    pub map_from_frame: Option<Isometry3<f64>>,
    /// Agents whose points are counted.
    pub agents: Vec<Name>,
    /// Points per box and agent, row-major; `None` where nobody counted.
    pub points: Option<Vec<u32>>,
    /// Of boxes that were read: those whose heading cannot be right.
    pub wrong_headings: WrongHeadings,
}

/// Appends boxes as a `Detection3DArray`.
pub fn encode(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, boxes: &[Box3]) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    out.length(boxes.len());
    for object in boxes {
        let pose = pose_of(object);
        out.header(stamp, frame);
        out.length(1);
        out.string(&object.class);
        out.f64(f64::from(object.score));
        out.f64s(&pose);
        out.f64s(&[0.0; 36]);
        out.f64s(&pose);
        out.f64s(&[object.length, object.width, object.height]);
        out.string(&object.track.map(|track| track.to_string()).unwrap_or_default());
    }
}

/// Reads the boxes of a `Detection3DArray`: class and score of the first hypothesis, heading from the quaternion.
///
/// # Errors
/// Bytes that are no such message; a detection without hypothesis; numbers that are no pose.
pub fn decode(payload: &[u8]) -> Result<(Nanos, Boxes), CdrError> {
    decode_with(payload, |id| Ok(track_of(id)))
}

/// As [`decode`]; `track` says which track a detection's `id` names.
pub(crate) fn decode_with(
    payload: &[u8],
    mut track: impl FnMut(&str) -> Result<Option<u64>, String>,
) -> Result<(Nanos, Boxes), CdrError> {
    let mut input = CdrReader::new(payload)?;
    let (stamp, _) = input.header()?;
    let mut boxes = Vec::new();
    for index in 0..input.length(100)? {
        boxes.push(read_box(&mut input, &mut track).map_err(|error| format!("detection {index}: {error}"))?);
    }
    Ok((stamp, Boxes(boxes)))
}

fn read_box(
    input: &mut CdrReader,
    track: &mut impl FnMut(&str) -> Result<Option<u64>, String>,
) -> Result<Box3, CdrError> {
    input.header()?;
    let mut best = None;
    for _ in 0..input.length(300)? {
        let (class, score) = (input.string()?, input.f64()?);
        input.f64s::<43>()?;
        best.get_or_insert((class, score));
    }
    let (class, score) = best.ok_or("no hypothesis, so no class")?;
    let pose: [f64; 7] = input.f64s()?;
    let [length, width, height] = input.f64s()?;
    let id = input.string()?;
    let [x, y, z, rest @ ..] = pose;
    // A centre that is not finite is the reader's to count; the heading of such a box does not matter.
    let yaw = isometry(&[0.0, 0.0, 0.0, rest[0], rest[1], rest[2], rest[3]]).map_or(f64::NAN, |p| yaw_of(&p.rotation));
    Ok(Box3 {
        center: [x, y, z],
        length,
        width,
        height,
        yaw,
        velocity: None,
        class: class.into(),
        score: score as f32,
        track: track(id)?,
        covariance: None,
    })
}

/// Appends the companion of boxes.
pub fn encode_info(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, boxes: &[Box3], info: &BoxesInfo) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    out.u64(info.seq);
    out.bool(info.key);
    let pose = info.map_from_frame.as_ref().map(parts);
    list(&mut out, pose.as_ref().map_or(&[], |pose| pose));
    list(&mut out, &boxes.iter().map(|object| object.yaw).collect::<Vec<_>>());
    let unknown = [f64::NAN; 9];
    list(
        &mut out,
        &boxes
            .iter()
            .flat_map(|b| b.velocity.unwrap_or([f64::NAN; 3]))
            .collect::<Vec<_>>(),
    );
    let covariances = match boxes.iter().any(|object| object.covariance.is_some()) {
        true => boxes
            .iter()
            .flat_map(|object| object.covariance.unwrap_or(unknown))
            .collect(),
        false => Vec::new(),
    };
    list(&mut out, &covariances);
    out.length(info.agents.len());
    info.agents.iter().for_each(|agent| out.string(agent));
    let points = info.points.as_deref().unwrap_or_default();
    out.length(points.len());
    points.iter().for_each(|count| out.u32(*count));
}

fn list(out: &mut CdrWriter, values: &[f64]) {
    out.length(values.len());
    out.f64s(values);
}

/// Reads the companion of `boxes` and restores in them what a `Detection3DArray` cannot say.
///
/// # Errors
/// Bytes that are no such message; a list whose length does not fit the boxes.
pub fn decode_info(payload: &[u8], boxes: &mut Boxes) -> Result<(Nanos, BoxesInfo), CdrError> {
    let mut input = CdrReader::new(payload)?;
    let (stamp, _) = input.header()?;
    let (seq, key) = (input.u64()?, input.bool()?);
    let pose = read_list(&mut input)?;
    let map_from_frame = match <[f64; 7]>::try_from(pose) {
        Ok(pose) => Some(isometry(&pose)?),
        Err(other) if other.is_empty() => None,
        Err(other) => return Err(format!("`pose` has {} numbers, expected 0 or 7", other.len())),
    };
    let n = boxes.0.len();
    let yaws = of_boxes("yaw", read_list(&mut input)?, n)?;
    let velocities = of_boxes("velocity", read_list(&mut input)?, 3 * n)?;
    let covariances = read_list(&mut input)?;
    let covariances = if covariances.is_empty() {
        covariances
    } else {
        of_boxes("covariance", covariances, 9 * n)?
    };
    let mut wrong_headings = WrongHeadings::default();
    for (i, object) in boxes.0.iter_mut().enumerate() {
        wrong_headings.note(object.yaw, yaws[i]);
        object.yaw = yaws[i];
        object.velocity = known(&velocities, i);
        object.covariance = known(&covariances, i);
    }
    let agents = (0..input.length(5)?)
        .map(|_| input.string().map(Name::from))
        .collect::<Result<Vec<_>, _>>()?;
    let points = (0..input.length(4)?)
        .map(|_| input.u32())
        .collect::<Result<Vec<_>, _>>()?;
    if !points.is_empty() && points.len() != n * agents.len() {
        return Err(format!(
            "`points` has {} numbers for {n} boxes and {} agents",
            points.len(),
            agents.len()
        ));
    }
    let points = (!agents.is_empty() && points.len() == n * agents.len()).then_some(points);
    Ok((
        stamp,
        BoxesInfo {
            seq,
            key,
            map_from_frame,
            agents,
            points,
            wrong_headings,
        },
    ))
}

fn read_list(input: &mut CdrReader) -> Result<Vec<f64>, CdrError> {
    (0..input.length(8)?).map(|_| input.f64()).collect()
}

fn of_boxes(field: &str, values: Vec<f64>, expected: usize) -> Result<Vec<f64>, CdrError> {
    match values.len() == expected {
        true => Ok(values),
        false => Err(format!(
            "`{field}` has {} numbers, the boxes need {expected}",
            values.len()
        )),
    }
}

fn known<const N: usize>(values: &[f64], index: usize) -> Option<[f64; N]> {
    let values: [f64; N] = values.get(N * index..N * (index + 1))?.try_into().ok()?;
    (!values.iter().all(|v| v.is_nan())).then_some(values)
}

/// Appends boxes as a `visualization_msgs/msg/MarkerArray` of cubes that replaces the one before.
pub fn encode_markers(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, namespace: &str, boxes: &[Box3]) {
    const ADD: i32 = 0;
    const DELETE_ALL: i32 = 3;
    let mut out = CdrWriter::new(buffer);
    out.length(boxes.len() + 1);
    let nothing = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    write_marker(
        &mut out, stamp, frame, namespace, 0, DELETE_ALL, &nothing, &[1.0; 3], [0.0; 4], "",
    );
    for (index, object) in boxes.iter().enumerate() {
        let size = [object.length, object.width, object.height];
        let (pose, color) = (pose_of(object), color_of(&object.class));
        write_marker(
            &mut out,
            stamp,
            frame,
            namespace,
            index as i32,
            ADD,
            &pose,
            &size,
            color,
            &object.class,
        );
    }
}

#[allow(clippy::too_many_arguments)]
fn write_marker(
    out: &mut CdrWriter,
    stamp: Nanos,
    frame: &str,
    namespace: &str,
    id: i32,
    action: i32,
    pose: &[f64; 7],
    size: &[f64; 3],
    color: [f32; 4],
    text: &str,
) {
    const CUBE: i32 = 1;
    out.header(stamp, frame);
    out.string(namespace);
    out.i32(id);
    out.i32(CUBE);
    out.i32(action);
    out.f64s(pose);
    out.f64s(size);
    color.iter().for_each(|v| out.f32(*v));
    out.time(0);
    out.bool(false);
    out.length(0);
    out.length(0);
    out.string("");
    out.header(0, "");
    out.string("");
    out.length(0);
    out.length(0);
    out.string(text);
    out.string("");
    out.string("");
    out.length(0);
    out.bool(false);
}

fn color_of(class: &str) -> [f32; 4] {
    const COLORS: [[f32; 3]; 5] = [
        [0.2, 0.6, 1.0],
        [1.0, 0.6, 0.1],
        [0.9, 0.2, 0.3],
        [0.3, 0.8, 0.4],
        [0.7, 0.4, 0.9],
    ];
    let sum: usize = class.bytes().map(usize::from).sum();
    let [r, g, b] = COLORS[sum % COLORS.len()];
    [r, g, b, 0.5]
}

pub(crate) fn pose_of(object: &Box3) -> [f64; 7] {
    let [x, y, z] = object.center;
    let (sin, cos) = nalgebra::ComplexField::sin_cos(object.yaw / 2.0);
    [x, y, z, 0.0, 0.0, sin, cos]
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn samples() -> Vec<Box3> {
        let object = |x: f64, yaw: f64, track: Option<u64>| Box3 {
            center: [x, -2.0 / 3.0, 0.1],
            length: 4.5,
            width: 1.9,
            height: 1.6,
            yaw,
            velocity: track.map(|_| [x, 0.1, 0.0]),
            class: "car".into(),
            score: 0.3,
            track,
            covariance: None,
        };
        let mut boxes = vec![
            object(10.1, 0.7, Some(7)),
            object(-3.0, -3.0, None),
            object(0.0, f64::NAN, Some(u64::MAX)),
        ];
        boxes[0].covariance = Some([0.1, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.3]);
        boxes[1].class = "pédestrian".into();
        boxes
    }

    #[test]
    fn boxes_survive_bit_for_bit_with_their_companion() {
        let (mut payload, mut companion) = (Vec::new(), Vec::new());
        encode(&mut payload, 3, "cav1/body", &samples());
        let pose = Isometry3::translation(1.0, 2.0, 3.0);
        let info = BoxesInfo {
            seq: 9,
            key: true,
            map_from_frame: Some(pose),
            agents: vec!["cav1".into(), "rsu1".into()],
            points: Some(vec![1, 2, 3, 4, 5, 6]),
            ..BoxesInfo::default()
        };
        encode_info(&mut companion, 3, "cav1/body", &samples(), &info);
        let (stamp, mut boxes) = decode(&payload).unwrap();
        assert!((boxes.0[0].yaw - 0.7).abs() < 1e-15 && boxes.0[2].yaw.is_nan() && boxes.0[0].velocity.is_none());
        assert_eq!(decode_info(&companion, &mut boxes).unwrap(), (stamp, info));
        assert!(boxes.0[2].yaw.is_nan());
        boxes.0[2].yaw = 0.0;
        let mut expected = samples();
        expected[2].yaw = 0.0;
        assert_eq!(boxes.0, expected);
    }

    #[test]
    fn says_when_companion_and_boxes_differ() {
        let mut companion = Vec::new();
        encode_info(&mut companion, 3, "cav1/body", &samples(), &BoxesInfo::default());
        let error = decode_info(&companion, &mut Boxes(samples()[..1].to_vec())).unwrap_err();
        assert_eq!(error, "`yaw` has 3 numbers, the boxes need 1");
    }

    #[test]
    fn headings_of_two_values_are_named() {
        let said = |by_quaternion: f64, yaw: f64| heading_fault(by_quaternion, yaw).unwrap_or_default();
        let turn = std::f64::consts::TAU;
        for (by_quaternion, yaw) in [
            (0.5, 0.51),
            (3.1, 3.1 - turn),
            (-0.3, 2.0 * turn - 0.3),
            (f64::NAN, 3.0),
            (1.0, f64::NAN),
        ] {
            assert_eq!(said(by_quaternion, yaw), "", "{by_quaternion} {yaw}");
        }
        assert_eq!(said(0.5, 0.6), "a `yaw` of 0.600 rad and a quaternion of 0.500 rad");
        assert!(said(-1.571, -90.0).ends_with(": looks like degrees"));
        assert_eq!(
            said(0.0, 3.0 * turn),
            "a `yaw` of 18.850 rad and a quaternion of 0.000 rad"
        );
        assert_eq!(said(f64::NAN, 1e20), "a `yaw` of 1.000e20 rad and no quaternion");
    }

    #[test]
    fn damaged_bytes_are_errors() {
        let mut payload = Vec::new();
        encode(&mut payload, 3, "cav1/body", &samples());
        for cut in 0..payload.len() {
            assert!(decode(&payload[..cut]).is_err(), "{cut}");
        }
        for at in 0..payload.len() {
            let mut damaged = payload.clone();
            damaged[at] ^= 0xff;
            let _ = decode(&damaged);
        }
    }
}

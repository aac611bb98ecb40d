//! Boxes as bytes.

use realo_schemas::{Box3, Boxes, Name, geometry};

use crate::bytes::{Reader, put_f32s, put_text, triangle_index};
use crate::error::{DecodeError, EncodeError};

const VELOCITY: u8 = 1;
const TRACK_32: u8 = 2;
const TRACK_64: u8 = 4;
const COVARIANCE: u8 = 8;

/// Writes the boxes and returns how many were left out, because as f32 they are not valid or not finite.
pub(crate) fn write(out: &mut Vec<u8>, boxes: &Boxes) -> Result<u64, EncodeError> {
    let kept: Vec<Box3> = boxes.0.iter().map(rounded).filter(is_sound).collect();
    let count = u16::try_from(kept.len()).map_err(|_| EncodeError::TooMany {
        field: "boxes",
        found: kept.len(),
        limit: u16::MAX.into(),
    })?;
    let mut classes: Vec<&Name> = kept.iter().map(|object| &object.class).collect();
    classes.sort();
    classes.dedup();
    let class_count = u8::try_from(classes.len()).map_err(|_| EncodeError::TooMany {
        field: "classes",
        found: classes.len(),
        limit: u8::MAX.into(),
    })?;
    out.extend(count.to_le_bytes());
    out.push(class_count);
    for class in &classes {
        put_text(out, class, "length of class")?;
    }
    for object in &kept {
        // The table was made of these very classes.
        let class = classes.partition_point(|class| **class < object.class) as u8;
        write_box(out, object, class);
    }
    Ok((boxes.0.len() - kept.len()) as u64)
}

/// The box as the receiver will see it.
fn rounded(object: &Box3) -> Box3 {
    let round = |v: f64| f64::from(v as f32);
    Box3 {
        center: object.center.map(round),
        length: round(object.length),
        width: round(object.width),
        height: round(object.height),
        yaw: round(object.yaw),
        velocity: object.velocity.map(|v| v.map(round)),
        covariance: object.covariance.map(|c| c.map(round)),
        ..object.clone()
    }
}

fn is_sound(object: &Box3) -> bool {
    let motion = object
        .velocity
        .iter()
        .flatten()
        .chain(object.covariance.iter().flatten());
    geometry::is_valid(object) && motion.copied().all(f64::is_finite)
}

fn write_box(out: &mut Vec<u8>, object: &Box3, class: u8) {
    let track = match object.track {
        None => 0,
        Some(track) if u32::try_from(track).is_ok() => TRACK_32,
        Some(_) => TRACK_64,
    };
    let velocity = if object.velocity.is_some() { VELOCITY } else { 0 };
    let covariance = if object.covariance.is_some() { COVARIANCE } else { 0 };
    out.extend([velocity | track | covariance, class]);
    put_f32s(out, &object.center.map(|v| v as f32));
    put_f32s(
        out,
        &[object.length, object.width, object.height, object.yaw].map(|v| v as f32),
    );
    put_f32s(out, &[object.score]);
    if let Some(velocity) = object.velocity {
        put_f32s(out, &velocity.map(|v| v as f32));
    }
    if let Some(id) = object.track {
        let width = if track == TRACK_32 { 4 } else { 8 };
        out.extend(&id.to_le_bytes()[..width]);
    }
    if let Some(c) = object.covariance {
        put_f32s(out, &[c[0], c[1], c[2], c[4], c[5], c[8]].map(|v| v as f32));
    }
}

pub(crate) fn read(bytes: &mut Reader) -> Result<Boxes, DecodeError> {
    let count = bytes.u16("number of boxes")?;
    let class_count = bytes.u8("number of classes")?;
    let mut classes: Vec<Name> = Vec::with_capacity(class_count.into());
    for _ in 0..class_count {
        classes.push(bytes.text("class")?.into());
    }
    let mut boxes = Vec::new();
    for _ in 0..count {
        boxes.push(read_box(bytes, &classes)?);
    }
    Ok(Boxes(boxes))
}

fn read_box(bytes: &mut Reader, classes: &[Name]) -> Result<Box3, DecodeError> {
    let flags = bytes.flags(VELOCITY | TRACK_32 | TRACK_64 | COVARIANCE, "flags of a box")?;
    if flags & TRACK_32 != 0 && flags & TRACK_64 != 0 {
        let found = "two".into();
        return Err(DecodeError::Value {
            field: "flags of a box",
            expected: "one width of the track id",
            found,
        });
    }
    let index = bytes.u8("class of a box")?;
    let class = classes.get(usize::from(index)).ok_or_else(|| DecodeError::Value {
        field: "class of a box",
        expected: "an index into the classes",
        found: format!("{index} of {}", classes.len()),
    })?;
    let center = bytes.f32s::<3>("centre of a box")?.map(f64::from);
    let [length, width, height, yaw] = bytes.f32s::<4>("extents and yaw of a box")?.map(f64::from);
    let [score] = bytes.f32s::<1>("score of a box")?;
    let velocity = match flags & VELOCITY {
        0 => None,
        _ => Some(bytes.f32s::<3>("velocity of a box")?.map(f64::from)),
    };
    let track = match flags & (TRACK_32 | TRACK_64) {
        0 => None,
        TRACK_32 => Some(bytes.u32("track of a box")?.into()),
        _ => Some(bytes.u64("track of a box")?),
    };
    let covariance = match flags & COVARIANCE {
        0 => None,
        _ => {
            let triangle = bytes.f32s::<6>("covariance of a box")?;
            Some(std::array::from_fn(|i| {
                triangle[triangle_index(i / 3, i % 3, 3)].into()
            }))
        }
    };
    let object = Box3 {
        center,
        length,
        width,
        height,
        yaw,
        velocity,
        class: class.clone(),
        score,
        track,
        covariance,
    };
    if !geometry::is_valid(&object) {
        let found = format!("{length} × {width} × {height} m, score {score}");
        let expected = "extents above 0 and up to 100 m, and a score in [0, 1]";
        return Err(DecodeError::Value {
            field: "box",
            expected,
            found,
        });
    }
    Ok(object)
}

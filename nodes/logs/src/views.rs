//! Views as `realo_msgs/msg/Views`: where the objects of a truth could be labelled.

use realo_schemas::Nanos;
use realo_schemas::geometry::View;

use crate::cdr::{CdrError, CdrReader, CdrWriter};

/// Appends views.
pub fn encode(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, views: &[View]) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    let numbers: Vec<[f64; View::NUMBERS]> = views.iter().map(View::numbers).collect();
    for [from, until] in [POSE, FOCAL, CENTER] {
        let values: Vec<f64> = numbers.iter().flat_map(|view| view[from..until].to_vec()).collect();
        out.length(values.len());
        out.f64s(&values);
    }
    out.length(2 * views.len());
    views
        .iter()
        .flat_map(|view| view.size)
        .for_each(|pixels| out.u32(pixels));
    out.length(views.len());
    out.f64s(&views.iter().map(|view| view.margin).collect::<Vec<_>>());
}

/// Where a view's numbers lie in [`View::numbers`].
const POSE: [usize; 2] = [0, 7];
const FOCAL: [usize; 2] = [7, 9];
const CENTER: [usize; 2] = [9, 11];

/// Reads views.
///
/// # Errors
/// Bytes that are no such message; lists of different lengths; numbers that are no view, with the number of the view and the
/// field.
pub fn decode(payload: &[u8]) -> Result<(Nanos, Vec<View>), CdrError> {
    let mut input = CdrReader::new(payload)?;
    let (stamp, _) = input.header()?;
    let pose = list(&mut input)?;
    let focal = list(&mut input)?;
    let center = list(&mut input)?;
    let size: Vec<f64> = (0..input.length(4)?)
        .map(|_| input.u32().map(f64::from))
        .collect::<Result<_, _>>()?;
    let margin = list(&mut input)?;
    let count = margin.len();
    for (field, found, each) in [
        ("pose", pose.len(), 7),
        ("focal", focal.len(), 2),
        ("center", center.len(), 2),
        ("size", size.len(), 2),
    ] {
        if found != each * count {
            return Err(format!(
                "`{field}` has {found} numbers, expected {each} for each of the {count} views that `margin` has"
            ));
        }
    }
    let view = |index: usize| {
        let parts = [
            &pose[7 * index..][..7],
            &focal[2 * index..][..2],
            &center[2 * index..][..2],
            &size[2 * index..][..2],
            &margin[index..][..1],
        ];
        let numbers: [f64; View::NUMBERS] = parts.concat().try_into().map_err(|_| "a view of other numbers")?;
        View::from_numbers(&numbers).map_err(|reason| format!("view {index}: {reason}"))
    };
    Ok((stamp, (0..count).map(view).collect::<Result<_, _>>()?))
}

fn list(input: &mut CdrReader) -> Result<Vec<f64>, CdrError> {
    (0..input.length(8)?).map(|_| input.f64()).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};

    use super::*;

    fn view(x: f64) -> View {
        View {
            frame_from_camera: Isometry3::new(Vector3::new(x, 0.0, 1.5), Vector3::new(0.1, -0.2, 0.3)),
            focal: [800.0, 810.0],
            center: [960.5, 540.25],
            size: [1920, 1080],
            margin: 2.0,
        }
    }

    #[test]
    fn views_survive_bit_for_bit() {
        for views in [vec![], vec![view(1.0)], vec![view(1.0), view(-2.0)]] {
            let mut payload = Vec::new();
            encode(&mut payload, 42, "car/body", &views);
            assert_eq!(decode(&payload).unwrap(), (42, views));
        }
    }

    #[test]
    fn says_what_is_no_view() {
        let bad = |change: &dyn Fn(&mut View)| {
            let mut views = vec![view(1.0), view(2.0)];
            change(&mut views[1]);
            let mut payload = Vec::new();
            encode(&mut payload, 42, "car/body", &views);
            decode(&payload).unwrap_err()
        };
        for (error, named) in [
            (bad(&|view| view.focal[0] = f64::NAN), "`focal`"),
            (bad(&|view| view.size = [1920, 0]), "`size`"),
            (bad(&|view| view.frame_from_camera.translation.x = f64::NAN), "`pose`"),
            (bad(&|view| view.margin = -1.0), "`margin`"),
        ] {
            assert!(error.contains("view 1") && error.contains(named), "{error}");
        }
        let mut payload = Vec::new();
        encode(&mut payload, 42, "car/body", &[view(1.0)]);
        for length in 0..payload.len() {
            assert!(decode(&payload[..length]).is_err(), "{length}");
        }
    }

    #[test]
    fn lists_of_different_lengths_are_named() {
        let mut payload = Vec::new();
        let mut out = CdrWriter::new(&mut payload);
        out.header(42, "car/body");
        for numbers in [7, 2, 1] {
            out.length(numbers);
            out.f64s(&vec![1.0; numbers]);
        }
        out.length(2);
        [1920, 1080].into_iter().for_each(|pixels| out.u32(pixels));
        out.length(1);
        out.f64s(&[0.0]);
        let error = decode(&payload).unwrap_err();
        assert!(
            error.contains("`center` has 1 numbers, expected 2 for each of the 1 views"),
            "{error}"
        );
    }
}

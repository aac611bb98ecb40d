//! Clouds of `.bin` files: rows of float32, x, y, z and intensity, as KITTI has them.

use std::path::Path;

use crate::ImportError;
use crate::files::read;
use crate::pcd::{Intensities, Points};

/// Reads a cloud of so many numbers a point.
pub fn read_rows(path: &Path, columns: usize) -> Result<Points, ImportError> {
    parse_rows(&read(path)?, columns).map_err(|reason| ImportError::content(path, reason))
}

fn parse_rows(bytes: &[u8], columns: usize) -> Result<Points, String> {
    let size = 4 * columns;
    if !bytes.len().is_multiple_of(size) {
        let fits = (4..=6).find(|columns| bytes.len().is_multiple_of(4 * columns));
        let advice = match fits {
            Some(columns) => format!("it fits --columns {columns}"),
            None => "the file may be cut: fetch it anew".into(),
        };
        return Err(format!(
            "expected rows of {columns} float32 ({size} bytes), found {} bytes; {advice}",
            bytes.len()
        ));
    }
    let (words, _) = bytes.as_chunks::<4>();
    let column = |index: usize| {
        words
            .iter()
            .skip(index)
            .step_by(columns)
            .map(|word| f32::from_le_bytes(*word))
    };
    let place = |index: usize| column(index).map(f64::from).collect();
    Ok(Points {
        x: place(0),
        y: place(1),
        z: place(2),
        intensity: Intensities::Others {
            kind: "float32",
            values: column(3).collect(),
        },
        ..Points::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_have_as_many_columns_as_said() {
        let bytes = |numbers: &[f32]| {
            numbers
                .iter()
                .flat_map(|number| number.to_le_bytes())
                .collect::<Vec<_>>()
        };
        let five = bytes(&[
            1.0, 2.0, 3.0, 0.5, 9.0, 4.0, 5.0, 6.0, 1.0, 9.0, 7.0, 8.0, 9.0, 0.0, 9.0,
        ]);
        let points = parse_rows(&five, 5).unwrap();
        assert_eq!((points.x, points.z), (vec![1.0, 4.0, 7.0], vec![3.0, 6.0, 9.0]));
        let error = parse_rows(&five, 4).unwrap_err();
        assert!(error.contains("found 60 bytes; it fits --columns 5"), "{error}");
        let error = parse_rows(&five[..59], 4).unwrap_err();
        assert!(error.contains("may be cut"), "{error}");
    }
}

//! Clouds of `.bin` files: rows of float32, x, y, z and intensity, as KITTI has them.

use std::path::Path;

use crate::ImportError;
use crate::files::read;
use crate::pcd::{Intensities, Points};

/// No intensity of a sensor is larger.
const LARGEST: f32 = 65_535.0;
/// Rows are of another width if more than one intensity of so many cannot be one.
const SHARE: usize = 20;
/// Rows are of a width of which at most one intensity of so many cannot be one.
const SOUND: usize = 1000;

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
    check_width(words, columns)?;
    let column = |index: usize| column(words, columns, index);
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

fn column(words: &[[u8; 4]], columns: usize, index: usize) -> impl Iterator<Item = f32> {
    let column = words.iter().skip(index).step_by(columns);
    column.map(|word| f32::from_le_bytes(*word))
}

/// Refuses rows in which many intensities cannot be some, where rows of another width that fits have none such.
fn check_width(words: &[[u8; 4]], columns: usize) -> Result<(), String> {
    let strange = |columns: usize| {
        let strange = column(words, columns, 3).filter(|value| !(0.0..=LARGEST).contains(value));
        (strange.count(), words.len() / columns)
    };
    let (wrong, rows) = strange(columns);
    if SHARE * wrong <= rows {
        return Ok(());
    }
    let is_better = |other: &usize| {
        let (wrong, rows) = strange(*other);
        *other != columns && words.len().is_multiple_of(*other) && SOUND * wrong <= rows
    };
    match (4..=8).find(is_better) {
        None => Ok(()),
        Some(other) => Err(format!(
            "read as rows of {columns} float32, {wrong} of {rows} intensities are below 0 or none at all, and read as rows of {other} \
             nearly none is: give --columns {other}"
        )),
    }
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

    #[test]
    fn rows_of_another_width_that_fit_by_chance_are_refused() {
        let rows = |width: usize| -> Vec<u8> {
            let row = |i: usize| {
                let angle = i as f32 * 0.1;
                let row = [20.0 * angle.cos(), 20.0 * angle.sin(), -1.8, (i % 200) as f32, 3.0, 0.1];
                row.into_iter()
                    .take(width)
                    .flat_map(f32::to_le_bytes)
                    .collect::<Vec<u8>>()
            };
            (0..600).flat_map(row).collect()
        };
        for width in 4..=6 {
            let file = rows(width);
            assert_eq!(parse_rows(&file, width).unwrap().x.len(), 600);
            for other in (4..=6).filter(|other| *other != width) {
                let error = parse_rows(&file, other).unwrap_err();
                assert!(
                    error.contains(&format!("give --columns {width}")),
                    "{width} {other}: {error}"
                );
            }
        }
        // Intensities below 0 of which no other width makes sense are a matter of the sensor.
        let mut file = rows(4);
        for row in file.chunks_exact_mut(16) {
            row[15] |= 0x80;
        }
        parse_rows(&file, 4).unwrap();
    }
}

//! Beams of a sensor, from bands or a table.

use super::described::{Band, Checker};
use super::error::SensorError;
use super::{ASIDE, MOST_BEAMS, STEEPEST};
use crate::sensor::Beam;

pub(super) fn no_beams(check: &Checker, found: &str) -> SensorError {
    let one = check.need(false, "table", "either `table` or `bands`", found);
    one.expect_err("it does not hold")
}

pub(super) fn band_beams(check: &Checker, bands: &[Band]) -> Result<Vec<Beam>, SensorError> {
    let mut beams = Vec::new();
    let mut last = f64::NEG_INFINITY;
    for (index, band) in bands.iter().enumerate() {
        let field = |name: &str| format!("bands[{index}].{name}");
        check.within(&field("from_deg"), band.from_deg, [-STEEPEST, STEEPEST])?;
        check.within(&field("to_deg"), band.to_deg, [-STEEPEST, STEEPEST])?;
        check.within(&field("step_deg"), band.step_deg, [0.01, 120.0])?;
        check.need((1..=100).contains(&band.every), &field("every"), "1 to 100", band.every)?;
        let sorted = band.from_deg > last && band.to_deg >= band.from_deg;
        let found = format!("{} to {} after {last}", band.from_deg, band.to_deg);
        check.need(
            sorted,
            &field("from_deg"),
            "bands that rise, one above the other",
            found,
        )?;
        let count = ((band.to_deg - band.from_deg) / band.step_deg + 1e-3) as usize + 1;
        check.need(
            beams.len() + count <= MOST_BEAMS,
            "bands",
            &format!("at most {MOST_BEAMS} beams"),
            beams.len() + count,
        )?;
        for k in 0..count {
            last = band.from_deg + k as f64 * band.step_deg;
            beams.push(Beam::new(last, 0.0, 0.0, band.every));
        }
    }
    Ok(beams)
}

/// Beams of a table in CSV. Its first line names the columns: `elevation_deg`, and if they are there
/// `azimuth_offset_deg` (clockwise) and `firing_offset_us`; others are skipped. Rows stand in the order of
/// firing; where all fire at once, elevations rise or fall.
pub(super) fn table_beams(check: &Checker, text: &str) -> Result<Vec<Beam>, SensorError> {
    let text = text.trim_start_matches('\u{feff}');
    let mut lines = text.lines().filter(|line| !line.trim().is_empty());
    let names: Vec<&str> = lines.next().unwrap_or("").split(',').map(str::trim).collect();
    let at = |name: &str| names.iter().position(|column| *column == name);
    let found = names.join(",");
    check.need(
        at("elevation_deg").is_some(),
        "the first line",
        "a column `elevation_deg`",
        found,
    )?;
    let mut rows: Vec<[f64; 3]> = Vec::new();
    for (number, line) in lines.enumerate() {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let value = |name: &str, limit: f64| -> Result<f64, SensorError> {
            let Some(column) = at(name) else { return Ok(0.0) };
            let field = format!("line {}, {name}", number + 2);
            let text = cells.get(column).copied().unwrap_or("");
            let value: f64 = text.parse().unwrap_or(f64::NAN);
            check.need(value.abs() <= limit, &field, &format!("a number within ±{limit}"), text)?;
            Ok(value)
        };
        let row = [
            value("elevation_deg", STEEPEST)?,
            value("azimuth_offset_deg", ASIDE)?,
            value("firing_offset_us", 1e5)?,
        ];
        rows.push(row);
        check.need(
            rows.len() <= MOST_BEAMS,
            "rows",
            &format!("at most {MOST_BEAMS}"),
            rows.len(),
        )?;
    }
    let fires = at("firing_offset_us").is_some();
    let sorted = match fires {
        true => rows.windows(2).all(|pair| pair[0][2] <= pair[1][2]) && rows.iter().all(|row| row[2] >= 0.0),
        false => {
            rows.windows(2).all(|pair| pair[0][0] < pair[1][0]) || rows.windows(2).all(|pair| pair[0][0] > pair[1][0])
        }
    };
    let (field, expected) = match fires {
        true => ("firing_offset_us", "times from 0 on in the order of firing"),
        false => ("elevation_deg", "elevations that rise or fall from row to row"),
    };
    check.need(sorted, field, expected, "rows that are not sorted")?;
    Ok(rows
        .iter()
        .map(|[elevation, azimuth, fires]| Beam::new(*elevation, *azimuth, *fires, 1))
        .collect())
}

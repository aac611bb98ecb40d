//! The table of true times: a line for each frame, a column for each sensor.

use std::collections::BTreeMap;
use std::path::Path;

use realo_schemas::Nanos;

use crate::ImportError;
use crate::files::read_text;

/// True times of sweeps, ns since 1970.
pub struct TimeTable {
    sensors: BTreeMap<String, BTreeMap<u64, Nanos>>,
}

impl TimeTable {
    /// Reads a table.
    ///
    /// # Errors
    /// One of another form, by line.
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        Self::parse(&read_text(path)?).map_err(|reason| {
            ImportError::content(
                path,
                format!("{reason}; or take the times of the names of the files, as --times names"),
            )
        })
    }

    fn parse(text: &str) -> Result<Self, String> {
        let mut lines = text
            .lines()
            .map(str::trim)
            .enumerate()
            .filter(|(_, line)| !line.is_empty());
        let (_, head) = lines.next().ok_or("expected a line of names, found nothing")?;
        let cells = |line: &str| -> Vec<String> {
            line.split([',', ';', '\t'])
                .map(|cell| cell.trim().trim_matches('"').to_string())
                .collect()
        };
        let head = cells(head);
        if head.len() < 2 {
            return Err(format!(
                "line 1: expected the frame's time and a column for each sensor, found `{}`",
                crate::shown(&head.join(","))
            ));
        }
        let mut sensors: BTreeMap<String, BTreeMap<u64, Nanos>> = BTreeMap::new();
        for (index, line) in lines {
            let wrong = |what: String| format!("line {}: {what}", index + 1);
            let cells = cells(line);
            if cells.len() != head.len() {
                return Err(wrong(format!(
                    "expected {} cells, as the first line has, found {}",
                    head.len(),
                    cells.len()
                )));
            }
            let frame = nanos(&cells[0]).ok_or_else(|| {
                wrong(format!(
                    "expected the time of a frame, found `{}`",
                    crate::shown(&cells[0])
                ))
            })?;
            // A time since 1970 is not below 0.
            let ms = frame.saturating_add(500_000).unsigned_abs() / 1_000_000;
            for (sensor, cell) in head.iter().zip(&cells).skip(1).filter(|(_, cell)| !cell.is_empty()) {
                let time = nanos(cell).ok_or_else(|| {
                    wrong(format!(
                        "column `{}`: expected a time since 1970, found `{}`",
                        crate::shown(sensor),
                        crate::shown(cell)
                    ))
                })?;
                sensors.entry(sensor.clone()).or_default().insert(ms, time);
            }
        }
        Ok(TimeTable { sensors })
    }

    /// The sensors that have a column.
    pub fn sensors(&self) -> impl Iterator<Item = &str> {
        self.sensors.keys().map(String::as_str)
    }

    /// The true time of a sensor's sweep with this time in its name, ms.
    pub fn of(&self, sensor: &str, ms: u64) -> Option<Nanos> {
        self.sensors.get(sensor)?.get(&ms).copied()
    }
}

/// A time since 1970 in s, ms, µs or ns, by its size, as ns.
fn nanos(text: &str) -> Option<Nanos> {
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    if whole.is_empty() || !digits(whole) || !digits(fraction) {
        return None;
    }
    let number: i128 = whole.parse().ok()?;
    let decimals: usize = match number {
        ..100_000_000_000 => 9,
        100_000_000_000..100_000_000_000_000 => 6,
        100_000_000_000_000..100_000_000_000_000_000 => 3,
        100_000_000_000_000_000.. => 0,
    };
    let fraction: String = fraction.chars().chain(std::iter::repeat('0')).take(decimals).collect();
    let part: i128 = if fraction.is_empty() { 0 } else { fraction.parse().ok()? };
    let all = number.checked_mul(10_i128.pow(decimals as u32))?.checked_add(part)?;
    Nanos::try_from(all).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_of_every_unit_keep_their_digits() {
        for text in [
            "1700000000.1234",
            "1700000000123.4",
            "1700000000123400",
            "1700000000123400000",
        ] {
            assert_eq!(nanos(text), Some(1_700_000_000_123_400_000), "{text}");
        }
        for text in ["", "now", "-5", "1e9", "."] {
            assert_eq!(nanos(text), None, "{text}");
        }
    }

    #[test]
    fn the_last_time_that_a_table_can_have_keeps_its_frame() {
        let last = i64::MAX;
        let table = TimeTable::parse(&format!("t,a\n{last},{last}\n")).unwrap();
        assert_eq!(table.of("a", 9_223_372_036_854), Some(last));
        assert_eq!(table.of("a", 0), None);
    }

    #[test]
    fn a_table_has_a_column_for_each_sensor_and_may_lack_cells() {
        let table = TimeTable::parse(
            "timestamp,vehicle1_lidar,crossing1_lidar\r\n1700000000100,1700000000103.5,\n\n1700000000200,1700000000204,1700000000211\n",
        );
        let table = table.unwrap();
        assert_eq!(
            table.of("vehicle1_lidar", 1_700_000_000_100),
            Some(1_700_000_000_103_500_000)
        );
        assert_eq!(table.of("crossing1_lidar", 1_700_000_000_100), None);
        assert_eq!(
            table.of("crossing1_lidar", 1_700_000_000_200),
            Some(1_700_000_000_211_000_000)
        );
        for (text, expected) in [
            ("", "found nothing"),
            ("one", "line 1: expected the frame's time"),
            ("t,a\n1700000000100\n", "line 2: expected 2 cells"),
            ("t,a\nx,1\n", "line 2: expected the time of a frame"),
            ("t,a\n1700000000100,soon\n", "line 2: column `a`"),
        ] {
            let error = TimeTable::parse(text).err().unwrap();
            assert!(error.contains(expected), "{error}");
        }
    }
}

//! Sensors as files: what one may say, and what is refused.

use std::path::Path;
use std::sync::{Arc, OnceLock};

use serde::Deserialize;

use super::{Beam, Mount, Optics, Scan, Sensor};

/// Beams that look farther up or down than this, degrees, are not taken: azimuths lose their meaning there.
const STEEPEST: f64 = 60.0;
/// Beams that look farther aside of their column than this, degrees, are not taken.
const ASIDE: f64 = 6.0;
/// A sensor's beams and columns at most.
const MOST_BEAMS: usize = 512;
const MOST_COLUMNS: usize = 4096;
/// Narrower fields are no sensor's, degrees.
const NARROWEST: f64 = 10.0;

/// A sensor that cannot be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SensorError {
    /// No built-in sensor has the name.
    #[error("no sensor `{name}`; there are {known}, or the path of a file that ends in .toml")]
    Unknown {
        /// The name that came.
        name: String,
        /// Names that there are.
        known: String,
    },
    /// A file that cannot be read.
    #[error("{path}: {reason}")]
    Unreadable {
        /// The file.
        path: String,
        /// Why.
        reason: String,
    },
    /// A file that says what no sensor can be.
    #[error("{path}: `{field}`: expected {expected}, found {found}")]
    Field {
        /// The file.
        path: String,
        /// The field.
        field: String,
        /// What it takes.
        expected: String,
        /// What came.
        found: String,
    },
}

/// The built-in sensors: name, description.
const BUILT_IN: [(&str, &str); 7] = [
    ("spinning-16", include_str!("../../sensors/spinning-16.toml")),
    ("spinning-32", include_str!("../../sensors/spinning-32.toml")),
    ("pandar40p", include_str!("../../sensors/pandar40p.toml")),
    ("os1-64", include_str!("../../sensors/os1-64.toml")),
    ("os1-128", include_str!("../../sensors/os1-128.toml")),
    ("ruby-plus-128", include_str!("../../sensors/ruby-plus-128.toml")),
    ("forward-scan", include_str!("../../sensors/forward-scan.toml")),
];

/// The built-in beam tables.
const TABLES: [(&str, &str); 4] = [
    ("hesai_pandar40p.csv", include_str!("../../sensors/hesai_pandar40p.csv")),
    (
        "ouster_os1_64_gen1.csv",
        include_str!("../../sensors/ouster_os1_64_gen1.csv"),
    ),
    ("ouster_os1_128.csv", include_str!("../../sensors/ouster_os1_128.csv")),
    (
        "robosense_ruby_plus_128.csv",
        include_str!("../../sensors/robosense_ruby_plus_128.csv"),
    ),
];

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    model: String,
    /// Beam table beside the file, or built in.
    table: Option<String>,
    #[serde(default)]
    bands: Vec<Band>,
    columns: usize,
    /// Width of the field ahead; a whole turn without.
    field_deg: Option<f64>,
    unanswered: f64,
    mount: MountText,
    optics: OpticsText,
}

/// Beams at even steps.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Band {
    from_deg: f64,
    to_deg: f64,
    step_deg: f64,
    /// They fire in every n-th column.
    #[serde(default = "one")]
    every: usize,
}

fn one() -> usize {
    1
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MountText {
    height_m: f64,
    /// Positive looks down.
    #[serde(default)]
    pitch_deg: f64,
    #[serde(default)]
    roll_deg: f64,
    /// Positive looks left.
    #[serde(default)]
    yaw_deg: f64,
    #[serde(default)]
    misalignment_deg: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct OpticsText {
    reach_m: f64,
    reach_reflectivity: f64,
    nearest_m: f64,
    farthest_m: f64,
    range_step_m: f64,
    noise_floor_m: f64,
    noise_slope_m: f64,
    noise_ceiling_m: f64,
}

/// Says what is wrong where.
struct Checker<'a> {
    path: &'a str,
}

impl Checker<'_> {
    fn need(&self, holds: bool, field: &str, expected: &str, found: impl ToString) -> Result<(), SensorError> {
        if holds {
            return Ok(());
        }
        Err(SensorError::Field {
            path: self.path.into(),
            field: field.into(),
            expected: expected.into(),
            found: found.to_string(),
        })
    }

    fn within(&self, field: &str, value: f64, [low, high]: [f64; 2]) -> Result<(), SensorError> {
        let holds = (low..=high).contains(&value);
        self.need(holds, field, &format!("a number within [{low}, {high}]"), value)
    }
}

impl Sensor {
    /// The names of the built-in sensors.
    pub fn names() -> impl Iterator<Item = &'static str> {
        BUILT_IN.iter().map(|(name, _)| *name)
    }

    /// A built-in sensor by its name, or one from a file that ends in `.toml`.
    ///
    /// # Errors
    /// [`SensorError`] says what there is, or which field of which file cannot be.
    pub fn named(name: &str) -> Result<Arc<Sensor>, SensorError> {
        static SENSORS: OnceLock<Vec<Arc<Sensor>>> = OnceLock::new();
        if Path::new(name).extension().is_some_and(|extension| extension == "toml") {
            return Sensor::load(Path::new(name)).map(Arc::new);
        }
        let all = SENSORS.get_or_init(|| {
            let read = |(name, text): &(&str, &str)| Sensor::parse(name, text, |table| built_in(name, table));
            BUILT_IN
                .iter()
                .map(|sensor| Arc::new(read(sensor).expect("a built-in sensor can be")))
                .collect()
        });
        let index = BUILT_IN.iter().position(|(known, _)| *known == name);
        index
            .map(|index| all[index].clone())
            .ok_or_else(|| SensorError::Unknown {
                name: name.into(),
                known: Sensor::names().collect::<Vec<_>>().join(", "),
            })
    }

    /// The same sensor at a height over the ground, m, and turned down by an angle, degrees.
    ///
    /// # Errors
    /// [`SensorError::Field`] for a mount that a file may not have either.
    pub fn mounted(&self, height_m: f64, pitch_deg: f64) -> Result<Sensor, SensorError> {
        let [roll, yaw, misalignment] = self.mount.map_or([0.0; 3], |own| [own.roll, own.yaw, own.misalignment]);
        let text = MountText {
            height_m,
            pitch_deg,
            roll_deg: roll.to_degrees(),
            yaw_deg: yaw.to_degrees(),
            misalignment_deg: misalignment.to_degrees(),
        };
        Ok(Sensor {
            mount: Some(mount(&Checker { path: &self.model }, &text)?),
            ..self.clone()
        })
    }

    fn load(path: &Path) -> Result<Sensor, SensorError> {
        let read = |path: &Path| {
            std::fs::read_to_string(path).map_err(|error| SensorError::Unreadable {
                path: path.display().to_string(),
                reason: error.to_string(),
            })
        };
        let shown = path.display().to_string();
        Sensor::parse(&shown, &read(path)?, |table| {
            let beside = path.with_file_name(table);
            match beside.exists() {
                true => read(&beside),
                false => built_in(&shown, table),
            }
        })
    }

    /// A sensor from the text of a file; `table` gives the text of a beam table.
    fn parse(
        path: &str,
        text: &str,
        table: impl Fn(&str) -> Result<String, SensorError>,
    ) -> Result<Sensor, SensorError> {
        let described: Description = toml::from_str(text).map_err(|error| SensorError::Unreadable {
            path: path.into(),
            reason: error.to_string().trim_end().into(),
        })?;
        let check = Checker { path };
        let beams = match (&described.table, described.bands.is_empty()) {
            (Some(name), true) => {
                let path = format!("{path}: table {name}");
                table_beams(&Checker { path: &path }, &table(name)?)?
            }
            (None, false) => band_beams(&check, &described.bands)?,
            (None, true) => return Err(no_beams(&check, "neither")),
            (Some(_), false) => return Err(no_beams(&check, "both")),
        };
        let count = beams.len();
        check.need(
            (1..=MOST_BEAMS).contains(&count),
            "beams",
            &format!("1 to {MOST_BEAMS} beams"),
            count,
        )?;
        let columns = described.columns;
        check.need(
            (1..=MOST_COLUMNS).contains(&columns),
            "columns",
            &format!("1 to {MOST_COLUMNS}"),
            columns,
        )?;
        let last = beams.iter().map(|beam| beam.fires).fold(0.0, f64::max);
        check.need(
            last * columns as f64 <= 0.1,
            "firing_offset_us",
            &format!("times within a column's {:.1} µs", 1e5 / columns as f64),
            format!("{:.1} µs", last * 1e6),
        )?;
        if let Some(field) = described.field_deg {
            check.within("field_deg", field, [NARROWEST, 180.0])?;
        }
        check.within("unanswered", described.unanswered, [0.0, 0.9])?;
        let mut sensor = Sensor::of(
            described.model.as_str().into(),
            columns,
            beams,
            optics(&check, &described)?,
        );
        sensor.scan = described
            .field_deg
            .map_or_else(Scan::turn, |field| Scan::ahead(field.to_radians()));
        sensor.mount = Some(mount(&check, &described.mount)?);
        Ok(sensor)
    }
}

fn no_beams(check: &Checker, found: &str) -> SensorError {
    let one = check.need(false, "table", "either `table` or `bands`", found);
    one.expect_err("it does not hold")
}

fn built_in(path: &str, table: &str) -> Result<String, SensorError> {
    let found = TABLES.iter().find(|(name, _)| *name == table);
    found
        .map(|(_, text)| text.to_string())
        .ok_or_else(|| SensorError::Unreadable {
            path: path.into(),
            reason: format!(
                "`table`: no file `{table}` beside it, and no built-in table of this name; built in are {}",
                TABLES.map(|(name, _)| name).join(", ")
            ),
        })
}

fn optics(check: &Checker, described: &Description) -> Result<Optics, SensorError> {
    let text = &described.optics;
    for (field, value, limits) in [
        ("optics.reach_m", text.reach_m, [1.0, 1000.0]),
        ("optics.reach_reflectivity", text.reach_reflectivity, [0.01, 1.0]),
        ("optics.farthest_m", text.farthest_m, [1.0, super::FARTHEST]),
        ("optics.nearest_m", text.nearest_m, [0.0, text.farthest_m.min(10.0)]),
        ("optics.range_step_m", text.range_step_m, [1e-4, 0.5]),
        ("optics.noise_floor_m", text.noise_floor_m, [0.0, 1.0]),
        ("optics.noise_slope_m", text.noise_slope_m, [0.0, 1.0]),
        (
            "optics.noise_ceiling_m",
            text.noise_ceiling_m,
            [text.noise_floor_m, 2.0],
        ),
    ] {
        check.within(field, value, limits)?;
    }
    Ok(Optics {
        strength: 3f64.sqrt() / text.reach_reflectivity,
        reference_range: text.reach_m,
        nearest: text.nearest_m,
        farthest: text.farthest_m,
        step: text.range_step_m,
        steps_per_metre: 1.0 / text.range_step_m,
        noise_floor: text.noise_floor_m,
        noise_slope: text.noise_slope_m,
        noise_ceiling: text.noise_ceiling_m,
        unanswered: described.unanswered,
        extinction: 0.0,
    })
}

fn mount(check: &Checker, text: &MountText) -> Result<Mount, SensorError> {
    check.need(
        (0.3..=30.0).contains(&text.height_m),
        "mount.height_m",
        "a height over ground within [0.3, 30]",
        text.height_m,
    )?;
    for (field, value, limit) in [
        ("mount.pitch_deg", text.pitch_deg, 30.0),
        ("mount.roll_deg", text.roll_deg, 30.0),
        ("mount.yaw_deg", text.yaw_deg, 180.0),
    ] {
        check.within(field, value, [-limit, limit])?;
    }
    check.within("mount.misalignment_deg", text.misalignment_deg, [0.0, 5.0])?;
    Ok(Mount {
        height: text.height_m,
        pitch: text.pitch_deg.to_radians(),
        roll: text.roll_deg.to_radians(),
        yaw: text.yaw_deg.to_radians(),
        misalignment: text.misalignment_deg.to_radians(),
    })
}

fn band_beams(check: &Checker, bands: &[Band]) -> Result<Vec<Beam>, SensorError> {
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
fn table_beams(check: &Checker, text: &str) -> Result<Vec<Beam>, SensorError> {
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

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = include_str!("../../sensors/spinning-16.toml");

    fn parse(text: &str, table: &str) -> Result<Sensor, SensorError> {
        Sensor::parse("my.toml", text, |_| Ok(table.to_string()))
    }

    #[test]
    fn built_in_sensors_can_be() {
        for (name, beams, columns) in [
            ("spinning-16", 16, 1800),
            ("spinning-32", 32, 1800),
            ("pandar40p", 40, 1800),
            ("os1-64", 64, 1024),
            ("os1-128", 128, 1024),
            ("ruby-plus-128", 128, 1800),
            ("forward-scan", 331, 490),
        ] {
            let sensor = Sensor::named(name).unwrap();
            assert_eq!((sensor.beams.len(), sensor.columns), (beams, columns), "{name}");
            let mut rings: Vec<u16> = sensor.beams.iter().map(|beam| beam.ring).collect();
            rings.sort_unstable();
            assert!(
                rings.iter().enumerate().all(|(i, ring)| i == usize::from(*ring)),
                "{name}"
            );
        }
        assert_eq!(Sensor::names().count(), BUILT_IN.len());
        assert!(
            Sensor::named("spinning-17")
                .unwrap_err()
                .to_string()
                .contains("pandar40p")
        );
        assert!(
            Sensor::named("/no/such.toml")
                .unwrap_err()
                .to_string()
                .contains("/no/such.toml")
        );
    }

    #[test]
    fn refuses_by_field_what_no_sensor_can_be() {
        let table = GOOD.replace("[[bands]]\nfrom_deg = -15.0\nto_deg = 15.0\nstep_deg = 2.0\n", "");
        let table = table.replace("columns = 1800", "columns = 1800\ntable = \"t.csv\"");
        let header = "beam,elevation_deg\n";
        let cases: [(String, &str, &str); 16] = [
            (
                GOOD.replace("columns = 1800", "columns = 1800\nfield_deg = 1.0"),
                "",
                "field_deg",
            ),
            (
                table.clone(),
                "elevation_deg,firing_offset_us\n0.0,0.0\n1.0,60.0\n",
                "firing_offset_us",
            ),
            (GOOD.replace("height_m = 1.9", "height_m = -0.5"), "", "mount.height_m"),
            (GOOD.replace("height_m = 1.9", "height_m = nan"), "", "mount.height_m"),
            (GOOD.replace("columns = 1800", "columns = 0"), "", "columns"),
            (
                GOOD.replace("from_deg = -15.0", "from_deg = nan"),
                "",
                "bands[0].from_deg",
            ),
            (
                GOOD.replace("from_deg = -15.0", "from_deg = 16.0"),
                "",
                "bands[0].from_deg",
            ),
            (
                GOOD.replace("step_deg = 2.0", "step_deg = 0.0"),
                "",
                "bands[0].step_deg",
            ),
            (GOOD.replace("unanswered = 0.05", "unanswered = 1.5"), "", "unanswered"),
            (GOOD.replace("unanswered = 0.05", "unansered = 0.05"), "", "unansered"),
            (
                GOOD.replace("farthest_m = 120.0", "farthest_m = 4000.0"),
                "",
                "optics.farthest_m",
            ),
            (table.clone(), header, "beams"),
            (
                table.clone(),
                "beam,elevation_deg\n0,1.0\n1,nan\n",
                "line 3, elevation_deg",
            ),
            (table.clone(), "beam,elevation_deg\n0,1.0\n1,3.0\n2,2.0\n", "not sorted"),
            (table.clone(), "beam,elevation\n0,1.0\n", "elevation_deg"),
            (
                format!("table = \"t.csv\"\n{GOOD}"),
                "beam,elevation_deg\n0,1.0\n",
                "either",
            ),
        ];
        for (text, table, named) in cases {
            let error = parse(&text, table).unwrap_err().to_string();
            assert!(
                error.contains(named) && error.contains("my.toml"),
                "{error} does not name {named}"
            );
        }
        assert!(parse(GOOD, "").is_ok());
        assert_eq!(
            parse(&table, "beam,elevation_deg\n0,1.0\n1,-2.0\n")
                .unwrap()
                .beams
                .len(),
            2
        );
    }
}

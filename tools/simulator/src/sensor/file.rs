//! Sensors as files: what one may say, and what is refused.

mod beams;
mod described;
mod error;

use std::path::Path;
use std::sync::{Arc, OnceLock};

use super::{Mount, Optics, Scan, Sensor};
use beams::{band_beams, no_beams, table_beams};
use described::{Checker, Description, MountText};
pub use error::SensorError;

/// Beams that look farther up or down than this, degrees, are not taken: azimuths lose their meaning there.
const STEEPEST: f64 = 60.0;
/// Beams that look farther aside of their column than this, degrees, are not taken.
const ASIDE: f64 = 6.0;
/// A sensor's beams and columns at most.
const MOST_BEAMS: usize = 512;
const MOST_COLUMNS: usize = 4096;
/// Narrower fields are no sensor's, degrees.
const NARROWEST: f64 = 10.0;

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

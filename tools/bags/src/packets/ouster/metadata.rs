//! The metadata of a sensor of Ouster, in the flat form of older drivers or the nested one of newer.

use std::f64::consts::TAU;

use serde_json::Value;

use super::{PROFILES, Profile};

/// Columns and pixels are no more than this.
const MOST: u64 = 4096;

/// How a sensor's packets are laid out, and where its beams look.
#[derive(Clone, Debug)]
pub struct Format {
    pub(super) profile: Profile,
    pub(super) columns_per_frame: usize,
    pub(super) columns_per_packet: usize,
    pub(super) pixels: usize,
    /// Columns of the part of a turn that is sent.
    pub(super) window: usize,
    /// The serial number of the sensor.
    pub(super) serial: Option<u64>,
    /// The number of its start.
    pub(super) start: Option<u64>,
    /// Ports of the packets of points and of the inertial unit.
    pub(crate) ports: [Option<u64>; 2],
    model: String,
    /// Altitude and azimuth of each beam, rad.
    beams: Vec<[f64; 2]>,
    /// From the middle of the sensor to where beams begin: outwards and up, m.
    origin: [f64; 2],
    /// Sensor from the frame of the beams, by rows; m.
    sensor_from_lidar: [[f64; 4]; 3],
}

impl Format {
    /// Reads metadata.
    ///
    /// # Errors
    /// A field that is missing or holds something else; a profile that is not read, by its name.
    pub fn parse(text: &str) -> Result<Self, String> {
        let root: Value =
            serde_json::from_str(text).map_err(|error| format!("expected JSON, found something else: {error}"))?;
        let data = get(&root, &["data_format", "lidar_data_format"]);
        let beams = get(&root, &["beam_intrinsics"]);
        let lidar = get(&root, &["lidar_intrinsics"]);
        let config = get(&root, &["config_params"]);
        let info = get(&root, &["sensor_info"]);
        let profile = data["udp_profile_lidar"]
            .as_str()
            .or(config["udp_profile_lidar"].as_str())
            .unwrap_or("LEGACY");
        let known = PROFILES.iter().find(|known| known.name == profile).ok_or_else(|| {
            let names: Vec<&str> = PROFILES.iter().map(|profile| profile.name).collect();
            format!(
                "udp_profile_lidar: expected {}, found `{}`; play the packets through the sensor's driver and record its clouds",
                names.join(", "),
                profile.escape_debug()
            )
        })?;
        let count = |name: &str| count(data, name);
        let (columns_per_frame, pixels) = (count("columns_per_frame")?, count("pixels_per_column")?);
        let angles = |name: &str| -> Result<Vec<f64>, String> {
            let found = numbers(if beams[name].is_null() {
                &root[name]
            } else {
                &beams[name]
            });
            match found.len() == pixels {
                true => Ok(found.into_iter().map(f64::to_radians).collect()),
                false => Err(format!(
                    "{name}: expected {pixels} angles, one for each pixel, found {}",
                    found.len()
                )),
            }
        };
        let (altitudes, azimuths) = (angles("beam_altitude_angles")?, angles("beam_azimuth_angles")?);
        let transform = if lidar.is_null() {
            &root["lidar_to_sensor_transform"]
        } else {
            &lidar["lidar_to_sensor_transform"]
        };
        Ok(Format {
            profile: *known,
            columns_per_frame,
            columns_per_packet: count("columns_per_packet")?,
            pixels,
            window: window(data, columns_per_frame),
            serial: whole(get(if info.is_null() { &root } else { info }, &["prod_sn"])),
            start: whole(get(if info.is_null() { &root } else { info }, &["initialization_id"])),
            ports: ["udp_port_lidar", "udp_port_imu"].map(|name| whole(&config[name]).or(whole(&root[name]))),
            model: model_of(&root, info),
            beams: altitudes
                .into_iter()
                .zip(azimuths)
                .map(|(altitude, azimuth)| [altitude, azimuth])
                .collect(),
            origin: origin(&root, beams)?,
            sensor_from_lidar: in_metres("lidar_to_sensor_transform", transform)?,
        })
    }

    /// Packets of a turn.
    pub fn packets_per_frame(&self) -> usize {
        self.columns_per_frame.div_ceil(self.columns_per_packet)
    }

    /// Why the columns of so many packets are of a mode with half as many or fewer; `most`: the last of a turn.
    pub fn too_few_columns(&self, most: usize, packets: usize) -> Option<String> {
        let is_turn = packets >= self.packets_per_frame() && self.window == self.columns_per_frame;
        (is_turn && 2 * (most + 1) <= self.columns_per_frame).then(|| {
            format!(
                "expected columns 0 to {} of a turn, found none beyond {most}; see whether the metadata are of this mode of the sensor",
                self.columns_per_frame - 1
            )
        })
    }

    /// The sensor in words.
    pub fn words(&self) -> String {
        let Format {
            model,
            profile,
            pixels,
            columns_per_frame,
            ..
        } = self;
        let dual = if profile.name.ends_with("DUAL") {
            ", first returns"
        } else {
            ""
        };
        format!(
            "{} of {} ({pixels} × {columns_per_frame}){dual}",
            profile.name,
            model.escape_debug()
        )
    }

    /// Where a return lies in the frame of the sensor, m.
    pub(super) fn place(&self, column: usize, ring: usize, range: f64) -> [f32; 3] {
        let [altitude, azimuth] = self.beams[ring];
        let [out, up] = self.origin;
        // The encoder counts clockwise.
        let (sin, cos) = libm::sincos(TAU * (1.0 - column as f64 / self.columns_per_frame as f64));
        let (sin_beam, cos_beam) = libm::sincos(TAU * (1.0 - column as f64 / self.columns_per_frame as f64) - azimuth);
        let (sin_up, cos_up) = libm::sincos(altitude);
        let along = range - libm::hypot(out, up);
        let point = [
            along * cos_up * cos_beam + out * cos,
            along * cos_up * sin_beam + out * sin,
            along * sin_up + up,
        ];
        self.sensor_from_lidar
            .map(|[a, b, c, d]| (a * point[0] + b * point[1] + c * point[2] + d) as f32)
    }
}

/// The first of some keys that is there; null without any.
fn get<'a>(root: &'a Value, keys: &[&str]) -> &'a Value {
    keys.iter()
        .map(|key| &root[*key])
        .find(|value| !value.is_null())
        .unwrap_or(&Value::Null)
}

fn model_of(root: &Value, info: &Value) -> String {
    let named = root["prod_line"].as_str().or(info["prod_line"].as_str());
    named.unwrap_or("Ouster").to_string()
}

/// A whole number, or a text of one.
fn whole(value: &Value) -> Option<u64> {
    value.as_u64().or_else(|| value.as_str()?.parse().ok())
}

fn count(data: &Value, name: &str) -> Result<usize, String> {
    let count = data[name].as_u64().filter(|count| (1..=MOST).contains(count));
    count
        .map(|count| count as usize)
        .ok_or_else(|| format!("data_format.{name}: expected 1 to {MOST}, found {}", data[name]))
}

fn numbers(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(Value::as_f64)
        .collect()
}

/// Columns of the part of a turn that is sent; its ends count, and it may go over the end of the turn.
fn window(data: &Value, columns: usize) -> usize {
    match numbers(&data["column_window"])[..] {
        [first, last] if first >= 0.0 && last >= 0.0 => {
            let (first, last) = (first as usize % columns, last as usize % columns);
            (last + columns - first) % columns + 1
        }
        _ => columns,
    }
}

/// From the middle of the sensor to where beams begin, outwards and up, m.
fn origin(root: &Value, beams: &Value) -> Result<[f64; 2], String> {
    let matrix = get(if beams.is_null() { root } else { beams }, &["beam_to_lidar_transform"]);
    if !matrix.is_null() {
        let [[.., out], _, [.., up]] = in_metres("beam_to_lidar_transform", matrix)?;
        return Ok([out, up]);
    }
    let value = get(
        if beams.is_null() { root } else { beams },
        &["lidar_origin_to_beam_origin_mm"],
    );
    match value.as_f64() {
        Some(out) => Ok([out / 1000.0, 0.0]),
        None => Err(format!("lidar_origin_to_beam_origin_mm: expected mm, found {value}")),
    }
}

/// The rows of a matrix of 16 numbers whose lengths are in mm.
fn in_metres(name: &str, value: &Value) -> Result<[[f64; 4]; 3], String> {
    let numbers = numbers(value);
    match numbers.as_chunks::<4>() {
        ([a, b, c, _], []) => Ok([a, b, c].map(|[x, y, z, offset]| [*x, *y, *z, offset / 1000.0])),
        _ => Err(format!("{name}: expected 16 numbers, found {}", numbers.len())),
    }
}

//! Motion as columns: each kind of measurement has its own lists.

use super::*;
use crate::motion::{MOST_APART, MOST_SAMPLES, Taken};
use crate::{FixQuality, GnssFix, ImuSample, Motion, Nanos, WheelSpeed};

/// What is added to the number of a position's quality where its height is not known.
const NO_HEIGHT: u8 = 16;

pub(super) fn write(motion: &Motion, row: &mut Builder) {
    times(row, "imu", motion.imu.iter().map(|sample| sample.taken));
    row.list(
        "imu_angular_rate",
        vectors(motion.imu.iter().map(|sample| sample.angular_rate)),
    );
    row.list(
        "imu_specific_force",
        vectors(motion.imu.iter().map(|sample| sample.specific_force)),
    );
    row.list_f64(
        "imu_variance",
        motion.imu_variance.map(|of| of.to_vec()).unwrap_or_default(),
    );
    times(row, "fix", motion.fixes.iter().map(|fix| fix.taken));
    row.list("fix_position", vectors(motion.fixes.iter().map(|fix| fix.position)));
    let covariances = motion.fixes.iter().map(|fix| fix.covariance);
    row.list("fix_covariance", optional(covariances));
    let code = |fix: &GnssFix| fix.quality.code() + if fix.has_height { 0 } else { NO_HEIGHT };
    let qualities = motion.fixes.iter().map(code);
    row.list("fix_quality", UInt8Array::from_iter_values(qualities));
    times(row, "wheel", motion.wheels.iter().map(|wheel| wheel.taken));
    row.list_f64("wheel_speed", motion.wheels.iter().map(|wheel| wheel.speed).collect());
    // Unknown variances are NaN: lists of numbers have no gaps in other languages.
    let variances = motion.wheels.iter().map(|wheel| wheel.variance.unwrap_or(f64::NAN));
    row.list_f64("wheel_variance", variances.collect());
    row.list_f64("imu_at", motion.imu_position.to_vec());
    row.list_f64("antenna_at", motion.antenna.to_vec());
    row.list_f64("axle_at", motion.axle.to_vec());
}

fn times(row: &mut Builder, of: &str, taken: impl Iterator<Item = Taken> + Clone) {
    row.list_i64(&format!("{of}_stamp"), taken.clone().map(|taken| taken.stamp).collect());
    row.list_i64(&format!("{of}_arrival"), taken.map(|taken| taken.arrival).collect());
}

fn vectors<const N: usize>(values: impl Iterator<Item = [f64; N]>) -> FixedSizeListArray {
    optional(values.map(Some))
}

fn optional<const N: usize>(values: impl Iterator<Item = Option<[f64; N]>>) -> FixedSizeListArray {
    let values: Vec<Option<[f64; N]>> = values.collect();
    let numbers = values.iter().flat_map(|value| value.unwrap_or([0.0; N]));
    let numbers = Arc::new(Float64Array::from_iter_values(numbers));
    let known = NullBuffer::from_iter(values.iter().map(Option::is_some));
    let field = Arc::new(Field::new("item", DataType::Float64, true));
    FixedSizeListArray::new(field, N as i32, numbers, Some(known))
}

pub(super) fn read(row: &Row) -> Result<Motion, WireError> {
    let variance = row.list_f64("imu_variance")?;
    let imu_variance = match &variance[..] {
        [] => None,
        [rate, force] => Some([*rate, *force]),
        other => {
            let reason = format!("needs 2 numbers or none, found {}", other.len());
            return Err(WireError::content("imu_variance", reason));
        }
    };
    let motion = Motion {
        imu: read_imu(row)?,
        imu_variance,
        fixes: read_fixes(row)?,
        wheels: read_wheels(row)?,
        imu_position: place(row, "imu_at")?,
        antenna: place(row, "antenna_at")?,
        axle: place(row, "axle_at")?,
    };
    match motion.fault() {
        None => Ok(motion),
        Some(reason) => Err(WireError::content("motion", reason)),
    }
}

fn read_imu(row: &Row) -> Result<Vec<ImuSample>, WireError> {
    let taken = read_times(row, "imu")?;
    let rates = read_vectors(row, "imu_angular_rate", taken.len())?;
    let forces = read_vectors(row, "imu_specific_force", taken.len())?;
    let samples = taken.into_iter().zip(rates.into_iter().zip(forces));
    let sample = |(taken, (rate, force)): (Taken, (Option<_>, Option<_>))| {
        let null = |field: &str| WireError::content(field, "is null");
        Ok(ImuSample {
            taken,
            angular_rate: rate.ok_or_else(|| null("imu_angular_rate"))?,
            specific_force: force.ok_or_else(|| null("imu_specific_force"))?,
        })
    };
    samples.map(sample).collect()
}

fn read_fixes(row: &Row) -> Result<Vec<GnssFix>, WireError> {
    let taken = read_times(row, "fix")?;
    let positions = read_vectors(row, "fix_position", taken.len())?;
    let covariances = read_vectors(row, "fix_covariance", taken.len())?;
    let qualities = row.list::<UInt8Array>("fix_quality")?;
    as_many("fix_quality", qualities.len(), taken.len())?;
    let fix = |at: usize| {
        let code = qualities.value(at);
        let quality = FixQuality::of_code((code & !NO_HEIGHT).into());
        let unknown = || WireError::content("fix_quality", format!("unknown number {}", qualities.value(at)));
        Ok(GnssFix {
            taken: taken[at],
            position: positions[at].ok_or_else(|| WireError::content("fix_position", "is null"))?,
            covariance: covariances[at],
            has_height: code & NO_HEIGHT == 0,
            quality: quality.ok_or_else(unknown)?,
        })
    };
    (0..taken.len()).map(fix).collect()
}

fn read_wheels(row: &Row) -> Result<Vec<WheelSpeed>, WireError> {
    let taken = read_times(row, "wheel")?;
    let speeds = row.list_f64("wheel_speed")?;
    as_many("wheel_speed", speeds.len(), taken.len())?;
    let variances = row.list_f64("wheel_variance")?;
    as_many("wheel_variance", variances.len(), taken.len())?;
    let wheel = |at: usize| WheelSpeed {
        taken: taken[at],
        speed: speeds[at],
        variance: Some(variances[at]).filter(|of| !of.is_nan()),
    };
    Ok((0..taken.len()).map(wheel).collect())
}

fn read_times(row: &Row, of: &str) -> Result<Vec<Taken>, WireError> {
    let (stamp, arrival) = (format!("{of}_stamp"), format!("{of}_arrival"));
    let (stamps, arrivals) = (row.list_i64(&stamp)?, row.list_i64(&arrival)?);
    as_many(&arrival, arrivals.len(), stamps.len())?;
    if stamps.len() > MOST_SAMPLES {
        let reason = format!("expected at most {MOST_SAMPLES} measurements, found {}", stamps.len());
        return Err(WireError::content(&stamp, reason));
    }
    let is_near = |time: &Nanos| (-MOST_APART..=MOST_APART).contains(time);
    if let Some(far) = stamps.iter().chain(&arrivals).find(|time| !is_near(time)) {
        let reason = format!("expected times within an hour of the message, found {far} ns");
        return Err(WireError::content(&stamp, reason));
    }
    let taken = stamps.iter().zip(&arrivals);
    let taken = taken.map(|(stamp, arrival)| Taken {
        stamp: *stamp,
        arrival: *arrival,
    });
    Ok(taken.collect())
}

fn read_vectors<const N: usize>(row: &Row, field: &str, count: usize) -> Result<Vec<Option<[f64; N]>>, WireError> {
    let lists = row.list::<FixedSizeListArray>(field)?;
    as_many(field, lists.len(), count)?;
    (0..lists.len()).map(|at| columns::vector(&lists, at, field)).collect()
}

fn as_many(field: &str, found: usize, expected: usize) -> Result<(), WireError> {
    match found == expected {
        true => Ok(()),
        false => Err(WireError::content(
            field,
            format!("{found} values for {expected} stamps"),
        )),
    }
}

fn place(row: &Row, field: &str) -> Result<[f64; 3], WireError> {
    let numbers = row.list_f64(field)?;
    let found = numbers.len();
    numbers[..]
        .try_into()
        .map_err(|_| WireError::content(field, format!("a place has 3 numbers, found {found}")))
}

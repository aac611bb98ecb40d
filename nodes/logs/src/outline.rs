//! An agent's outline as `geometry_msgs/msg/PolygonStamped`, on the ground of its body frame.

use realo_schemas::Nanos;

use crate::cdr::{CdrError, CdrReader, CdrWriter};

/// Appends an outline `[x min, x max, y min, y max]`, m. The message's numbers have single precision.
pub fn encode(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, [back, front, right, left]: [f64; 4]) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    let corners = [[front, left], [back, left], [back, right], [front, right]];
    out.length(corners.len());
    for [x, y] in corners {
        [x, y, 0.0].iter().for_each(|metres| out.f32(*metres as f32));
    }
}

/// Reads an outline: the extent of the polygon, m.
///
/// # Errors
/// Bytes that are no such message; a polygon without an area, or with a number that is not finite.
pub fn decode(payload: &[u8]) -> Result<[f64; 4], CdrError> {
    let mut input = CdrReader::new(payload)?;
    input.header()?;
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for _ in 0..input.length(12)? {
        let [x, y, _] = [input.f32()?, input.f32()?, input.f32()?].map(f64::from);
        for (axis, metres) in [x, y].into_iter().enumerate() {
            if !metres.is_finite() {
                return Err("expected corners of finite numbers".into());
            }
            (low[axis], high[axis]) = (low[axis].min(metres), high[axis].max(metres));
        }
    }
    match low[0] < high[0] && low[1] < high[1] {
        true => Ok([low[0], high[0], low[1], high[1]]),
        false => Err("expected a polygon with an area".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outline_comes_back_and_junk_is_refused() {
        let mut payload = Vec::new();
        encode(&mut payload, 7, "cav1/body", [-1.25, 3.5, -0.875, 0.875]);
        assert_eq!(decode(&payload).unwrap(), [-1.25, 3.5, -0.875, 0.875]);
        assert!(decode(&payload[..payload.len() - 5]).is_err());
        for (outline, said) in [
            ([1.0, 1.0, -1.0, 1.0], "an area"),
            ([-1.0, f64::NAN, -1.0, 1.0], "finite"),
        ] {
            let mut payload = Vec::new();
            encode(&mut payload, 7, "cav1/body", outline);
            let error = decode(&payload).unwrap_err();
            assert!(error.contains(said), "{error}");
        }
    }
}

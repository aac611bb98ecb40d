//! Clouds of PCD, as readers of OPV2V take them.

/// Binary PCD of left-handed points. Intensities, 0 to 255, are there twice: in 0…1 for readers of clouds, and as the grey of a
/// colour, which is where OPV2V's own reader looks. `times`: of points from the stamp, ns.
pub fn pcd(points: &[[f32; 3]], intensity: &[u8], times: Option<&[i32]>) -> Vec<u8> {
    let n = points.len();
    let [name, size, kind, count] = match times {
        Some(_) => [" offset_ns", " 4", " I", " 1"],
        None => [""; 4],
    };
    let head = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity rgb{name}\nSIZE 4 4 4 4 4{size}\n\
         TYPE F F F F F{kind}\nCOUNT 1 1 1 1 1{count}\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    );
    let mut bytes = Vec::with_capacity(head.len() + 24 * n);
    bytes.extend_from_slice(head.as_bytes());
    for (index, ([x, y, z], intensity)) in points.iter().zip(intensity).enumerate() {
        for number in [*x, -y, *z, f32::from(*intensity) / 255.0] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        bytes.extend_from_slice(&[*intensity, *intensity, *intensity, 0]);
        if let Some(time) = times.and_then(|times| times.get(index)) {
            bytes.extend_from_slice(&time.to_le_bytes());
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_mirrored_and_intensities_are_grey() {
        let points = [[1.0, 2.0, -3.0], [4.0, 5.0, 6.0]];
        let bytes = pcd(&points, &[255, 51], None);
        let at = bytes.windows(12).position(|part| part == b"DATA binary\n").unwrap() + 12;
        let data = &bytes[at..];
        assert_eq!(data.len(), 40);
        let number = |at: usize| f32::from_le_bytes(data[at..at + 4].try_into().unwrap());
        assert_eq!([0, 4, 8, 12].map(number), [1.0, -2.0, -3.0, 1.0]);
        assert_eq!(data[36..], [51, 51, 51, 0]);
        let timed = pcd(&points, &[255, 51], Some(&[-7, 99_000_000]));
        let head = String::from_utf8_lossy(&timed);
        assert!(head.contains("FIELDS x y z intensity rgb offset_ns\nSIZE 4 4 4 4 4 4\nTYPE F F F F F I\n"));
        assert_eq!(timed[timed.len() - 4..], 99_000_000_i32.to_le_bytes());
        assert!(bytes.starts_with(b"# .PCD") && String::from_utf8_lossy(&bytes).contains("POINTS 2\n"));
    }
}

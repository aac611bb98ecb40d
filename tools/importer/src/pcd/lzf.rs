//! LZF, in which PCD files compress.

/// What follows the compressed bytes is padding: the size in front of them counts, not that of the file.
pub fn decompress_body(body: &[u8], total: usize) -> Result<Vec<u8>, String> {
    let size_at = |at: usize| {
        let bytes: Option<[u8; 4]> = body.get(at..at + 4).and_then(|bytes| bytes.try_into().ok());
        bytes
            .map(|bytes| u32::from_le_bytes(bytes) as usize)
            .ok_or("the compressed sizes are missing".to_string())
    };
    let (packed, unpacked) = (size_at(0)?, size_at(4)?);
    if unpacked != total {
        return Err(format!(
            "expected {total} bytes of points, the file unpacks to {unpacked}"
        ));
    }
    let packed = body[8..]
        .get(..packed)
        .ok_or_else(|| format!("expected {packed} compressed bytes, found {}", body.len() - 8))?;
    lzf(packed, total)
}

/// Most bytes that one of LZF makes: three say how 264 are copied.
const LZF_RATIO: usize = 88;

/// Undoes LZF (Marc Lehmann's format): literal runs, and copies from at most 8 KiB back.
fn lzf(packed: &[u8], size: usize) -> Result<Vec<u8>, String> {
    if size > packed.len().saturating_mul(LZF_RATIO) {
        return Err(format!(
            "expected {size} bytes of points, {} compressed bytes cannot hold them",
            packed.len()
        ));
    }
    let mut out = Vec::with_capacity(size);
    let mut bytes = packed.iter().copied();
    let mut next = || bytes.next().ok_or("the compressed points end early".to_string());
    while out.len() < size {
        let control = usize::from(next()?);
        if control < 32 {
            for _ in 0..=control {
                out.push(next()?);
            }
            continue;
        }
        let mut length = control >> 5;
        if length == 7 {
            length += usize::from(next()?);
        }
        let distance = ((control & 31) << 8 | usize::from(next()?)) + 1;
        let from = out
            .len()
            .checked_sub(distance)
            .ok_or("the compressed points refer to bytes before their start")?;
        for at in from..from + length + 2 {
            out.push(out[at]);
        }
    }
    match out.len() == size {
        true => Ok(out),
        false => Err(format!("expected {size} bytes of points, unpacked {}", out.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unpacks_overlapping_copies() {
        assert_eq!(lzf(&[1, b'a', b'b', 0x60, 1], 7).unwrap(), b"abababa");
        assert_eq!(lzf(&[0, b'x', 0xe0, 3, 0], 13).unwrap(), b"xxxxxxxxxxxxx");
        assert!(lzf(&[0x20, 0], 3).unwrap_err().contains("before their start"));
        assert!(lzf(&[0], 1).unwrap_err().contains("end early"));
        let longest = [&[0, b'x'][..], &[0xe0, 255, 0].repeat(3)].concat();
        assert_eq!(lzf(&longest, 793).unwrap(), [b'x'; 793]);
        assert!(lzf(&longest, 11 * 88).unwrap_err().contains("end early"));
        assert!(
            lzf(&longest, 11 * 88 + 1)
                .unwrap_err()
                .contains("11 compressed bytes cannot hold them")
        );
        assert!(lzf(&[1, 1, 2], 1).unwrap_err().contains("unpacked 2"));
    }
}

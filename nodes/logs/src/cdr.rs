//! The part of CDR (XCDR1) that ROS 2 messages need. Alignment counts from the body, after the 4-byte head. Logs are little endian;
//! bags of others may be big endian, or in the serialisation of ROS 1.

use realo_schemas::Nanos;

const HEAD: [u8; 4] = [0, 1, 0, 0];

/// Appends one CDR payload, head included, to a buffer.
pub struct CdrWriter<'a> {
    buffer: &'a mut Vec<u8>,
    body: usize,
}

impl<'a> CdrWriter<'a> {
    /// Starts a payload at the end of `buffer`.
    pub fn new(buffer: &'a mut Vec<u8>) -> Self {
        buffer.extend_from_slice(&HEAD);
        let body = buffer.len();
        CdrWriter { buffer, body }
    }

    fn align(&mut self, size: usize) {
        let used = self.buffer.len() - self.body;
        self.buffer.resize(self.body + used.next_multiple_of(size), 0);
    }

    /// One byte.
    pub fn u8(&mut self, value: u8) {
        self.buffer.push(value);
    }

    /// A truth value.
    pub fn bool(&mut self, value: bool) {
        self.u8(u8::from(value));
    }

    /// 16 bits.
    pub fn u16(&mut self, value: u16) {
        self.align(2);
        self.buffer.extend_from_slice(&value.to_le_bytes());
    }

    /// 32 bits, also lengths of sequences.
    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.buffer.extend_from_slice(&value.to_le_bytes());
    }

    /// 32 bits, signed.
    pub fn i32(&mut self, value: i32) {
        self.u32(value as u32);
    }

    /// Single precision.
    pub fn f32(&mut self, value: f32) {
        self.u32(value.to_bits());
    }

    /// 64 bits.
    pub fn u64(&mut self, value: u64) {
        self.align(8);
        self.buffer.extend_from_slice(&value.to_le_bytes());
    }

    /// Double precision.
    pub fn f64(&mut self, value: f64) {
        self.u64(value.to_bits());
    }

    /// Several doubles of a fixed-size array.
    pub fn f64s(&mut self, values: &[f64]) {
        values.iter().for_each(|v| self.f64(*v));
    }

    /// Length of a sequence.
    pub fn length(&mut self, length: usize) {
        self.u32(u32::try_from(length).expect("sequences of a message have less than 2^32 elements"));
    }

    /// Text, with the closing zero that CDR counts.
    pub fn string(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.buffer.extend_from_slice(text.as_bytes());
        self.buffer.push(0);
    }

    /// `size` bytes of a `uint8[]`, zeroed, for the caller to fill.
    pub fn bytes_mut(&mut self, size: usize) -> &mut [u8] {
        self.length(size);
        let start = self.buffer.len();
        self.buffer.resize(start + size, 0);
        &mut self.buffer[start..]
    }

    /// `builtin_interfaces/Time`.
    pub fn time(&mut self, nanos: Nanos) {
        self.i32(nanos.div_euclid(1_000_000_000) as i32);
        self.u32(nanos.rem_euclid(1_000_000_000) as u32);
    }

    /// `std_msgs/Header`.
    pub fn header(&mut self, stamp: Nanos, frame: &str) {
        self.time(stamp);
        self.string(frame);
    }
}

/// Why a CDR payload could not be read.
pub type CdrError = String;

/// How the fields of a message are laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Wire {
    CdrLittle,
    CdrBig,
    /// Little endian without alignment; texts have no closing zero, headers a number, and seconds no sign.
    Ros1,
}

/// Reads one payload; checks every length against what is there.
pub struct CdrReader<'a> {
    body: &'a [u8],
    at: usize,
    wire: Wire,
}

impl<'a> CdrReader<'a> {
    /// Starts behind the head.
    ///
    /// # Errors
    /// Another encoding than little-endian CDR.
    pub fn new(payload: &'a [u8]) -> Result<Self, CdrError> {
        match payload {
            [0, 1, _, _, body @ ..] => Ok(Self::of(body, Wire::CdrLittle)),
            [a, b, _, _, ..] => Err(format!(
                "expected little-endian CDR (head 00 01), found head {a:02x} {b:02x}"
            )),
            _ => Err(format!("expected a CDR head of 4 bytes, found {} bytes", payload.len())),
        }
    }

    /// Starts behind the head of CDR of either byte order.
    ///
    /// # Errors
    /// Another encoding than plain CDR.
    pub fn any_cdr(payload: &'a [u8]) -> Result<Self, CdrError> {
        match payload {
            [0, 0, _, _, body @ ..] => Ok(Self::of(body, Wire::CdrBig)),
            [a, b, _, _, ..] if (*a, *b) > (0, 1) => Err(format!(
                "expected plain CDR (head 00 00 or 00 01), found head {a:02x} {b:02x}"
            )),
            _ => Self::new(payload),
        }
    }

    /// Starts a message in the serialisation of ROS 1, which has no head.
    pub fn ros1(payload: &'a [u8]) -> Self {
        Self::of(payload, Wire::Ros1)
    }

    fn of(body: &'a [u8], wire: Wire) -> Self {
        CdrReader { body, at: 0, wire }
    }

    /// Whether the message is in the serialisation of ROS 1.
    pub fn is_ros1(&self) -> bool {
        self.wire == Wire::Ros1
    }

    /// Bytes that are not read yet.
    pub fn rest(&self) -> usize {
        self.left(self.at)
    }

    fn take(&mut self, size: usize, align: usize) -> Result<&'a [u8], CdrError> {
        let start = match self.wire {
            Wire::Ros1 => self.at,
            Wire::CdrLittle | Wire::CdrBig => self.at.next_multiple_of(align),
        };
        let bytes = start.checked_add(size).and_then(|end| self.body.get(start..end));
        let bytes =
            bytes.ok_or_else(|| format!("expected {size} more bytes at byte {start}, found {}", self.left(start)))?;
        self.at = start + size;
        Ok(bytes)
    }

    fn left(&self, start: usize) -> usize {
        self.body.len().saturating_sub(start)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let bytes = self.take(N, N)?;
        Ok(match self.wire {
            Wire::CdrBig => std::array::from_fn(|i| bytes[N - 1 - i]),
            Wire::CdrLittle | Wire::Ros1 => std::array::from_fn(|i| bytes[i]),
        })
    }

    /// One byte.
    pub fn u8(&mut self) -> Result<u8, CdrError> {
        self.array().map(u8::from_le_bytes)
    }

    /// A truth value.
    pub fn bool(&mut self) -> Result<bool, CdrError> {
        Ok(self.u8()? != 0)
    }

    /// 16 bits.
    pub fn u16(&mut self) -> Result<u16, CdrError> {
        self.array().map(u16::from_le_bytes)
    }

    /// 32 bits.
    pub fn u32(&mut self) -> Result<u32, CdrError> {
        self.array().map(u32::from_le_bytes)
    }

    /// 32 bits, signed.
    pub fn i32(&mut self) -> Result<i32, CdrError> {
        self.array().map(i32::from_le_bytes)
    }

    /// 64 bits.
    pub fn u64(&mut self) -> Result<u64, CdrError> {
        self.array().map(u64::from_le_bytes)
    }

    /// Single precision.
    pub fn f32(&mut self) -> Result<f32, CdrError> {
        self.array().map(f32::from_le_bytes)
    }

    /// Double precision.
    pub fn f64(&mut self) -> Result<f64, CdrError> {
        self.array().map(f64::from_le_bytes)
    }

    /// A fixed number of doubles.
    pub fn f64s<const N: usize>(&mut self) -> Result<[f64; N], CdrError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    /// Length of a sequence whose elements take at least `min` bytes each.
    pub fn length(&mut self, min: usize) -> Result<usize, CdrError> {
        let length = self.u32()? as usize;
        match length.checked_mul(min) {
            Some(bytes) if bytes <= self.left(self.at) => Ok(length),
            _ => Err(format!(
                "a sequence of {length} elements in {} bytes",
                self.left(self.at)
            )),
        }
    }

    /// Text.
    pub fn string(&mut self) -> Result<&'a str, CdrError> {
        let length = self.length(1)?;
        let bytes = self.take(length, 1)?;
        let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        std::str::from_utf8(text).map_err(|error| format!("a text that is not UTF-8: {error}"))
    }

    /// A `uint8[]`.
    pub fn bytes(&mut self) -> Result<&'a [u8], CdrError> {
        let length = self.length(1)?;
        self.take(length, 1)
    }

    /// `builtin_interfaces/Time`.
    pub fn time(&mut self) -> Result<Nanos, CdrError> {
        let seconds = match self.wire {
            Wire::Ros1 => i64::from(self.u32()?),
            Wire::CdrLittle | Wire::CdrBig => i64::from(self.i32()?),
        };
        Ok(seconds * 1_000_000_000 + i64::from(self.u32()?))
    }

    /// `std_msgs/Header`: stamp and frame.
    pub fn header(&mut self) -> Result<(Nanos, &'a str), CdrError> {
        if self.is_ros1() {
            self.u32()?;
        }
        Ok((self.time()?, self.string()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aligns_from_the_body_and_reads_what_it_wrote() {
        let mut buffer = vec![9; 3];
        let mut writer = CdrWriter::new(&mut buffer);
        writer.header(-1, "cav1/body");
        writer.u8(7);
        writer.f64(0.1);
        writer.bytes_mut(2).copy_from_slice(&[4, 5]);
        let mut reader = CdrReader::new(&buffer[3..]).unwrap();
        assert_eq!(reader.header().unwrap(), (-1, "cav1/body"));
        assert_eq!(reader.u8().unwrap(), 7);
        assert_eq!(reader.f64().unwrap(), 0.1);
        assert_eq!(reader.bytes().unwrap(), [4, 5]);
        assert!(reader.u8().unwrap_err().contains("found 0"));
    }

    #[test]
    fn reads_both_byte_orders_and_ros_1() {
        let big = [
            &[0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 7, 0, 0, 0, 3][..],
            b"ab\0",
            &[0],
            &1.5f64.to_be_bytes(),
        ]
        .concat();
        let mut reader = CdrReader::any_cdr(&big).unwrap();
        assert_eq!(reader.header().unwrap(), (5_000_000_007, "ab"));
        assert_eq!((reader.f64().unwrap(), reader.rest()), (1.5, 0));
        let ros1 = [
            &[9, 0, 0, 0, 5, 0, 0, 0, 7, 0, 0, 0, 2, 0, 0, 0][..],
            b"ab",
            &1.5f64.to_le_bytes(),
        ]
        .concat();
        let mut reader = CdrReader::ros1(&ros1);
        assert_eq!(reader.header().unwrap(), (5_000_000_007, "ab"));
        assert_eq!((reader.f64().unwrap(), reader.rest()), (1.5, 0));
        for head in [[0, 3, 0, 0], [1, 1, 0, 0]] {
            assert!(CdrReader::any_cdr(&head).err().unwrap().contains("plain CDR"));
        }
        assert!(CdrReader::any_cdr(&[0, 0]).is_err());
    }

    #[test]
    fn refuses_lengths_beyond_the_payload() {
        let payload = [0, 1, 0, 0, 255, 255, 255, 255, 1];
        assert!(
            CdrReader::new(&payload)
                .unwrap()
                .string()
                .unwrap_err()
                .contains("4294967295")
        );
        assert!(CdrReader::new(&[0, 0, 0, 0]).err().unwrap().contains("little-endian"));
        assert!(CdrReader::new(&[0]).is_err());
    }
}

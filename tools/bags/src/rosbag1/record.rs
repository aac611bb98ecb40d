//! Records of a bag of ROS 1: a head of named fields, and data. No length is believed.

use std::ops::Range;

use realo_schemas::Nanos;

/// What a record is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Op {
    Message,
    Bag,
    Index,
    Chunk,
    Connection,
    Other,
}

/// The head of a record.
pub struct Head<'a> {
    pub op: Op,
    fields: Vec<(&'a [u8], &'a [u8])>,
}

impl<'a> Head<'a> {
    pub fn read(bytes: &'a [u8]) -> Result<Self, String> {
        let mut head = Self::fields(bytes)?;
        head.op = match head.find("op")? {
            [2] => Op::Message,
            [3] => Op::Bag,
            [4] => Op::Index,
            [5] => Op::Chunk,
            [7] => Op::Connection,
            _ => Op::Other,
        };
        Ok(head)
    }

    /// Fields alone, as in the data of a connection.
    pub fn fields(mut bytes: &'a [u8]) -> Result<Self, String> {
        let mut fields = Vec::new();
        while !bytes.is_empty() {
            let wrong = || "the head of a record whose fields do not fit it".to_string();
            let (length, rest) = bytes.split_first_chunk::<4>().ok_or_else(wrong)?;
            let (field, rest) = rest
                .split_at_checked(u32::from_le_bytes(*length) as usize)
                .ok_or_else(wrong)?;
            let at = field.iter().position(|byte| *byte == b'=').ok_or_else(wrong)?;
            fields.push((&field[..at], &field[at + 1..]));
            bytes = rest;
        }
        Ok(Head { op: Op::Other, fields })
    }

    fn find(&self, name: &str) -> Result<&'a [u8], String> {
        let found = self.fields.iter().find(|(known, _)| *known == name.as_bytes());
        found
            .map(|(_, value)| *value)
            .ok_or_else(|| format!("the head of a record without `{name}`"))
    }

    fn array<const N: usize>(&self, name: &str) -> Result<[u8; N], String> {
        let value = self.find(name)?;
        let wrong = |_| format!("`{name}` of a record: expected {N} bytes, found {}", value.len());
        value.try_into().map_err(wrong)
    }

    pub fn u32(&self, name: &str) -> Result<u32, String> {
        self.array(name).map(u32::from_le_bytes)
    }

    pub fn u64(&self, name: &str) -> Result<u64, String> {
        self.array(name).map(u64::from_le_bytes)
    }

    pub fn time(&self, name: &str) -> Result<Nanos, String> {
        self.array(name).map(time)
    }

    pub fn text(&self, name: &str) -> Result<&'a str, String> {
        std::str::from_utf8(self.find(name)?).map_err(|_| format!("`{name}` of a record is not UTF-8"))
    }
}

/// Seconds and nanoseconds since 1970.
pub fn time(bytes: [u8; 8]) -> Nanos {
    let part = |from: usize| i64::from(u32::from_le_bytes(std::array::from_fn(|i| bytes[from + i])));
    part(0) * 1_000_000_000 + part(4)
}

/// The records of a chunk: heads, and where their data are.
pub fn records(bytes: &[u8]) -> impl Iterator<Item = Result<(Head<'_>, Range<usize>), String>> {
    let mut at = 0;
    std::iter::from_fn(move || {
        if at == bytes.len() {
            return None;
        }
        let record = one(bytes, at);
        at = record.as_ref().map_or(bytes.len(), |(_, data)| data.end);
        Some(record)
    })
}

fn one(bytes: &[u8], at: usize) -> Result<(Head<'_>, Range<usize>), String> {
    let head = block(bytes, at)?;
    let data = block(bytes, head.end)?;
    Ok((Head::read(&bytes[head])?, data))
}

fn block(bytes: &[u8], at: usize) -> Result<Range<usize>, String> {
    let rest = bytes.get(at..).unwrap_or_default();
    let wrong = || {
        format!(
            "a record at byte {at} of a chunk of {} bytes goes beyond it",
            bytes.len()
        )
    };
    let (length, rest) = rest.split_first_chunk::<4>().ok_or_else(wrong)?;
    let length = u32::from_le_bytes(*length) as usize;
    match length <= rest.len() {
        true => Ok(at + 4..at + 4 + length),
        false => Err(wrong()),
    }
}

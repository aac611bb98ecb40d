//! Rows of a table: the types of all values, then the values.

/// A value of a row.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) enum Value {
    #[default]
    Null,
    Integer(i64),
    Real(f64),
    Text(String),
    Blob(Vec<u8>),
    /// It is not among the bytes that were read.
    Elsewhere,
}

/// A number of 1 to 9 bytes, of which 7 bits each count.
pub fn varint(bytes: &mut &[u8]) -> Option<i64> {
    let mut value = 0u64;
    for place in 0..9 {
        let (byte, rest) = bytes.split_first()?;
        *bytes = rest;
        if place == 8 {
            return Some((value << 8 | u64::from(*byte)) as i64);
        }
        value = value << 7 | u64::from(byte & 0x7f);
        if byte & 0x80 == 0 {
            break;
        }
    }
    Some(value as i64)
}

/// The values of a row of `length` bytes of which the first are there.
pub fn values(payload: &[u8], length: usize) -> Result<Vec<Value>, String> {
    let wrong = || "the head of a row goes beyond it".to_string();
    let mut head = payload;
    let head_length = varint(&mut head)
        .and_then(|length| usize::try_from(length).ok())
        .ok_or_else(wrong)?;
    if head_length > payload.len() || head_length < payload.len() - head.len() {
        return Err(wrong());
    }
    let mut types = &payload[payload.len() - head.len()..head_length];
    let (mut values, mut at) = (Vec::new(), head_length);
    while !types.is_empty() {
        let kind = varint(&mut types).ok_or_else(wrong)?;
        let size = match kind {
            0 | 8 | 9 | 10 | 11 => 0,
            1..=4 => kind as usize,
            5 => 6,
            6 | 7 => 8,
            12.. => usize::try_from((kind - 12) / 2).map_err(|_| wrong())?,
            _ => return Err(wrong()),
        };
        let end = at
            .checked_add(size)
            .filter(|end| *end <= length)
            .ok_or_else(|| format!("a value of {size} bytes in a row of {length}"))?;
        values.push(match payload.get(at..end) {
            None => Value::Elsewhere,
            Some(bytes) => value(kind, bytes),
        });
        at = end;
    }
    Ok(values)
}

fn value(kind: i64, bytes: &[u8]) -> Value {
    let integer = || {
        let negative = bytes.first().is_some_and(|byte| byte & 0x80 != 0);
        let begin = if negative { -1i64 } else { 0 };
        bytes.iter().fold(begin, |value, byte| value << 8 | i64::from(*byte))
    };
    match kind {
        1..=6 => Value::Integer(integer()),
        7 => Value::Real(f64::from_bits(integer() as u64)),
        8 => Value::Integer(0),
        9 => Value::Integer(1),
        12.. if kind % 2 == 0 => Value::Blob(bytes.to_vec()),
        13.. => Value::Text(String::from_utf8_lossy(bytes).into_owned()),
        _ => Value::Null,
    }
}

/// The columns of a table by the text that made it: `CREATE TABLE name(first TYPE, second TYPE …)`.
pub fn columns_of(sql: &str) -> Vec<String> {
    let inside = sql.split_once('(').map_or("", |(_, inside)| inside);
    let (mut depth, mut columns, mut column) = (0, Vec::new(), String::new());
    for letter in inside.chars() {
        match letter {
            '(' => depth += 1,
            ')' => depth -= 1,
            ',' if depth == 0 => columns.push(std::mem::take(&mut column)),
            _ => column.push(letter),
        }
        if depth < 0 {
            break;
        }
    }
    columns.push(column);
    let quotes = ['"', '`', '[', ']', '\''];
    let name = |column: String| {
        let name = column.split_whitespace().next().unwrap_or_default();
        name.trim_matches(quotes).to_string()
    };
    columns.into_iter().map(name).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_any_length_are_read() {
        for (mut bytes, expected) in [
            (&[0x07][..], Some(7)),
            (&[0x81, 0x00], Some(128)),
            (&[0xff; 9], Some(-1)),
            (&[0x80], None),
            (&[], None),
        ] {
            assert_eq!(varint(&mut bytes), expected);
        }
    }

    #[test]
    fn rows_have_values_of_every_type() {
        let row = [
            &[8, 0, 1, 9, 2, 18, 15, 7][..],
            &[0xfe],
            &[0x01, 0x00],
            &[1, 2, 3],
            b"a",
            &1.5f64.to_be_bytes(),
        ]
        .concat();
        let expected = [
            Value::Null,
            Value::Integer(-2),
            Value::Integer(1),
            Value::Integer(256),
            Value::Blob(vec![1, 2, 3]),
            Value::Text("a".into()),
            Value::Real(1.5),
        ];
        assert_eq!(values(&row, row.len()).unwrap(), expected);
        let some = values(&row[..12], row.len()).unwrap();
        assert_eq!(some[..4], expected[..4]);
        assert_eq!(some[4..], [Value::Elsewhere, Value::Elsewhere, Value::Elsewhere]);
        assert!(values(&row, row.len() - 1).is_err());
        assert!(values(&[9, 0], 2).is_err() && values(&[], 0).is_err());
    }

    #[test]
    fn columns_are_the_first_words() {
        let sql = "CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL, \"timestamp\" DECIMAL(10,5), data BLOB)";
        assert_eq!(columns_of(sql), ["id", "topic_id", "timestamp", "data"]);
    }
}

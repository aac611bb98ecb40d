//! The head of a PCD file.

/// How the points are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Data {
    /// A point a line.
    Ascii,
    /// Point after point.
    Binary,
    /// Field after field, in LZF.
    Compressed,
}

/// The head of a file.
pub struct Head {
    /// In their order.
    pub fields: Vec<Field>,
    /// How many there are.
    pub points: usize,
    /// Bytes of a point.
    pub point_size: usize,
    /// How they are written.
    pub data: Data,
}

/// A field of the points.
pub struct Field {
    /// As the head has it.
    pub name: String,
    /// Bytes of a number.
    pub size: usize,
    /// `I`, `U` or `F`; `?` for what PCD does not have.
    pub kind: char,
    /// Numbers of a point.
    pub count: usize,
    /// Bytes of a point before it.
    pub before: usize,
    /// Numbers of a point before it.
    pub numbers_before: usize,
}

impl Field {
    /// As [`realo_logs::intensity_scale`] names types; none that PCD does not have.
    pub fn type_name(&self) -> Option<&'static str> {
        Some(match (self.kind, self.size) {
            ('I', 1) => "int8",
            ('U', 1) => "uint8",
            ('I', 2) => "int16",
            ('U', 2) => "uint16",
            ('I', 4) => "int32",
            ('U', 4) => "uint32",
            ('I', 8) => "int64",
            ('U', 8) => "uint64",
            ('F', 4) => "float32",
            ('F', 8) => "float64",
            _ => return None,
        })
    }
}

impl Head {
    /// Parses the lines of a head.
    pub fn parse(text: &str) -> Result<Self, String> {
        let lines = Lines(text);
        let (fields, point_size) = fields(&lines)?;
        Ok(Head {
            points: points(&lines)?,
            fields,
            point_size,
            data: data(&lines)?,
        })
    }
}

/// The lines of a head, each a key and its words.
struct Lines<'a>(&'a str);

impl<'a> Lines<'a> {
    fn has(&self, key: &str) -> bool {
        self.words(key).is_ok()
    }

    fn words(&self, key: &str) -> Result<Vec<&'a str>, String> {
        let mut lines = self.0.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
        lines
            .find(|words| words.first() == Some(&key))
            .map(|words| words[1..].to_vec())
            .ok_or_else(|| format!("the PCD head has no line `{key}`"))
    }

    /// The numbers of a line.
    fn numbers(&self, key: &str) -> Result<Vec<usize>, String> {
        self.words(key)?.into_iter().map(|text| number(key, text)).collect()
    }

    /// The first number of a line.
    fn number(&self, key: &str) -> Result<usize, String> {
        number(key, self.words(key)?.first().copied().unwrap_or_default())
    }
}

fn number(key: &str, text: &str) -> Result<usize, String> {
    text.parse()
        .map_err(|_| format!("{key}: expected a number, found `{}`", crate::shown(text)))
}

/// How many points there are; some heads leave out POINTS, or WIDTH and HEIGHT.
fn points(lines: &Lines) -> Result<usize, String> {
    let size = || Ok::<_, String>([lines.number("WIDTH")?, lines.number("HEIGHT")?]);
    if !lines.has("POINTS") {
        let [width, height] = size()?;
        return width
            .checked_mul(height)
            .ok_or_else(|| format!("WIDTH, HEIGHT: expected less than 2 GiB of points, found {width} × {height}"));
    }
    let points = lines.number("POINTS")?;
    if lines.has("WIDTH") && lines.has("HEIGHT") {
        let [width, height] = size()?;
        if width.checked_mul(height) != Some(points) {
            return Err(format!(
                "POINTS: expected WIDTH {width} × HEIGHT {height}, found {points}; write the head anew"
            ));
        }
    }
    Ok(points)
}

/// The fields, and the bytes of a point.
fn fields(lines: &Lines) -> Result<(Vec<Field>, usize), String> {
    let (names, sizes, kinds) = (lines.words("FIELDS")?, lines.numbers("SIZE")?, lines.words("TYPE")?);
    let counts = match lines.has("COUNT") {
        true => lines.numbers("COUNT")?,
        false => vec![1; names.len()],
    };
    if [sizes.len(), kinds.len(), counts.len()] != [names.len(); 3] {
        return Err(format!(
            "{} FIELDS, {} SIZE, {} TYPE, {} COUNT: expected as many of each",
            names.len(),
            sizes.len(),
            kinds.len(),
            counts.len()
        ));
    }
    if let Some(size) = sizes.iter().find(|size| !matches!(size, 1 | 2 | 4 | 8)) {
        return Err(format!("SIZE: expected 1, 2, 4 or 8 for every field, found {size}"));
    }
    let (mut fields, mut before, mut numbers_before) = (Vec::new(), 0, 0);
    for (((name, size), kind), count) in names.into_iter().zip(sizes).zip(kinds).zip(counts) {
        if !(1..=MOST_COUNT).contains(&count) {
            return Err(format!(
                "COUNT: expected 1 to {MOST_COUNT} for every field, found {count} of `{name}`"
            ));
        }
        fields.push(Field {
            name: name.into(),
            size,
            kind: kind.chars().next().filter(|_| kind.len() == 1).unwrap_or('?'),
            count,
            before,
            numbers_before,
        });
        before += size * count;
        numbers_before += count;
    }
    Ok((fields, before))
}

fn data(lines: &Lines) -> Result<Data, String> {
    match lines.words("DATA")?.first().copied() {
        Some("ascii") => Ok(Data::Ascii),
        Some("binary") => Ok(Data::Binary),
        Some("binary_compressed") => Ok(Data::Compressed),
        other => Err(format!(
            "DATA: expected ascii, binary or binary_compressed, found `{}`; save the cloud as one of these",
            other.unwrap_or_default()
        )),
    }
}

/// Numbers of a field in a point, at most; histograms of features have some hundreds.
const MOST_COUNT: usize = 4096;

/// Lines of a head, at most: it has a dozen, and comments.
const MOST_LINES: usize = 1024;

/// The head of a file and the bytes after it.
pub fn split_head(bytes: &[u8]) -> Result<(&str, &[u8]), String> {
    let mut at = 0;
    for line in bytes.split_inclusive(|byte| *byte == b'\n').take(MOST_LINES) {
        at += line.len();
        if line.trim_ascii_start().starts_with(b"DATA") {
            let head = std::str::from_utf8(&bytes[..at]).map_err(|_| "the PCD head is not text".to_string())?;
            return Ok((head.trim_start_matches('\u{feff}'), &bytes[at..]));
        }
    }
    Err("expected a PCD file, found no line `DATA`".into())
}

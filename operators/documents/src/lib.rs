//! Files that people write, graphs, modules, profiles and protocols: read so that none, whatever is in it, takes the
//! program much time or memory.

use std::cell::Cell;
use std::fmt;
use std::io::{Error, ErrorKind, Read};
use std::path::Path;

use serde::de::{self, DeserializeOwned, DeserializeSeed, Deserializer, EnumAccess, MapAccess, SeqAccess};
use serde::de::{VariantAccess, Visitor};

/// Bytes of the longest file; dora's limit for a module.
pub const MAX_BYTES: u64 = 1 << 20;
/// Brackets that a YAML document opens at most: the parser's time grows with the square of those that stay open.
const MAX_BRACKETS: usize = 10_000;
/// What the aliases of a document may make of it, as a multiple of its length, and what is free.
const ALIASED: (usize, usize) = (4, 1 << 16);
/// Characters of what was found that a message repeats.
const SHOWN: usize = 200;

/// The text of a file.
///
/// # Errors
/// What the system says; more than [`MAX_BYTES`]; bytes that are not UTF-8.
pub fn read(file: &Path) -> Result<String, Error> {
    let mut bytes = Vec::new();
    std::fs::File::open(file)?.take(MAX_BYTES + 1).read_to_end(&mut bytes)?;
    let wrong = |reason: String| Error::new(ErrorKind::InvalidData, reason);
    if bytes.len() as u64 > MAX_BYTES {
        return Err(wrong(format!(
            "expected at most {MAX_BYTES} bytes, found more; is it the right file?"
        )));
    }
    String::from_utf8(bytes).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        wrong(format!(
            "expected UTF-8, found something else at byte {at}; save the file as UTF-8"
        ))
    })
}

/// A YAML document as a value of this type.
///
/// # Errors
/// What the parser says, with line and column; a document that means much more than it holds.
pub fn yaml<T: DeserializeOwned>(text: &str) -> Result<T, String> {
    let brackets = text.bytes().filter(|byte| b"[{".contains(byte)).count();
    if brackets > MAX_BRACKETS {
        return Err(format!(
            "expected at most {MAX_BRACKETS} brackets (`[` and `{{`), found {brackets}; write lists as lines that begin with `-`"
        ));
    }
    if text.contains('*') {
        weigh(text)?;
    }
    serde_yaml::from_str(text).map_err(|error| shown(&error.to_string()))
}

/// No heading is larger, rad: a turn, one more for headings that run on over a turn, and what rounding adds.
const MAX_TURN_RAD: f64 = 2.0 * std::f64::consts::TAU + 1e-3;
/// What is not larger may be a heading in degrees.
const MAX_DEGREES: f64 = 720.0;

/// An angle that should be in radians.
///
/// # Errors
/// One beyond two turns, which was most likely written in degrees.
pub fn in_radians(angle: f64) -> Result<f64, String> {
    if angle.abs() <= MAX_TURN_RAD {
        return Ok(angle);
    }
    let looks = match angle.abs() <= MAX_DEGREES {
        true => format!(", which looks like degrees: {angle}° are {:.4} rad", angle.to_radians()),
        false => String::new(),
    };
    Err(format!("expected radians within ±4π, found {angle}{looks}"))
}

/// A text as messages repeat it: its head, if it is long.
pub fn shown(text: &str) -> String {
    head(text, SHOWN)
}

/// At most so many characters of a text, and how long it is if they are not all.
pub fn head(text: &str, characters: usize) -> String {
    match text.char_indices().nth(characters) {
        Some((end, _)) => format!("{}… ({} bytes)", &text[..end], text.len()),
        None => text.into(),
    }
}

/// Refuses a document that its aliases make much longer.
fn weigh(text: &str) -> Result<(), String> {
    let (times, free) = ALIASED;
    let most = free + times * text.len();
    let left = Cell::new(Some(most));
    let document = serde_yaml::Deserializer::from_str(text);
    // Any other error is found again, and reported better, by whoever reads the document.
    let _ = Weight(&left).deserialize(document);
    match left.get() {
        Some(_) => Ok(()),
        None => Err(format!(
            "its aliases (`*name`) make more than {most} bytes of its {}; write out what they stand for, or use fewer",
            text.len()
        )),
    }
}

/// Takes the weight of all values away from what is left; nothing is left of it where it does not suffice.
#[derive(Clone, Copy)]
struct Weight<'a>(&'a Cell<Option<usize>>);

impl Weight<'_> {
    fn take<E: de::Error>(self, bytes: usize) -> Result<(), E> {
        let left = self.0.get().and_then(|left| left.checked_sub(1 + bytes));
        self.0.set(left);
        left.map(|_| ()).ok_or_else(|| E::custom("too much"))
    }
}

impl<'de> DeserializeSeed<'de> for Weight<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, value: D) -> Result<(), D::Error> {
        value.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Weight<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("anything")
    }

    fn visit_bool<E: de::Error>(self, _: bool) -> Result<(), E> {
        self.take(0)
    }

    fn visit_i64<E: de::Error>(self, _: i64) -> Result<(), E> {
        self.take(0)
    }

    fn visit_u64<E: de::Error>(self, _: u64) -> Result<(), E> {
        self.take(0)
    }

    fn visit_i128<E: de::Error>(self, _: i128) -> Result<(), E> {
        self.take(0)
    }

    fn visit_u128<E: de::Error>(self, _: u128) -> Result<(), E> {
        self.take(0)
    }

    fn visit_f64<E: de::Error>(self, _: f64) -> Result<(), E> {
        self.take(0)
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<(), E> {
        self.take(text.len())
    }

    fn visit_unit<E: de::Error>(self) -> Result<(), E> {
        self.take(0)
    }

    fn visit_none<E: de::Error>(self) -> Result<(), E> {
        self.take(0)
    }

    fn visit_some<D: Deserializer<'de>>(self, value: D) -> Result<(), D::Error> {
        self.deserialize(value)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<(), A::Error> {
        self.take(0)?;
        while list.next_element_seed(self)?.is_some() {}
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        self.take(0)?;
        while map.next_key_seed(self)?.is_some() {
            map.next_value_seed(self)?;
        }
        Ok(())
    }

    fn visit_enum<A: EnumAccess<'de>>(self, tagged: A) -> Result<(), A::Error> {
        let (tag, value) = tagged.variant::<String>()?;
        self.take(tag.len())?;
        value.newtype_variant_seed(self)
    }
}

#[cfg(test)]
mod tests {
    use serde_yaml::Value;

    use super::*;

    #[test]
    fn an_angle_beyond_a_turn_is_refused_and_one_in_degrees_is_said() {
        for angle in [0.0, -3.2, 6.3, -12.5] {
            assert_eq!(in_radians(angle), Ok(angle));
        }
        let degrees = in_radians(-90.0).unwrap_err();
        assert_eq!(
            degrees,
            "expected radians within ±4π, found -90, which looks like degrees: -90° are -1.5708 rad"
        );
        for angle in [1e4, f64::NAN, f64::INFINITY] {
            let error = in_radians(angle).unwrap_err();
            assert!(error.contains("within ±4π") && !error.contains("degrees"), "{error}");
        }
    }

    #[test]
    fn a_document_that_means_much_more_than_it_holds_is_refused() {
        let fine = "common: &env { A: 1, B: two }\nnodes: [{ env: *env }, { env: *env }, !tag { A: *env } ]";
        assert_eq!(yaml::<Value>(fine).unwrap()["nodes"][1]["env"]["B"], "two");
        // One long list that is named often, and lists of lists of lists.
        let long = format!("a: &a [{}]\nb: [{}]", "x,".repeat(5000), "*a,".repeat(5000));
        let mut laughs = "a0: &a0 [x, x]\n".to_string();
        (1..60).for_each(|k| laughs.push_str(&format!("a{k}: &a{k} [*a{0}, *a{0}]\n", k - 1)));
        let text = format!("a: &a {}\nb: [{}]", "x".repeat(5000), "*a,".repeat(5000));
        for text in [long, laughs, text] {
            let error = yaml::<Value>(&text).unwrap_err();
            assert!(error.contains("aliases") && error.contains("write out"), "{error}");
        }
    }

    #[test]
    fn what_nests_too_deep_is_refused() {
        for opening in ["[", "{a: ", "- ", "? ", "&a [", "!a {"] {
            for times in [1000, 9_999, 200_000] {
                let error = yaml::<Value>(&opening.repeat(times)).unwrap_err();
                assert!(error.len() < 400, "{error}");
                let brackets = opening.contains(['[', '{']) && times > MAX_BRACKETS;
                assert_eq!(error.contains("`[` and `{`"), brackets, "{error}");
            }
        }
    }

    #[test]
    fn says_what_a_file_holds_that_is_no_text() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.yml");
        std::fs::write(&file, b"abc\xff").unwrap();
        assert!(
            read(&file)
                .unwrap_err()
                .to_string()
                .contains("UTF-8, found something else at byte 3")
        );
        std::fs::write(&file, vec![b'#'; MAX_BYTES as usize + 1]).unwrap();
        assert!(read(&file).unwrap_err().to_string().contains("at most 1048576 bytes"));
        assert_eq!(shown(&"ä".repeat(300)), format!("{}… (600 bytes)", "ä".repeat(200)));
    }
}

//! Tracks of any text: whole numbers stay what they are, other text becomes a number above 2⁶³ that is the same in every log.

use std::collections::HashMap;

/// Numbers of tracks that are not whole numbers have this bit.
const TEXT: u64 = 1 << 63;

/// The track that an `id` names; `None` without text. `7`, `007` and pandas' `7.0` are the number 7; any other text, also a
/// negative number, a fraction or one beyond 64 bits, is a hash of the text.
pub fn track_of(id: &str) -> Option<u64> {
    let id = id.trim();
    match id {
        "" => None,
        _ => Some(whole(id).unwrap_or_else(|| hash(id))),
    }
}

/// A whole number from 0, also one that a table turned into a float.
fn whole(id: &str) -> Option<u64> {
    let digits = match id.split_once('.') {
        Some((digits, zeros)) if !zeros.is_empty() && zeros.bytes().all(|byte| byte == b'0') => digits,
        Some(_) => return None,
        None => id,
    };
    let plain = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    plain.then(|| digits.parse().ok()).flatten()
}

/// FNV-1a of 64 bits, mixed as splitmix64 does, so that texts that differ in their last letter differ in all bits.
fn hash(text: &str) -> u64 {
    let fnv = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    let mut mixed = text.bytes().fold(0xcbf2_9ce4_8422_2325, fnv);
    mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (mixed ^ (mixed >> 31)) | TEXT
}

/// The texts of a log's tracks that are not plain numbers, so that two of one number are refused.
#[derive(Debug, Default)]
pub(crate) struct Tracks(HashMap<u64, Box<str>>);

impl Tracks {
    /// The track that an `id` names.
    ///
    /// # Errors
    /// Another text of this log has the same number.
    pub fn track(&mut self, id: &str) -> Result<Option<u64>, String> {
        let Some(track) = track_of(id) else { return Ok(None) };
        if track & TEXT == 0 {
            return Ok(Some(track));
        }
        let id = id.trim();
        match self.0.get(&track) {
            Some(known) if **known != *id => Err(format!(
                "the tracks `{known}` and `{id}` have the same number {track}; rename one of them"
            )),
            Some(_) => Ok(Some(track)),
            None => {
                self.0.insert(track, id.into());
                Ok(Some(track))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn whole_numbers_stay_themselves() {
        for (id, expected) in [
            ("7", 7),
            ("007", 7),
            ("7.0", 7),
            ("7.000", 7),
            (" 7 ", 7),
            ("0", 0),
            ("18446744073709551615", u64::MAX),
        ] {
            assert_eq!(track_of(id), Some(expected), "{id}");
        }
        assert_eq!((track_of(""), track_of("  ")), (None, None));
    }

    #[test]
    fn any_other_text_is_a_track_of_its_own() {
        let texts = [
            "obj00a7f3c9",
            "obj01a7f3c9",
            "0000-123",
            "0001-123",
            "-1",
            "-2",
            "1.5",
            "1.",
            ".0",
            "+1",
            "1e3",
            "18446744073709551616",
            "99999999999999999999999999",
            "nan",
            "é",
            "6b29fc40-ca47-1067-b31d-00dd010662da",
        ];
        let tracks: BTreeSet<u64> = texts.iter().filter_map(|text| track_of(text)).collect();
        assert_eq!(tracks.len(), texts.len());
        assert!(tracks.iter().all(|track| track & TEXT != 0), "{tracks:?}");
        assert_eq!(track_of("-1"), track_of(" -1"));
    }

    #[test]
    fn two_texts_of_one_number_are_refused() {
        let mut tracks = Tracks::default();
        let token = tracks.track("obj00a7f3c9").unwrap().unwrap();
        assert_eq!(tracks.track("obj00a7f3c9"), Ok(Some(token)));
        assert_eq!(tracks.track("3"), Ok(Some(3)));
        let error = tracks.track(&token.to_string()).unwrap_err();
        assert!(
            error.contains("`obj00a7f3c9`") && error.contains("rename one"),
            "{error}"
        );
    }
}

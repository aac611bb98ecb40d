//! The part of a plan that one machine runs.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

/// `3/16`: the third of sixteen parts of about the same length. Neighbours in a plan are in one part, for they share work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// From 1.
    number: usize,
    of: usize,
}

/// A word that is no shard.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected NUMBER/COUNT with a number from 1 to the count, as 3/16, found `{0}`")]
pub struct ShardError(String);

impl Default for Shard {
    /// All.
    fn default() -> Self {
        Shard { number: 1, of: 1 }
    }
}

impl FromStr for Shard {
    type Err = ShardError;

    fn from_str(text: &str) -> Result<Self, ShardError> {
        let parts = text.split_once('/');
        let parsed = parts.and_then(|(number, of)| Some((number.parse().ok()?, of.parse().ok()?)));
        match parsed {
            Some((number, of)) if 1 <= number && number <= of => Ok(Shard { number, of }),
            _ => Err(ShardError(text.into())),
        }
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.of)
    }
}

impl Shard {
    /// Whether it is everything.
    pub fn is_all(self) -> bool {
        self.of == 1
    }

    /// The items of a plan of so many that it runs.
    pub fn items(self, all: usize) -> Range<usize> {
        let begin = |number: usize| (all as u128 * number as u128 / self.of as u128) as usize;
        begin(self.number - 1)..begin(self.number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_are_all_items_each_once() {
        for (all, of) in [(0, 1), (1, 16), (20, 3), (48, 16), (1000, 7)] {
            let items = (1..=of).flat_map(|number| Shard { number, of }.items(all));
            assert!(items.eq(0..all), "{all} items in {of}");
        }
        assert_eq!("3/16".parse::<Shard>().unwrap().items(32), 4..6);
        assert!(Shard::default().is_all() && Shard::default().items(5) == (0..5));
    }

    #[test]
    fn other_words_are_refused() {
        for text in ["", "3", "0/4", "5/4", "a/b", "1/0", "-1/4", "1/2/3"] {
            let error = text.parse::<Shard>().unwrap_err().to_string();
            assert!(
                error.contains("3/16") && error.contains(&format!("`{text}`")),
                "{error}"
            );
        }
        assert_eq!("3/16".parse::<Shard>().unwrap().to_string(), "3/16");
    }
}

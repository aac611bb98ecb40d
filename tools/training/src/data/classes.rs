//! Super-classes of objects, by the table of the evaluation protocol.

use serde::Deserialize;

/// The protocols' own files, so that training and evaluation can never disagree; only their classes are read here.
const PROTOCOLS: [(&str, &str); 2] = [
    (
        "default",
        include_str!("../../../../operators/evaluator/protocols/default.yml"),
    ),
    (
        "dair",
        include_str!("../../../../operators/evaluator/protocols/dair.yml"),
    ),
];

/// From raw names to super-classes.
#[derive(Clone, Debug, Deserialize)]
pub(crate) struct ClassTable {
    classes: Vec<SuperClass>,
    #[serde(default)]
    ignore_case: bool,
}

#[derive(Clone, Debug, Deserialize)]
struct SuperClass {
    name: String,
    raw: Vec<String>,
}

impl ClassTable {
    /// The table of a protocol; `None` if no protocol has the name.
    pub fn of(protocol: &str) -> Option<Self> {
        let (_, text) = PROTOCOLS.iter().find(|(name, _)| *name == protocol)?;
        Some(serde_yaml::from_str(text).expect("the protocols that ship hold classes"))
    }

    /// Names of the super-classes, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.classes.iter().map(|class| class.name.as_str())
    }

    /// Number of the super-class of a raw name; `None` if it does not count.
    pub fn class_of(&self, raw: &str) -> Option<usize> {
        let same = |known: &String| match self.ignore_case {
            true => known.eq_ignore_ascii_case(raw),
            false => known == raw,
        };
        let found = self.classes.iter().position(|class| class.raw.iter().any(same));
        found.or_else(|| self.classes.iter().position(|class| class.name == raw.to_lowercase()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_names_belong_where_the_protocol_says() {
        let table = ClassTable::of("default").unwrap();
        assert_eq!(table.names().collect::<Vec<_>>(), ["vehicle", "pedestrian", "truck"]);
        let cases = [
            ("Car", Some(0)),
            ("MotorcyleRider", Some(1)),
            ("Van", Some(2)),
            ("PEDESTRIAN", Some(1)),
            ("car", None),
            ("FireHydrant", None),
        ];
        for (raw, expected) in cases {
            assert_eq!(table.class_of(raw), expected, "{raw}");
        }
        assert_eq!(ClassTable::of("dair").unwrap().class_of("Bus"), Some(0));
        assert!(ClassTable::of("kitti").is_none());
    }
}

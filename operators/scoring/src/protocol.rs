use std::borrow::Cow;
use std::collections::BTreeSet;
use std::path::Path;

use realo_schemas::Box3;
use realo_schemas::geometry::Region;
use serde::{Deserialize, Serialize};

/// Protocols that have a name: the name and the file.
const NAMED: [(&str, &str); 4] = [
    ("default", include_str!("../protocols/default.yml")),
    ("dair", include_str!("../protocols/dair.yml")),
    ("dair-vehicle", include_str!("../protocols/dair-vehicle.yml")),
    ("dair-roadside", include_str!("../protocols/dair-roadside.yml")),
];

/// What counts as an object, what as found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Protocol {
    /// Names the protocol in results.
    pub name: String,
    /// Where objects and detections count, m in the ego's body frame.
    pub region: Region,
    /// What of a box must lie in the region.
    pub rule: Rule,
    /// Super-classes, in order of their number.
    pub classes: Vec<SuperClass>,
    /// Whether raw names are compared without regard to letter case.
    #[serde(default = "ignores_case")]
    pub ignore_case: bool,
    /// Smallest IoUs at which a detection is true.
    pub ious: Vec<f64>,
    /// Smallest points of all agents on an object, where they are known.
    pub min_points: u64,
    /// Smallest points of the ego on an object that counts as seen.
    pub seen_points: u64,
    /// Lower edges of range bins, m from the ego, ascending from 0; the last bin is open.
    pub range_edges: Vec<f64>,
    /// Lower edges of bins by the ego's own points on an object, ascending from 0; the last bin is open.
    #[serde(default = "point_edges")]
    pub point_edges: Vec<u64>,
    /// Which labels of the log are the truth.
    #[serde(default, skip_serializing_if = "is_default")]
    pub labels: Labels,
    /// What objects and detections are that no view of the labels shows. Without views everything counts.
    #[serde(default, skip_serializing_if = "is_default")]
    pub outside_views: OutsideViews,
    /// What the ego must be; `None`: anything.
    #[serde(default, skip_serializing_if = "is_default")]
    pub ego: Option<EgoKind>,
}

fn point_edges() -> Vec<u64> {
    vec![0, 10, 50]
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Which labels of a log are the truth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Labels {
    /// All that is known to be around the ego.
    #[default]
    All,
    /// What the ego's own side labelled by its own sensors.
    Own,
}

/// What becomes of objects and detections that no view of the labels shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutsideViews {
    /// They count as any other.
    #[default]
    Counted,
    /// They are ignored: such an object is neither missed nor found; such a detection is not false.
    Ignored,
}

/// What an ego is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EgoKind {
    /// It drives.
    Vehicle,
    /// It stands beside the road.
    Roadside,
}

/// What of a box must lie in the region.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// All four bottom corners.
    AllBottomCorners,
    /// The centre.
    Center,
}

/// A class of the table and the names that belong to it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SuperClass {
    /// Its name in results, in lower case.
    pub name: String,
    /// Names of truth and detections that belong to it.
    pub raw: Vec<String>,
}

/// Why a protocol cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ProtocolError {
    /// Neither a name nor a file.
    #[error("protocol `{name}` is neither one of {known} nor a file that can be read ({reason})")]
    Unknown {
        /// As it was asked for.
        name: String,
        /// The protocols that have a name.
        known: String,
        /// Why it could not be read as a file.
        reason: std::io::Error,
    },
    /// A file of another form.
    #[error("protocol `{name}`: {reason}")]
    Form {
        /// As it was asked for.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
}

fn ignores_case() -> bool {
    true
}

impl Protocol {
    /// The protocol of a name (`default`, `dair`, `dair-vehicle`, `dair-roadside`) or of a file.
    ///
    /// # Errors
    /// [`ProtocolError`] says what was expected.
    pub fn load(name: &str) -> Result<Self, ProtocolError> {
        match NAMED.iter().find(|(known, _)| *known == name) {
            Some((_, text)) => Protocol::parse(name, text),
            None => match realo_documents::read(Path::new(name)) {
                Ok(text) => Protocol::parse(name, &text),
                Err(reason) => {
                    let known = NAMED.map(|(known, _)| format!("`{known}`")).join(", ");
                    Err(ProtocolError::Unknown {
                        name: name.into(),
                        known,
                        reason,
                    })
                }
            },
        }
    }

    /// The protocol that a YAML document describes; `name` is for errors.
    ///
    /// # Errors
    /// [`ProtocolError::Form`] names the field and what was expected.
    pub fn parse(name: &str, text: &str) -> Result<Self, ProtocolError> {
        let form = |reason: String| ProtocolError::Form {
            name: name.into(),
            reason: realo_documents::shown(&reason),
        };
        let protocol: Protocol = realo_documents::yaml(text).map_err(form)?;
        protocol.check().map_err(form)?;
        Ok(protocol)
    }

    fn check(&self) -> Result<(), String> {
        self.region.checked()?;
        if self.classes.is_empty() || self.classes.len() > usize::from(u8::MAX) {
            return Err(format!(
                "`classes`: expected 1 to 255 super-classes, found {}",
                self.classes.len()
            ));
        }
        let mut names = BTreeSet::new();
        for class in &self.classes {
            if class.name.is_empty() || class.name != class.name.to_lowercase() {
                return Err(format!(
                    "`classes`: the super-class `{}` must be named in lower case",
                    class.name
                ));
            }
            let own = class.raw.iter().map(|raw| self.folded(raw).into_owned());
            for name in own.chain([format!("super-class {}", class.name)]) {
                if !names.insert(name.clone()) {
                    return Err(format!(
                        "`classes`: `{name}` appears twice; a name belongs to one super-class"
                    ));
                }
            }
        }
        if self.ious.is_empty() || !self.ious.iter().all(|iou| *iou > 0.0 && *iou <= 1.0) {
            return Err(format!("`ious`: expected numbers in (0, 1], found {:?}", self.ious));
        }
        if self.ious.windows(2).any(|pair| pair[0] >= pair[1]) {
            return Err(format!("`ious`: expected an ascending list, found {:?}", self.ious));
        }
        let ascending = self.range_edges.windows(2).all(|pair| pair[0] < pair[1]);
        if self.range_edges.first() != Some(&0.0) || !ascending || !self.range_edges.iter().all(|edge| edge.is_finite())
        {
            return Err(format!(
                "`range_edges`: expected an ascending list from 0, found {:?}",
                self.range_edges
            ));
        }
        let ascending = self.point_edges.windows(2).all(|pair| pair[0] < pair[1]);
        if self.point_edges.first() != Some(&0) || !ascending {
            return Err(format!(
                "`point_edges`: expected an ascending list from 0, found {:?}",
                self.point_edges
            ));
        }
        Ok(())
    }

    /// A raw name as names are compared.
    fn folded<'a>(&self, raw: &'a str) -> Cow<'a, str> {
        match self.ignore_case {
            true => raw.to_lowercase().into(),
            false => raw.into(),
        }
    }

    /// Number of the super-class that a name belongs to; `None` if the name does not count.
    pub fn class_of(&self, raw: &str) -> Option<u8> {
        let of = |same: &dyn Fn(&String) -> bool| self.classes.iter().position(|class| class.raw.iter().any(same));
        // Mostly a name is written as the protocol has it; then no letter case is compared.
        let found = of(&|known| known == raw).or_else(|| {
            let wanted = self.folded(raw);
            of(&|known| self.folded(known) == wanted)
        });
        let found = found.or_else(|| self.classes.iter().position(|class| class.name == raw.to_lowercase()));
        found.map(|index| index as u8)
    }

    /// Whether a box counts by its place.
    pub fn takes_in(&self, object: &Box3) -> bool {
        match self.rule {
            Rule::AllBottomCorners => self.region.contains_box(object),
            Rule::Center => self.region.contains([object.center[0], object.center[1]]),
        }
    }

    /// The range bin of a place, by its distance from the ego.
    pub(crate) fn range_bin(&self, [x, y]: [f64; 2]) -> usize {
        let range = libm::hypot(x, y);
        self.range_edges.iter().rposition(|edge| range >= *edge).unwrap_or(0)
    }

    /// The bin of an object by the ego's own points on it.
    pub(crate) fn point_bin(&self, points: u64) -> usize {
        self.point_edges.iter().rposition(|edge| points >= *edge).unwrap_or(0)
    }

    /// An IoU as results name it.
    pub fn iou_key(iou: f64) -> String {
        iou.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_the_names_of_v2x_real() {
        let protocol = Protocol::load("default").unwrap();
        let class = |raw: &str| {
            protocol
                .class_of(raw)
                .map(|index| protocol.classes[usize::from(index)].name.as_str())
        };
        assert_eq!(class("PoliceCar"), Some("vehicle"));
        assert_eq!(class("MotorcyleRider"), Some("pedestrian"));
        assert_eq!(class("Van"), Some("truck"));
        assert_eq!(class("VEHICLE"), Some("vehicle"));
        assert_eq!(class("policecar"), Some("vehicle"));
        assert_eq!(class("FireHydrant"), None);
    }

    #[test]
    fn maps_the_names_of_dair_in_any_case() {
        let protocol = Protocol::load("dair").unwrap();
        for name in ["Car", "car", "VAN", "truck", "Bus", "Vehicle"] {
            assert_eq!(protocol.class_of(name), Some(0), "{name}");
        }
        assert_eq!(protocol.class_of("Cyclist"), None);
        let mut more = protocol;
        more.classes[0].raw.push("Überlandbus".into());
        assert_eq!(more.class_of("ÜBERLANDBUS"), Some(0));
    }

    #[test]
    fn protocols_of_dair_differ_in_data_only() {
        let load = |name| Protocol::load(name).unwrap();
        let dair = load("dair");
        assert_eq!(
            (dair.labels, dair.outside_views, dair.ego),
            (Labels::All, OutsideViews::Ignored, None)
        );
        for (name, ego) in [("dair-vehicle", EgoKind::Vehicle), ("dair-roadside", EgoKind::Roadside)] {
            let expected = Protocol {
                name: name.into(),
                labels: Labels::Own,
                ego: Some(ego),
                ..dair.clone()
            };
            assert_eq!(load(name), expected);
        }
        // What is left out of a protocol is left out of results.
        let plain = serde_json::to_value(load("default")).unwrap();
        for key in ["labels", "outside_views", "ego"] {
            assert!(plain.get(key).is_none(), "{key}");
        }
    }

    #[test]
    fn says_what_is_wrong_with_a_protocol() {
        let error = Protocol::load("kitti").unwrap_err().to_string();
        assert!(
            error.contains("`kitti`") && error.contains("`default`, `dair`, `dair-vehicle`"),
            "{error}"
        );
        let good = NAMED[0].1;
        let cases = [
            ("ious: [0.3, 0.5]", "ious: [0.5, 0.3]", "`ious`"),
            ("ious: [0.3, 0.5]", "ious: [0]", "`ious`"),
            ("x: [-100, 100]", "x: [100, -100]", "region's x"),
            ("name: vehicle", "name: Vehicle", "lower case"),
            ("PoliceCar", "Van", "`van` appears twice"),
            ("min_points", "min_point", "min_point"),
            ("range_edges: [0,", "range_edges: [5,", "`range_edges`"),
            ("range_edges: [0,", "range_edges: [0, 0,", "`range_edges`"),
            ("all_bottom_corners\n", "most\n", "most"),
            ("min_points", "labels: others\nmin_points", "expected `all` or `own`"),
            (
                "min_points",
                "outside_views: dropped\nmin_points",
                "expected `counted` or `ignored`",
            ),
            ("min_points", "ego: bus\nmin_points", "expected `vehicle` or `roadside`"),
        ];
        for (from, to, expected) in cases {
            assert!(good.contains(from), "{from}");
            let error = Protocol::parse("mine.yml", &good.replacen(from, to, 1))
                .unwrap_err()
                .to_string();
            assert!(error.contains("mine.yml") && error.contains(expected), "{error}");
        }
    }

    #[test]
    fn a_protocol_has_at_most_255_super_classes() {
        let sound = Protocol::load("default").unwrap();
        for (number, taken) in [(1, true), (255, true), (256, false)] {
            let named = |number| SuperClass {
                name: format!("class{number}"),
                ..sound.classes[0].clone()
            };
            let mut classes: Vec<SuperClass> = (0..number).map(named).collect();
            classes.iter_mut().for_each(|class| class.raw.clear());
            let protocol = Protocol {
                classes,
                ..sound.clone()
            };
            assert_eq!(protocol.check().is_ok(), taken, "{number}");
        }
    }

    #[test]
    fn range_bins_are_open_at_the_end() {
        let protocol = Protocol::load("default").unwrap();
        for (place, bin) in [
            ([0.0, 0.0], 0),
            ([29.9, 0.0], 0),
            ([0.0, 30.0], 1),
            ([-50.0, 0.0], 2),
            ([900.0, 0.0], 2),
        ] {
            assert_eq!(protocol.range_bin(place), bin);
        }
    }
}

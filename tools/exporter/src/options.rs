//! How a log is exported: one table of options for all kinds.

use realo_transmission::cpm::Geodetic;

/// An option of the command line.
#[derive(Clone, Copy, Debug)]
pub struct OptionInfo {
    /// Its name, without dashes.
    pub name: &'static str,
    /// What it takes, in capitals.
    pub value: &'static str,
    /// The only values that it takes; empty where any may do.
    pub choices: &'static [&'static str],
    /// What it does.
    pub help: &'static str,
}

/// All options; each kind takes some of them.
pub const OPTIONS: &[OptionInfo] = &[
    OptionInfo {
        name: "agent",
        value: "NAME",
        choices: &[],
        help: "The agent that is written [default: the only one of the log]",
    },
    OptionInfo {
        name: "agents",
        value: "NAMES",
        choices: &[],
        help: "Only these agents, with commas between [default: all]",
    },
    OptionInfo {
        name: "classes",
        value: "NAMES",
        choices: &[],
        help: "Only objects of these classes, with commas between, letter case ignored [default: all]",
    },
    OptionInfo {
        name: "labels",
        value: "SOURCE",
        choices: &["truth", "own"],
        help: "Which boxes are an agent's labels: all objects, or what its own side labelled",
    },
    OptionInfo {
        name: "motion",
        value: "WHAT",
        choices: &["removed", "kept"],
        help: "Whether points are moved to where they are at the stamp, by the agent's motion during the sweep: the layout has no times \
               of points",
    },
    OptionInfo {
        name: "height",
        value: "M",
        choices: &[],
        help: "Height of all LiDARs over the ground, m [default: what the log says of each, else 1.8]",
    },
    OptionInfo {
        name: "boxes",
        value: "SOURCE",
        choices: &["detections", "truth", "own", "fused"],
        help: "Which boxes are written: what each agent detected, all objects, what its own side labelled, or of a run the final boxes \
               of its ego",
    },
    OptionInfo {
        name: "origin",
        value: "LAT,LON[,M]",
        choices: &[],
        help: "Where the map's origin is on the Earth, degrees and m over the ellipsoid (WGS 84) [default: what the log says]",
    },
    OptionInfo {
        name: "roadside",
        value: "NAMES",
        choices: &[],
        help: "Agents that are roadside units, with commas between, besides those of the log; recordings do not say it",
    },
    OptionInfo {
        name: "unfit",
        value: "WHAT",
        choices: &["refuse", "drop"],
        help: "What becomes of objects that a message has no numbers or no room for",
    },
];

/// An option by its name.
pub fn option_info(name: &str) -> Option<&'static OptionInfo> {
    OPTIONS.iter().find(|option| option.name == name)
}

/// Which boxes are an agent's labels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LabelSource {
    /// Its ground truth: all objects.
    #[default]
    Truth,
    /// What its own side labelled.
    Own,
}

/// Which boxes are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BoxSource {
    /// What each agent detected.
    #[default]
    Detections,
    /// All objects.
    Truth,
    /// What an agent's own side labelled.
    Own,
    /// The final boxes of a run's ego.
    Fused,
}

impl BoxSource {
    /// The part of their topic behind the agent's name.
    pub fn topic(self) -> &'static str {
        match self {
            BoxSource::Detections => "detections",
            BoxSource::Truth => "ground_truth",
            BoxSource::Own => "own_labels",
            BoxSource::Fused => "boxes",
        }
    }
}

/// How a log is exported.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Options {
    /// Agents that are wanted; all where empty.
    pub agents: Vec<String>,
    /// Classes that are wanted, in small letters; all where empty.
    pub classes: Vec<String>,
    /// Which boxes are labels.
    pub labels: LabelSource,
    /// Whether points stay as they were measured while the agent moved; else they are where they are at the stamp.
    pub keeps_motion: bool,
    /// Height of all LiDARs over the ground, m; what the log says of each where `None`.
    pub height_m: Option<f64>,
    /// Which boxes are written.
    pub boxes: BoxSource,
    /// Where the map's origin is on the Earth; what the log says where `None`.
    pub origin: Option<Geodetic>,
    /// Agents that are roadside units, besides those of the log.
    pub roadside: Vec<String>,
    /// Whether objects that do not fit a message are left out; else they end the export.
    pub drops_unfit: bool,
}

/// No LiDAR is higher, m, as importers take it.
const MOST_HEIGHT: f64 = 50.0;

impl Options {
    /// Sets an option from its text.
    ///
    /// # Errors
    /// What was expected and what was found; an option that does not exist.
    pub fn set(&mut self, name: &str, text: &str) -> Result<(), String> {
        let text = text.trim();
        let expected = |what: &str| {
            let found: String = text.chars().take(40).collect::<String>().escape_debug().collect();
            format!("--{name}: expected {what}, found `{found}`")
        };
        let list = || {
            let words = text.split(',').map(str::trim).filter(|word| !word.is_empty());
            let words: Vec<String> = words.map(String::from).collect();
            match words.is_empty() {
                true => Err(expected("names")),
                false => Ok(words),
            }
        };
        match (name, text) {
            ("agent", "") => return Err(expected("the name of an agent")),
            ("agent", name) => self.agents = vec![name.into()],
            ("agents", _) => self.agents = list()?,
            ("classes", _) => self.classes = list()?.iter().map(|class| class.to_lowercase()).collect(),
            ("labels", "truth") => self.labels = LabelSource::Truth,
            ("labels", "own") => self.labels = LabelSource::Own,
            ("motion", "removed") => self.keeps_motion = false,
            ("motion", "kept") => self.keeps_motion = true,
            ("motion", _) => return Err(expected("removed or kept")),
            ("labels", _) => return Err(expected("truth or own")),
            ("height", text) => {
                let height = text.parse().ok().filter(|height| (0.0..=MOST_HEIGHT).contains(height));
                self.height_m = Some(height.ok_or_else(|| expected(&format!("0 to {MOST_HEIGHT} m")))?);
            }
            ("boxes", text) => self.boxes = boxes(text).ok_or_else(|| expected("detections, truth, own or fused"))?,
            ("origin", text) => {
                let origin = Geodetic::try_from(text.to_string());
                let what = "latitude within ±90°, longitude within ±180° and height, as 48.1374,11.5755,519";
                self.origin = Some(origin.map_err(|_| expected(what))?);
            }
            ("roadside", _) => self.roadside = list()?,
            ("unfit", "refuse") => self.drops_unfit = false,
            ("unfit", "drop") => self.drops_unfit = true,
            ("unfit", _) => return Err(expected("refuse or drop")),
            _ => return Err(format!("--{name}: no export has this option")),
        }
        Ok(())
    }

    /// Whether an agent is wanted.
    pub(crate) fn wants_agent(&self, name: &str) -> bool {
        self.agents.is_empty() || self.agents.iter().any(|wanted| wanted == name)
    }

    /// Whether objects of a class are wanted.
    pub(crate) fn wants_class(&self, class: &str) -> bool {
        self.classes.is_empty() || self.classes.contains(&class.to_lowercase())
    }
}

fn boxes(text: &str) -> Option<BoxSource> {
    use BoxSource::{Detections, Fused, Own, Truth};
    let named = ["detections", "truth", "own", "fused"]
        .into_iter()
        .zip([Detections, Truth, Own, Fused]);
    named
        .into_iter()
        .find(|(name, _)| *name == text)
        .map(|(_, source)| source)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_can_be_set_and_refuses_what_it_does_not_take() {
        for info in OPTIONS {
            let mut options = Options::default();
            let (fine, wrong) = match info.name {
                "height" => ("1.9", "high"),
                "labels" => ("own", "all"),
                "motion" => ("kept", "some"),
                "boxes" => ("fused", "all"),
                "origin" => ("48.1374,11.5755,519", "Munich"),
                "unfit" => ("drop", "keep"),
                _ => ("cav1", ""),
            };
            options.set(info.name, fine).unwrap();
            assert_ne!(options, Options::default());
            let error = options.set(info.name, wrong).unwrap_err();
            assert!(error.contains(info.name) && error.contains("expected"), "{error}");
        }
        assert!(Options::default().set("colour", "red").is_err());
    }

    #[test]
    fn classes_are_chosen_whatever_their_case() {
        let mut options = Options::default();
        assert!(options.wants_class("Car"));
        options.set("classes", "Car, truck").unwrap();
        assert!(options.wants_class("car") && options.wants_class("Truck") && !options.wants_class("Pedestrian"));
    }
}

//! How a log is exported: one table of options for all kinds.

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
            _ => return Err(format!("--{name}: no export has this option")),
        }
        Ok(())
    }

    /// Whether objects of a class are wanted.
    pub(crate) fn wants_class(&self, class: &str) -> bool {
        self.classes.is_empty() || self.classes.contains(&class.to_lowercase())
    }
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

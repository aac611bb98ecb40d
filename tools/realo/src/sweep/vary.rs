//! What is varied: settings of stages, of the links' profile, of the simulated world, and options of a run.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::str::FromStr;

use eyre::{Result, bail, eyre};
use realo_operator::config::{did_you_mean, nearest_name};
use realo_player::Coop;
use realo_stages::Project;

use crate::run::{self, PoseSource};

/// Begins the settings of the links' profile, and of the world.
const LINK: &str = "link.";
const WORLD: &str = "simulator.";
/// Options of a run that can be varied.
const OPTIONS: [&str; 9] = [
    "link",
    "protocol",
    "model",
    "project",
    "localization",
    "coop",
    "agents",
    "seed",
    "compute",
];
/// Joins words in one value.
const AND: char = '+';

/// A setting and its values: `others.sense.localization.position_noise_m=0,0.1,0.2`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Vary {
    /// The setting.
    pub name: String,
    /// Its values, as they are written.
    pub values: Vec<String>,
}

impl FromStr for Vary {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong =
            |reason: String| format!("`{text}`: {reason}; as others.sense.localization.position_noise_m=0,0.1,0.2");
        let (name, values) = text
            .split_once('=')
            .ok_or_else(|| wrong("expected SETTING=VALUE,VALUE…, found no `=`".into()))?;
        let values: Vec<String> = values.split(',').map(|value| value.trim().to_string()).collect();
        if values.iter().any(String::is_empty) {
            return Err(wrong("expected a value between commas, found nothing".into()));
        }
        if let Some((_, twice)) = values
            .iter()
            .enumerate()
            .find(|(at, value)| values[..*at].contains(value))
        {
            return Err(wrong(format!("the value {twice} is there twice")));
        }
        let name = name.trim().to_string();
        if !name.contains('.') && !OPTIONS.contains(&&*name) {
            let hint = did_you_mean(&nearest_name(&name, OPTIONS));
            return Err(wrong(format!(
                "expected STAGE.KEY, link.KEY, simulator.KEY or one of {}, found `{name}`{hint}",
                OPTIONS.join(", ")
            )));
        }
        Ok(Vary { name, values })
    }
}

impl Vary {
    /// The key of the world that it sets.
    pub fn world(&self) -> Option<&str> {
        self.name.strip_prefix(WORLD)
    }

    /// Whether it changes the links' profile.
    pub fn is_of_profile(&self) -> bool {
        self.name.starts_with(LINK)
    }
}

/// Refuses a setting that is there twice.
///
/// # Errors
/// Its name.
pub fn refuse_twice(all: &[Vary]) -> Result<()> {
    match all
        .iter()
        .enumerate()
        .find(|(at, vary)| all[..*at].iter().any(|other| other.name == vary.name))
    {
        Some((_, twice)) => bail!(
            "--vary {}: it is there twice: give all values behind one --vary",
            twice.name
        ),
        None => Ok(()),
    }
}

/// All combinations of the values, the last setting fastest.
pub fn combinations(all: &[Vary]) -> Vec<Vec<String>> {
    all.iter().fold(vec![Vec::new()], |made, vary| {
        let with = |before: &Vec<String>| {
            let before = before.clone();
            vary.values
                .iter()
                .map(move |value| [before.clone(), vec![value.clone()]].concat())
        };
        made.iter().flat_map(with).collect()
    })
}

/// Puts values into the options of a run; those of the world are not part of it. `profile`: what settings of the links change
/// where no option names it.
///
/// # Errors
/// A value that the option does not take.
pub fn apply(all: &[Vary], values: &[String], profile: &str, args: &mut run::Args) -> Result<()> {
    for (vary @ Vary { name, .. }, value) in all.iter().zip(values) {
        let choices = &mut args.choices;
        if name.starts_with(WORLD) {
            continue;
        }
        if let Some(key) = name.strip_prefix(LINK) {
            let base = choices.link.get_or_insert_with(|| profile.into());
            let comma = if base.is_empty() { "" } else { "," };
            base.push_str(&format!("{comma}{key}={value}"));
            continue;
        }
        match name.as_str() {
            "link" => choices.link = Some(value.clone()),
            "protocol" => args.protocol = Some(value.clone()),
            "model" => choices.model = Some(PathBuf::from(value)),
            "compute" => args.compute = Some(PathBuf::from(value)),
            "seed" => {
                let seed = value.parse();
                let seed =
                    seed.map_err(|_| eyre!("--vary seed={value}: expected a whole number from 0 on, found `{value}`"));
                choices.seed = Some(seed?);
            }
            "agents" => args.agents = value.split(AND).map(str::to_string).collect(),
            "project" => choices.project = Some(one_of(Project::ALL, name, value)?),
            "coop" => args.coop = Some(one_of(Coop::RESTRICTED, name, value)?),
            "localization" => {
                let source = one_of(PoseSource::ALL, name, value)?;
                choices.localization = Some(source);
                // One map serves all values; points that look at none are not asked for it.
                let others_look = vary.values.iter().any(|value| value == PoseSource::Map.name());
                if source != PoseSource::Map && others_look {
                    choices.map = None;
                }
            }
            _ => choices.set.push(format!("{name}={value}")),
        }
    }
    Ok(())
}

/// The one of this name.
///
/// # Errors
/// A name that none has, with the nearest.
fn one_of<T: Copy>(all: &[(T, &str, &str)], name: &str, value: &str) -> Result<T> {
    let names = || all.iter().map(|(_, name, _)| *name);
    match all.iter().find(|(_, name, _)| *name == value) {
        Some((found, ..)) => Ok(*found),
        None => bail!(
            "--vary {name}={value}: expected one of {}, found `{value}`{}",
            names().collect::<Vec<_>>().join(", "),
            did_you_mean(&nearest_name(value, names()))
        ),
    }
}

/// The settings of the world in a combination, with those of which a value joins several by `+`: they are one point.
pub fn world(all: &[Vary], values: &[String]) -> BTreeMap<String, Vec<String>> {
    let of_world = all
        .iter()
        .zip(values)
        .filter_map(|(vary, value)| Some((vary.world()?, value)));
    of_world
        .map(|(key, value)| (key.to_string(), value.split(AND).map(str::to_string).collect()))
        .collect()
}

/// A combination in words: `link.delay_ms=50, link.loss=0.1`.
pub fn in_words(all: &[Vary], values: &[String]) -> String {
    let words = all
        .iter()
        .zip(values)
        .map(|(vary, value)| format!("{}={value}", vary.name));
    words.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vary(text: &str) -> Vary {
        text.parse().unwrap()
    }

    #[test]
    fn several_settings_are_crossed_the_last_one_fastest() {
        let all = [vary("link.delay_ms=0,50"), vary("link.loss=0, 0.1 ,0.2")];
        let made = combinations(&all);
        assert_eq!(made.len(), 6);
        assert_eq!(
            (&made[1], &made[3]),
            (&vec!["0".into(), "0.1".into()], &vec!["50".into(), "0".into()])
        );
        assert_eq!(in_words(&all, &made[1]), "link.delay_ms=0, link.loss=0.1");
        assert_eq!(combinations(&[]), [Vec::<String>::new()]);
        let error = refuse_twice(&[all[0].clone(), all[1].clone(), all[0].clone()])
            .unwrap_err()
            .to_string();
        assert!(error.contains("link.delay_ms") && error.contains("twice"), "{error}");
    }

    #[test]
    fn words_that_are_no_setting_are_refused_with_the_nearest() {
        for (text, expected) in [
            ("link.delay_ms", "found no `=`"),
            ("link.delay_ms=0,,5", "found nothing"),
            ("link.delay_ms=0,5,0", "the value 0 is there twice"),
            ("protocl=a,b", "did you mean `protocol`?"),
        ] {
            let error = text.parse::<Vary>().unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }

    #[test]
    fn a_map_is_for_points_that_look_at_it() {
        let all = [vary("localization=recorded,map,gnss")];
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            args: run::Args,
        }
        let chosen = |value: &str| {
            let line = ["realo", "late_fusion", "--map", "a.map"];
            let mut args = <Line as clap::Parser>::parse_from(line).args;
            apply(&all, &[value.into()], "", &mut args).map(|()| (args.choices.localization, args.choices.map))
        };
        let map = Some(PathBuf::from("a.map"));
        assert_eq!(chosen("map").unwrap(), (Some(PoseSource::Map), map));
        assert_eq!(chosen("gnss").unwrap(), (Some(PoseSource::Gnss), None));
        let error = chosen("mpa").unwrap_err().to_string();
        assert!(
            error.contains("--vary localization=mpa") && error.contains("did you mean `map`?"),
            "{error}"
        );
    }

    #[test]
    fn values_of_the_world_may_join_several() {
        let all = [vary("simulator.seed=900+901,902"), vary("link.loss=0.1")];
        let of = |at: usize| world(&all, &combinations(&all)[at]);
        assert_eq!(of(0)["seed"], ["900", "901"]);
        assert_eq!((of(1).len(), &of(1)["seed"]), (1, &vec!["902".to_string()]));
    }
}

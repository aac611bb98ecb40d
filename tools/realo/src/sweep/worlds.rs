//! Logs of simulated worlds, one for each world that a sweep varies.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use eyre::Result;

/// The logs of a world, made where they are not there yet: several where values are joined. Settings that are not given are
/// those of the demo log.
///
/// # Errors
/// A setting that the simulator does not have, with those that it has; a value that it does not take; a build without it.
#[cfg(feature = "demo")]
pub fn logs(folder: &Path, world: &BTreeMap<String, Vec<String>>) -> Result<Vec<PathBuf>> {
    made::logs(folder, world)
}

/// A build without the simulator makes no world.
///
/// # Errors
/// Always.
#[cfg(not(feature = "demo"))]
pub fn logs(_: &Path, _: &BTreeMap<String, Vec<String>>) -> Result<Vec<PathBuf>> {
    eyre::bail!(
        "--vary simulator.…: this program was built without the feature `demo`: make the logs by `realo-lab simulate`, and name them \
         (--log)"
    )
}

#[cfg(feature = "demo")]
mod made {
    use std::collections::BTreeMap;
    use std::path::{Path, PathBuf};

    use eyre::{Result, WrapErr, bail, eyre};
    use realo_cli::campaign::digest;
    use realo_cli::{Progress, unfinished};
    use realo_operator::config::{did_you_mean, nearest_name};
    use realo_simulator::{Options, Phase, Scenario, fleet, write_log};

    /// What can be set.
    const KEYS: [&str; 12] = [
        "seed",
        "seconds",
        "vehicles",
        "roadside",
        "agents",
        "scenario",
        "dense",
        "place",
        "phase",
        "rain",
        "visibility",
        "key_hz",
    ];
    /// Keys of which a value may join several words.
    const JOINED: [&str; 2] = ["seed", "agents"];

    pub fn logs(folder: &Path, world: &BTreeMap<String, Vec<String>>) -> Result<Vec<PathBuf>> {
        let mut one: BTreeMap<&str, String> = BTreeMap::new();
        let mut seeds = Vec::new();
        for (key, values) in world {
            let word = || format!("--vary simulator.{key}={}", values.join("+"));
            if !KEYS.contains(&key.as_str()) {
                let hint = did_you_mean(&nearest_name(key, KEYS));
                bail!(
                    "{}: the simulator has no such setting{hint}; it has: {}",
                    word(),
                    KEYS.join(", ")
                );
            }
            if values.len() > 1 && !JOINED.contains(&key.as_str()) {
                bail!(
                    "{}: only values of simulator.seed and simulator.agents can be joined by `+`",
                    word()
                );
            }
            match key.as_str() {
                "seed" => seeds.clone_from(values),
                _ => _ = one.insert(key, values.join("+")),
            }
        }
        if seeds.is_empty() {
            seeds.push(Options::demo().seed.to_string());
        }
        let logs = seeds.iter().map(|seed| {
            let mut settings = one.clone();
            settings.insert("seed", seed.clone());
            log(folder, &settings)
        });
        logs.collect()
    }

    /// The log of one world.
    fn log(folder: &Path, settings: &BTreeMap<&str, String>) -> Result<PathBuf> {
        let options = options(settings)?;
        let name: Vec<String> = settings.iter().map(|(key, value)| format!("{key}={value}")).collect();
        let name = name.join(",");
        let made_of = digest(&format!("{} {options:?}", env!("CARGO_PKG_VERSION")));
        let folder = folder.join(made_of);
        let path = folder.join(format!("{name}.mcap"));
        if path.exists() {
            return Ok(path);
        }
        std::fs::create_dir_all(&folder).wrap_err_with(|| format!("{}", folder.display()))?;
        unfinished::note(&path);
        let progress = Progress::new(format!("simulating {name}"), "sweeps", Some(0.0));
        write_log(&options, &path, |far| match far.sweeps {
            0 => progress.begin(0.0, far.of as f64),
            sweeps => progress.set(sweeps as f64),
        })
        .wrap_err_with(|| format!("the world {name}"))?;
        unfinished::done(&path);
        Ok(path)
    }

    fn options(settings: &BTreeMap<&str, String>) -> Result<Options> {
        let mut options = Options::demo();
        let mut counts = [None, None];
        for (key, value) in settings {
            let wrong = |expected: &str| eyre!("--vary simulator.{key}={value}: expected {expected}, found `{value}`");
            let whole = || value.parse::<u64>().map_err(|_| wrong("a whole number"));
            let number = || value.parse::<f64>().map_err(|_| wrong("a number"));
            match *key {
                "seed" => options.seed = whole()?,
                "place" => options.place = Some(whole()?),
                "vehicles" => counts[0] = Some(whole()?),
                "roadside" => counts[1] = Some(whole()?),
                "agents" => options.agents = value.split('+').map(String::from).collect(),
                "seconds" => options.seconds = number()?,
                "key_hz" => options.key_hz = number()?,
                "rain" => options.weather.rain_mm_h = number()?,
                "visibility" => options.weather.visibility_m = Some(number()?),
                "dense" => options.dense = value.parse().map_err(|_| wrong("true or false"))?,
                "scenario" => options.scenario = Scenario::from_name(value)?,
                "phase" => {
                    let known = Phase::ALL.iter().find(|(_, name, _)| name == value);
                    options.phase = known.ok_or_else(|| wrong("locked or spread"))?.0;
                }
                _ => unreachable!("the keys are known"),
            }
        }
        if counts != [None, None] {
            if settings.contains_key("agents") {
                bail!(
                    "--vary simulator.agents: it names the agents that simulator.vehicles and simulator.roadside count: drop one"
                );
            }
            let [vehicles, roadside] = counts.map(|count| count.unwrap_or(0) as usize);
            options.agents = fleet(vehicles, roadside)?;
        }
        Ok(options)
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        fn settings(all: &[(&'static str, &str)]) -> BTreeMap<&'static str, String> {
            all.iter().map(|(key, value)| (*key, value.to_string())).collect()
        }

        #[test]
        fn what_is_not_given_is_as_in_the_demo_log() {
            assert_eq!(options(&settings(&[])).unwrap(), Options::demo());
            let made = options(&settings(&[("vehicles", "3"), ("roadside", "1"), ("seconds", "2.5")])).unwrap();
            assert_eq!((made.agents.len(), made.seconds, made.seed), (4, 2.5, 900));
        }

        #[test]
        fn what_the_simulator_lacks_is_named() {
            let folder = tempfile::tempdir().unwrap();
            let said = |key: &str, values: &[&str]| {
                let values = values.iter().map(|value| value.to_string()).collect();
                let world = BTreeMap::from([(key.to_string(), values)]);
                format!("{:#}", logs(folder.path(), &world).unwrap_err())
            };
            assert!(said("sed", &["1"]).contains("did you mean `seed`?"));
            assert!(said("rain", &["1", "2"]).contains("joined"));
            assert!(said("seed", &["one"]).contains("expected a whole number, found `one`"));
            assert!(said("seconds", &["-1"]).contains("seconds"));
        }
    }
}

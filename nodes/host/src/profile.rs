use std::collections::BTreeMap;
use std::path::Path;

use realo_schemas::Nanos;
use serde::Serialize;

/// How long each stage takes in virtual time.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ComputeProfile {
    /// ns per call, by `stage` or `stage.trigger`: the input that triggers the call or `wake`, with ` > OUTPUTS` behind it
    /// for calls that send something. What is not named takes no time.
    pub nanos: BTreeMap<String, Nanos>,
    /// A call takes what it takes on this machine instead, on which the calls are made one by one. Then no run repeats another
    /// to the bit.
    pub measured: bool,
}

impl ComputeProfile {
    /// What each call takes on this machine.
    pub fn as_measured() -> Self {
        ComputeProfile {
            measured: true,
            ..ComputeProfile::default()
        }
    }

    /// Reads a profile from TOML: `stage = ns`, or a table of triggers; dots may be written as tables.
    ///
    /// # Errors
    /// Names the file and what does not fit.
    pub fn read(path: &Path) -> Result<Self, String> {
        let shown = path.display();
        let text = realo_documents::read(path).map_err(|error| {
            format!(
                "{shown}: {error}; a compute profile is a TOML file of `stage = ns`, as a realtime run leaves one in \
                 its folder (compute.toml)"
            )
        })?;
        let table: toml::Table = toml::from_str(&text).map_err(|error| format!("{shown}: {error}"))?;
        let mut nanos = BTreeMap::new();
        collect("", &table, &mut nanos).map_err(|problem| format!("{shown}: {problem}"))?;
        Ok(ComputeProfile { nanos, measured: false })
    }

    /// The profile as TOML, a table for each stage.
    pub fn to_toml(stages: &BTreeMap<String, BTreeMap<String, Nanos>>) -> String {
        toml::to_string(stages).expect("tables of integers are TOML")
    }

    /// Time of a call: that of its trigger, or of its trigger whatever it sends, or of the stage.
    pub fn of(&self, stage: &str, trigger: &str) -> Nanos {
        if self.nanos.is_empty() {
            return 0;
        }
        let cause = trigger.split(" > ").next().unwrap_or(trigger);
        let keys = [
            format!("{stage}.{trigger}"),
            format!("{stage}.{cause}"),
            stage.to_string(),
        ];
        keys.iter().find_map(|key| self.nanos.get(key)).copied().unwrap_or(0)
    }

    /// Something that the profile names and that is no part of any of these stages.
    pub fn stranger(&self, is_stage: impl Fn(&str) -> bool) -> Option<&str> {
        let known = |key: &str| {
            let dots = key.match_indices('.').map(|(at, _)| at);
            is_stage(key) || dots.into_iter().any(|at| is_stage(&key[..at]))
        };
        self.nanos.keys().map(String::as_str).find(|key| !known(key))
    }
}

fn collect(above: &str, table: &toml::Table, nanos: &mut BTreeMap<String, Nanos>) -> Result<(), String> {
    for (key, value) in table {
        let id = if above.is_empty() {
            key.clone()
        } else {
            format!("{above}.{key}")
        };
        match value {
            toml::Value::Table(inner) => collect(&id, inner, nanos)?,
            toml::Value::Integer(found) if *found >= 0 => {
                nanos.insert(id, *found);
            }
            other => {
                return Err(format!("`{id}`: expected a duration in ns of 0 or more, found {other}"));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn charges_by_trigger_then_by_stage() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("c.toml");
        let text = "nms = 5\n[\"ego.sync\"]\nposes = 7\n\"poses > clouds\" = 2800\n[ego.head]\nfeatures = 9\n";
        std::fs::write(&file, text).unwrap();
        let profile = ComputeProfile::read(&file).unwrap();
        let cases = [
            ("nms", "boxes > boxes", 5),
            ("ego.sync", "poses", 7),
            ("ego.sync", "poses > clouds", 2800),
            ("ego.sync", "poses > states", 7),
            ("ego.sync", "clouds", 0),
            ("ego.head", "features > boxes", 9),
        ];
        for (stage, trigger, expected) in cases {
            assert_eq!(profile.of(stage, trigger), expected, "{stage} {trigger}");
        }
        let stages = ["nms", "ego.sync"];
        assert_eq!(profile.stranger(|id| stages.contains(&id)), Some("ego.head.features"));
        assert_eq!(profile.stranger(|id| stages.contains(&id) || id == "ego.head"), None);
    }

    #[test]
    fn refuses_what_is_no_duration() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("c.toml");
        std::fs::write(&file, "nms = -5").unwrap();
        let error = ComputeProfile::read(&file).unwrap_err();
        assert!(
            error.contains("c.toml") && error.contains("`nms`") && error.contains("-5"),
            "{error}"
        );
    }

    #[test]
    fn damaged_profiles_are_profiles_or_errors() {
        const SOUND: &str =
            "nms = 5\n[\"ego.sync\"]\nposes = 7\n\"poses > clouds\" = 2_800\n[ego.head]\nfeatures = 9\n";
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("c.toml");
        let (mut taken, mut refused) = (0, 0);
        for case in 0..damage::cases(10_000) {
            let mut bytes = SOUND.as_bytes().to_vec();
            damage::Draw::new(case).damage(&mut bytes);
            std::fs::write(&file, &bytes).unwrap();
            let held = damage::most_held(|| match ComputeProfile::read(&file) {
                Ok(profile) => {
                    taken += 1;
                    assert!(profile.nanos.values().all(|nanos| *nanos >= 0), "case {case}");
                }
                Err(error) => {
                    refused += 1;
                    assert!(error.starts_with(&file.display().to_string()), "case {case}: {error}");
                }
            });
            assert!(held < 1 << 20, "case {case} takes {held} bytes");
        }
        assert!(taken > 100 && refused > 1000, "{taken} taken, {refused} refused");
    }
}

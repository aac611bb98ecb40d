//! Link profiles that somebody damaged, by accident or on purpose: a profile within its limits, or an error that names the
//! file.

use damage::{Draw, cases, damaged_yaml};
use realo_link::Profile;
use realo_schemas::Kind;

const YAML: &str = "
about: all of it
default: { fixed_ms: 2.5, bits_per_second: 20000000, jitter: { gaussian_ms: 1.5, uniform_ms: 3 }, loss: 0.02, duplicate: 1 }
kinds: { boxes: { fixed_ms: 1 }, points: { loss: 1.0 }, agent_state: { jitter: { uniform_ms: 3600000 } } }
";
const TOML: &str = "
about = 'all of it'
[default]
fixed_ms = 2.5
bits_per_second = 20_000_000
jitter = { gaussian_ms = 1.5, uniform_ms = 3 }
[kinds.boxes]
loss = 0.02
";
const WORDS: &[&str] = &[
    "about",
    "default",
    "kinds",
    "boxes",
    "points",
    "features",
    "agent_state",
    "report",
    "fixed_ms",
    "bits_per_second",
    "jitter",
    "uniform_ms",
    "gaussian_ms",
    "step_ms",
    "loss",
    "duplicate",
    "x",
];

#[test]
fn damaged_profiles_are_profiles_or_errors() {
    let folder = tempfile::tempdir().unwrap();
    let (mut taken, mut refused) = (0, 0);
    for case in 0..cases(10_000) {
        let mut draw = Draw::new(case);
        let (name, bytes) = match draw.chance(4) {
            true => {
                let mut bytes = TOML.as_bytes().to_vec();
                draw.damage(&mut bytes);
                ("radio.toml", bytes)
            }
            false => ("radio.yml", damaged_yaml(YAML, &mut draw, WORDS)),
        };
        let file = folder.path().join(name);
        std::fs::write(&file, bytes).unwrap();
        match Profile::load(file.to_str().unwrap()) {
            Ok(profile) => {
                let model = profile.model(Kind::Boxes);
                assert!((0.0..=3_600_000.0).contains(&model.fixed_ms), "case {case}: {model:?}");
                assert!((0.0..=1.0).contains(&model.loss), "case {case}: {model:?}");
                taken += 1;
            }
            Err(error) => {
                let error = error.to_string();
                assert!(error.contains(name) && error.len() < 1000, "case {case}: {error}");
                refused += 1;
            }
        }
    }
    assert!(
        taken > refused / 50 && refused > taken / 50,
        "{taken} taken, {refused} refused"
    );
}

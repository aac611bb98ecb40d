//! What `docs/reference/links.md` says of profiles is so.

use realo_link::{BUILT_IN, Jitter, Model, Profile};
use realo_schemas::Kind;

const PAGE: &str = include_str!("../../../docs/reference/links.md");

#[test]
fn the_profile_of_the_page_is_read_as_the_page_says() {
    let text = PAGE.split("```toml").nth(1).and_then(|rest| rest.split("```").next());
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("page.toml");
    std::fs::write(&file, text.expect("the page has an example")).unwrap();
    let profile = Profile::load(file.to_str().unwrap()).unwrap();
    assert_eq!(profile.model(Kind::Points), profile.model(Kind::Features));
    let boxes = Model {
        fixed_ms: 1.0,
        jitter: Jitter {
            uniform_ms: 0.5,
            gaussian_ms: 0.0,
        },
        step_ms: 0.0,
        duplicate: 0.01,
        // A kind's table replaces the default as a whole.
        bits_per_second: None,
        loss: 0.0,
    };
    assert_eq!(profile.model(Kind::Boxes), &boxes);
    assert_eq!(profile.model(Kind::Points).loss, 0.02);
}

#[test]
fn the_page_names_every_profile_and_the_papers_delays() {
    for (name, _) in BUILT_IN {
        assert!(PAGE.contains(&format!("`{name}`")), "{name}");
    }
    let paper = Profile::load("paper").unwrap();
    for kind in [Kind::Points, Kind::Features, Kind::Boxes] {
        let delay = format!("{:.1}", paper.model(kind).fixed_ms);
        assert!(PAGE.contains(&delay), "{kind}: {delay}");
        assert!(PAGE.contains(&format!("`{kind}`")), "{kind}");
    }
}

#[test]
fn the_trace_of_the_page_is_read_as_the_page_says() {
    let trace = PAGE.split("```\n").find(|part| part.starts_with("seconds,"));
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("drive.csv"), trace.expect("the page has a trace")).unwrap();
    let file = folder.path().join("page.toml");
    std::fs::write(&file, "[channel]\ntrace = \"drive.csv\"\n").unwrap();
    let channel = Profile::load(file.to_str().unwrap()).unwrap().channel.unwrap();
    let seconds: Vec<f64> = channel.phases.iter().map(|phase| phase.from as f64 * 1e-9).collect();
    assert_eq!(seconds, [0.0, 12.5, 14.0, 19.0]);
    assert_eq!(
        (channel.phases[1].bits_per_second, channel.phases[2].bits_per_second),
        (6_000_000, 0)
    );
    assert_eq!((channel.queue_ms, channel.half_duplex), (None, false));
}

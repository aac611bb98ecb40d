//! The paper's times fit the link profile, the stages and the models.

use realo_cli::paper::PaperTimes;
use realo_schemas::Kind;
use realo_stages::link::Profile;

use crate::registry;

#[test]
fn the_link_profile_has_the_same_times() {
    let profile = Profile::load("paper").unwrap();
    for kind in [Kind::Boxes, Kind::Features, Kind::Points] {
        let message = PaperTimes::get().message(kind).unwrap();
        assert_eq!(profile.model(kind).fixed_ms, message.ms, "{kind}");
    }
    assert!(PaperTimes::get().message(Kind::Report).is_none());
}

#[test]
fn every_method_is_a_stage_or_an_arch() {
    let archs = ["pointpillars", "fcooper", "attfuse", "v2xvit"];
    for method in PaperTimes::get().methods() {
        let is_stage = registry().0.iter().any(|entry| entry.name == method);
        assert!(is_stage || archs.contains(&method), "{method}");
    }
    assert_eq!(PaperTimes::get().inference("attfuse"), Some(68_600_000));
    assert_eq!(PaperTimes::get().inference("v2vnet"), None);
}

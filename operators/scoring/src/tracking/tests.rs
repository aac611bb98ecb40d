use realo_schemas::{Boxes, GroundTruth, Header, Kind, Nanos};

use super::*;
use crate::{EvaluationReport, evaluate};

fn car(x: f64, y: f64, track: Option<u64>, velocity: Option<[f64; 3]>) -> Box3 {
    Box3 {
        track,
        velocity,
        ..Box3::new("Car", [x, y, 0.8], [4.0, 2.0, 1.5], 0.0)
    }
}

fn header(seq: u64, kind: Kind) -> Header {
    let stamp = 100_000_000 * seq as Nanos;
    Header::origin(&"run".into(), &"cav1".into(), kind, seq, stamp, stamp)
}

/// Truths and detections of frames, in their order.
fn scored(frames: &[(Vec<Box3>, Vec<Box3>)]) -> Evaluation {
    let truth = |boxes: &Vec<Box3>| GroundTruth {
        boxes: boxes.clone(),
        agents: vec!["cav1".into()],
        key: true,
        ..GroundTruth::default()
    };
    let numbered = || frames.iter().zip(0..);
    evaluate(
        numbered().map(|((objects, _), seq)| (header(seq, Kind::Truth), truth(objects))),
        numbered().map(|((_, found), seq)| (header(seq, Kind::Boxes), Boxes(found.clone()))),
        &Protocol::load("default").unwrap(),
    )
    .unwrap()
}

fn vehicles(frames: &[(Vec<Box3>, Vec<Box3>)]) -> TrackScores {
    tracking(&scored(frames)).unwrap()["vehicle"]
}

/// A car that drives and one that stands, under the identities 5 and 6.
fn objects(t: f64) -> Vec<Box3> {
    let driving = Some([10.0, 0.0, 0.0]);
    vec![
        car(10.0 * t, 0.0, Some(5), driving),
        car(20.0, 8.0, Some(6), Some([0.0; 3])),
    ]
}

#[test]
fn what_is_followed_exactly_is_one_whatever_it_is_called() {
    let frames: Vec<_> = (0..6)
        .map(|i| {
            let objects = objects(0.1 * f64::from(i));
            let mut found = objects.clone();
            (found[0].track, found[1].track) = (Some(70), Some(u64::MAX));
            found.reverse();
            (objects, found)
        })
        .collect();
    let found = vehicles(&frames);
    let expected = TrackScores {
        hota: 1.0,
        detection: 1.0,
        association: 1.0,
        localization: 1.0,
        min_score: 0.0,
        velocity_error: Some(0.0),
        velocity_error_moving: Some(0.0),
        velocities: 12,
        velocities_moving: 6,
        identity_changes: Some(0),
        identity_swaps: Some(0),
    };
    let near = |a: f64, b: f64| (a - b).abs() < 1e-9;
    assert!(near(found.hota, 1.0) && near(found.localization, 1.0), "{found:?}");
    let found = TrackScores {
        hota: 1.0,
        detection: 1.0,
        association: 1.0,
        localization: 1.0,
        ..found
    };
    assert_eq!(found, expected);
}

#[test]
fn a_change_of_identity_costs_and_so_does_none() {
    let of = |track: fn(i32) -> Option<u64>| {
        let frames: Vec<_> = (0..4)
            .map(|i| {
                let mut found = objects(0.1 * f64::from(i));
                found[0].track = track(i);
                (objects(0.1 * f64::from(i)), found)
            })
            .collect();
        vehicles(&frames).association
    };
    // Object 5 has 4 pairs; so has object 6, of association 1.
    let association = |five: f64| (five + 4.0) / 8.0;
    for (found, expected) in [
        (of(|_| Some(1)), association(4.0)),
        (of(|i| Some(u64::from(i > 0))), association(0.25 + 3.0 * 0.75)),
        (of(|_| None), association(4.0 * 0.25)),
        // One identity for both cars: it counts for one of them in each frame.
        (of(|_| Some(6)), association(4.0 * 0.25)),
    ] {
        assert!((found - expected).abs() < 1e-9, "{found} for {expected}");
    }
}

#[test]
fn changes_of_identity_are_counted_and_tracks_that_swap_among_them() {
    let of = |tracks: fn(u64) -> [Option<u64>; 2]| {
        let frames: Vec<_> = (0..6)
            .map(|i| {
                let objects = objects(0.1 * i as f64);
                let mut found = objects.clone();
                [found[0].track, found[1].track] = tracks(i);
                (objects, found)
            })
            .collect();
        let found = vehicles(&frames);
        (found.identity_changes.unwrap(), found.identity_swaps.unwrap())
    };
    assert_eq!(of(|_| [Some(1), Some(2)]), (0, 0));
    assert_eq!(of(|i| [Some(1 + 2 * i), Some(2)]), (5, 0));
    let swapped = |i: u64| if i < 3 { [Some(1), Some(2)] } else { [Some(2), Some(1)] };
    assert_eq!(of(swapped), (2, 2));
    // A pause without identity is no change.
    assert_eq!(of(|i| [Some(1).filter(|_| i != 2), Some(2)]), (0, 0));
}

#[test]
fn the_min_score_is_the_one_of_the_best_hota() {
    let frames: Vec<_> = (0..4)
        .map(|i| {
            let mut found = objects(0.1 * f64::from(i));
            found.iter_mut().for_each(|object| object.score = 0.65);
            // Doubtful ghosts, each under a new identity.
            found.push(Box3 {
                score: 0.35,
                ..car(-30.0, f64::from(i), Some(100 + i as u64), None)
            });
            (objects(0.1 * f64::from(i)), found)
        })
        .collect();
    let found = vehicles(&frames);
    assert!(found.min_score == 0.4 && (found.hota - 1.0).abs() < 1e-9, "{found:?}");
}

#[test]
fn velocities_err_by_what_they_differ_and_count_where_both_are_known() {
    let mut found = objects(0.0);
    found[0].velocity = Some([7.0, 4.0, 0.0]);
    found[1].velocity = Some([0.0, 1.0, 0.0]);
    let mut unknown = objects(0.1);
    (unknown[0].velocity, unknown[1].velocity) = (None, Some([f64::NAN, 0.0, 0.0]));
    let scores = vehicles(&[(objects(0.0), found), (objects(0.1), unknown)]);
    assert_eq!((scores.velocities, scores.velocities_moving), (2, 1));
    assert_eq!(
        (scores.velocity_error, scores.velocity_error_moving),
        (Some(3.0), Some(5.0))
    );
}

#[test]
fn without_identities_nothing_is_scored_and_nothing_is_kept() {
    let bare = |mut boxes: Vec<Box3>| {
        boxes.iter_mut().for_each(|object| object.track = None);
        boxes
    };
    let no_tracks = scored(&[(objects(0.0), bare(objects(0.0)))]);
    assert_eq!(
        (tracking(&no_tracks), &no_tracks.scenes[0].frames[0].identities),
        (None, &None)
    );
    assert!(
        !serde_json::to_string(&EvaluationReport::from(no_tracks))
            .unwrap()
            .contains("identities")
    );
    // Detections have them, objects do not.
    assert_eq!(tracking(&scored(&[(bare(objects(0.0)), objects(0.0))])), None);
}

#[test]
fn identities_come_back_from_a_file_and_pool() {
    let frames: Vec<_> = (0..3)
        .map(|i| (objects(0.1 * f64::from(i)), objects(0.1 * f64::from(i))))
        .collect();
    let one = scored(&frames);
    let text = serde_json::to_string(&one).unwrap();
    assert!(text.contains(r#"[[5,[10000,0]],[6,[0,0]]]"#), "{text}");
    let again: Evaluation = serde_json::from_str(&text).unwrap();
    assert_eq!(again, one);
    let mut other = one.clone();
    other.scenes[0].name = "b".into();
    // The same numbers in another log are other identities.
    let pooled = crate::pool(vec![one.clone(), other]).unwrap();
    let [one, both] = [one, pooled].map(|evaluation| tracking(&evaluation).unwrap()["vehicle"]);
    assert_eq!((both.hota, both.velocities), (one.hota, 2 * one.velocities));
}

#[test]
fn identities_of_a_damaged_file_are_none() {
    let mut evaluation = scored(&[(objects(0.0), objects(0.0))]);
    let identities = evaluation.scenes[0].frames[0].identities.as_mut().unwrap();
    identities.truths.truncate(1);
    identities.detections.truncate(1);
    let scores = tracking(&evaluation).unwrap()["vehicle"];
    assert_eq!((scores.velocities, scores.detection > 0.9), (1, true));
}

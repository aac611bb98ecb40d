use nalgebra::Isometry3;
use realo_schemas::{Box3, Kind, Message, Pose};

use super::*;

fn message(agent: &str, seq: u64, stamp_ms: i64, x: f64) -> Message {
    let stamp = stamp_ms * 1_000_000;
    let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, stamp, stamp);
    header.pose = Some(Pose::exact(Isometry3::translation(100.0, 0.0, 0.0)));
    Message::new(
        header,
        Boxes(vec![Box3::new("Car", [x, 0.0, 0.8], [4.5, 1.9, 1.6], 0.0)]),
    )
}

fn follow(tracker: &mut Tracker, message: Message) -> (Header, Vec<Box3>, Outputs<Output>) {
    let mut out = Outputs::at(0);
    tracker.on_message(Input::BOXES, message, &mut out).unwrap();
    let mut sent = out.take_sent();
    assert_eq!((sent.len(), sent[0].0), (1, Output::TRACKED));
    let (header, Boxes(boxes)) = sent.remove(0).1.into_parts().unwrap();
    (header, boxes, out)
}

#[test]
fn each_agent_has_tracks_of_its_own() {
    let mut tracker = Tracker::new(Settings::default()).unwrap();
    for sweep in 0..5 {
        let stamp = 100 * sweep;
        let x = sweep as f64;
        let (header, near, _) = follow(&mut tracker, message("cav2", sweep as u64, stamp, x));
        assert_eq!(
            (&*header.agent, header.seq, header.kind),
            ("cav2", sweep as u64, Kind::Boxes)
        );
        // The same place, but another agent's box.
        let (_, far, out) = follow(&mut tracker, message("rsu1", sweep as u64, stamp + 3, -x));
        assert_eq!((near[0].track, far[0].track), (Some(1), Some(1)));
        assert_eq!(out.counted("tracked_boxes"), u64::from(sweep > 0));
        if sweep == 4 {
            let [near, far] = [&near[0], &far[0]].map(|object| object.velocity.unwrap()[0]);
            assert!(
                (near - 10.0).abs() < 1.0 && (far + 10.0).abs() < 1.0,
                "{near} and {far}"
            );
        }
    }
}

#[test]
fn a_message_without_a_pose_passes_as_it_is_and_is_counted() {
    let mut tracker = Tracker::new(Settings::default()).unwrap();
    let mut unplaced = message("cav2", 0, 0, 1.0);
    unplaced.header.pose = None;
    let (header, boxes, out) = follow(&mut tracker, unplaced.clone());
    assert_eq!(Message::new(header, Boxes(boxes)), unplaced);
    assert_eq!(out.counted("unplaced_messages"), 1);
}

#[test]
fn velocities_of_the_detector_count_unless_they_are_not_wanted() {
    for detector_velocities in [true, false] {
        let settings = Settings {
            detector_velocities,
            ..Settings::default()
        };
        let mut tracker = Tracker::new(settings).unwrap();
        let first = message("cav2", 0, 0, 0.0);
        let (header, Boxes(mut boxes)) = first.into_parts().unwrap();
        boxes[0].velocity = Some([20.0, 0.0, 0.0]);
        let (_, boxes, _) = follow(&mut tracker, Message::new(header, Boxes(boxes)));
        assert_eq!(boxes[0].velocity, detector_velocities.then_some([20.0, 0.0, 0.0]));
    }
}

#[test]
fn stamps_that_do_not_go_on_are_counted() {
    let mut tracker = Tracker::new(Settings::default()).unwrap();
    let counts = [
        (1000, ""),
        (1000, "repeated_stamps"),
        (950, "late_stamps"),
        (9000, "gaps"),
        (100, "restarts"),
    ];
    for (seq, (stamp, counter)) in counts.into_iter().enumerate() {
        let (_, _, out) = follow(&mut tracker, message("cav2", seq as u64, stamp, 0.0));
        for name in ["repeated_stamps", "late_stamps", "gaps", "restarts"] {
            assert_eq!(out.counted(name), u64::from(name == counter), "{name} at {stamp}");
        }
    }
}

#[test]
fn agents_are_bounded() {
    let settings = Settings {
        max_agents: 2,
        ..Settings::default()
    };
    let mut tracker = Tracker::new(settings).unwrap();
    for (seq, agent) in ["a", "b", "a", "c"].into_iter().enumerate() {
        let (_, _, out) = follow(&mut tracker, message(agent, seq as u64, 100 * seq as i64, 0.0));
        assert_eq!(out.counted("forgotten_agents"), u64::from(agent == "c"));
    }
    assert_eq!(
        tracker.agents.keys().map(|name| &**name).collect::<Vec<_>>(),
        ["a", "c"],
        "b was silent longest"
    );
}

#[test]
fn settings_that_cannot_be_are_refused() {
    let error = |settings| {
        Tracker::new(settings)
            .err()
            .map(|error| error.to_string())
            .unwrap_or_default()
    };
    let coast = Settings {
        coast_ms: 700,
        ..Settings::default()
    };
    assert!(error(coast).contains("`coast_ms`: expected up to `max_gap_ms` = 600, found 700"));
    let gate = Settings {
        gate: f64::NAN,
        ..Settings::default()
    };
    assert!(error(gate).contains("`gate`"));
    let tracks = Settings {
        max_tracks: 4096,
        ..Settings::default()
    };
    assert!(error(tracks).contains("`max_tracks`"));
}

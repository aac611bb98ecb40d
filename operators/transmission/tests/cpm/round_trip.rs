//! Any boxes, anywhere: what comes out is what went in, to the precision of a CPM.

use proptest::prelude::*;

use super::*;

const CLASSES: [&str; 6] = ["vehicle", "pedestrian", "truck", "Bus", "BicycleRider", "Motorcycle"];

fn object() -> impl Strategy<Value = Box3> {
    let center = [-900.0..900.0f64, -900.0..900.0f64, -50.0..50.0f64];
    let extents = [0.01..25.4f64, 0.01..25.4f64, 0.01..25.4f64];
    let velocity = prop::option::of([-110.0..110.0f64, -110.0..110.0f64, -20.0..20.0f64]);
    let rest = (
        -7.0..7.0f64,
        0.0..=1.0f32,
        0..CLASSES.len(),
        prop::option::of(prop_oneof![0..70_000u64, any::<u64>(), 0..8u64]),
    );
    (center, extents, velocity, rest).prop_map(
        |(center, [length, width, height], velocity, (yaw, score, class, track))| Box3 {
            center,
            length,
            width,
            height,
            yaw,
            velocity,
            class: CLASSES[class].into(),
            score,
            track,
            covariance: None,
        },
    )
}

fn origin() -> impl Strategy<Value = Geodetic> {
    let edges = prop_oneof![
        Just((0.0, 0.0)),
        Just((89.0, 180.0)),
        Just((-89.0, -180.0)),
        Just((-45.0, 179.99)),
        Just((60.0, -179.99)),
        (-89.0..=89.0f64, -180.0..=180.0f64)
    ];
    (edges, -300.0..3_000.0f64).prop_map(|((latitude, longitude), height)| place(latitude, longitude, height))
}

fn pose() -> impl Strategy<Value = Isometry3<f64>> {
    let translation = [-7_000.0..7_000.0f64, -7_000.0..7_000.0f64, -50.0..50.0f64];
    let tilt = -0.05..0.05f64;
    (translation, tilt.clone(), tilt, -4.0..4.0f64).prop_map(|(translation, roll, pitch, yaw)| {
        Isometry3::from_parts(
            Vector3::from(translation).into(),
            UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        )
    })
}

/// What receivers know of the tracks: those up to 65,535, of others a hash; of two boxes with one id only the first has it.
fn tracks_of(sent: &[Box3]) -> Vec<Option<u64>> {
    let hash = |track: u64| {
        let step = |hash: u32, byte: u8| (hash ^ u32::from(byte)).wrapping_mul(16_777_619);
        let hash = track.to_be_bytes().into_iter().fold(2_166_136_261, step);
        u64::from((hash ^ (hash >> 16)) & 0xffff)
    };
    let ids: Vec<Option<(bool, u64)>> = sent
        .iter()
        .map(|sent| {
            Some(sent.track?).map(|track| {
                if track < 65_536 {
                    (false, track)
                } else {
                    (true, hash(track))
                }
            })
        })
        .collect();
    let has_owner = |index: usize, (is_hash, id): (bool, u64)| {
        let others = ids
            .iter()
            .enumerate()
            .filter_map(|(other, known)| Some((other, (*known)?)));
        let mut before = others.filter(|(other, (other_is_hash, _))| (*other_is_hash, *other) < (is_hash, index));
        before.any(|(_, (_, known))| known == id)
    };
    let known = ids.iter().enumerate().map(|(index, id)| {
        let (is_hash, id) = (*id)?;
        (!has_owner(index, (is_hash, id))).then_some(id)
    });
    known.collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn boxes_come_back_within_the_precision_of_a_cpm(
        origin in origin(), map_from_body in pose(), sent in prop::collection::vec(object(), 0..20), seq in any::<u64>(),
    ) {
        let header = header("cav1", seq, map_from_body);
        let (packet, dropped) = encode(&header, &sent, &config(origin)).unwrap();
        let tracks = tracks_of(&sent);
        let lost = sent.iter().zip(&tracks).filter(|(sent, track)| sent.track.is_some() && track.is_none());
        prop_assert_eq!(dropped, Dropped { tracks: lost.count() as u64, ..Dropped::default() });
        let (found, unused) = decode(&header, &packet, origin).unwrap();
        prop_assert_eq!(unused, Unused::default());
        prop_assert_eq!((found.header.stamp, found.header.seq), (STAMP, seq));
        prop_assert_eq!(boxes_of(&found).len(), sent.len());
        for ((found, sent), track) in boxes_of(&found).iter().zip(&sent).zip(tracks) {
            check(found, &in_map(&map_from_body, sent));
            prop_assert_eq!(&found.class, &sent.class);
            prop_assert_eq!(found.track, track);
        }
        // What the ego makes of it is the same wherever the map's origin is said to be, to that precision.
        let elsewhere = place(0.0, 0.0, 0.0);
        let (packet, _) = encode(&header, &sent, &config(elsewhere)).unwrap();
        let (other, _) = decode(&header, &packet, elsewhere).unwrap();
        for (other, found) in boxes_of(&other).iter().zip(boxes_of(&found)) {
            let apart = Vector3::from(other.center) - Vector3::from(found.center);
            prop_assert!(apart.norm() < 2.0 * 0.008_67);
        }
    }
}

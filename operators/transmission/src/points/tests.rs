use proptest::prelude::*;
use realo_schemas::{Header, Kind, Message, Packet, Payload};

use super::*;
use crate::{Decoder, Encoder, EncoderConfig};

const LIMIT: usize = 32 << 20;
/// Bytes of the envelope of [`message`].
const ENVELOPE: usize = 2 + 3 + 16 + 1 + 4;

fn message(cloud: PointCloud) -> Message {
    let header = Header::origin(&"r".into(), &"cav2".into(), Kind::Points, 3, 5, 8);
    Message::new(header, cloud)
}

fn config(step_m: f64, zstd: Option<i32>, columns: bool) -> EncoderConfig {
    EncoderConfig {
        time: columns,
        ring: columns,
        step_m,
        zstd,
        ..EncoderConfig::default()
    }
}

fn encoded(cloud: PointCloud, config: &EncoderConfig) -> (Packet, u64) {
    let mut encoder = Encoder::new(config).unwrap();
    let (packet, dropped) = encoder.encode(&message(cloud), &mut Steps::default()).unwrap();
    (packet, dropped.points)
}

fn decoded(bytes: &[u8], limit: usize) -> Result<PointCloud, DecodeError> {
    let content = Decoder::new(limit).unwrap().decode(bytes, &mut Steps::default())?;
    match content.payload {
        Payload::PointCloud(cloud) => Ok(cloud),
        other => panic!("{other:?}"),
    }
}

fn refused(bytes: &[u8]) -> String {
    decoded(bytes, LIMIT).expect_err("refused").to_string()
}

fn drawn(i: usize) -> u64 {
    (i as u64 + 1)
        .wrapping_mul(0x9E37_79B9_7F4A_7C15)
        .rotate_left(31)
        .wrapping_mul(0xBF58_476D_1CE4_E5B9)
}

/// Points all over a ball of such a radius.
fn scattered(count: usize, radius: f32) -> PointCloud {
    let column = |k: usize| {
        let number = |i: usize| ((drawn(3 * i + k) >> 40) as f32 / (1u64 << 23) as f32 - 1.0) * radius;
        (0..count).map(number).collect::<Vec<f32>>()
    };
    let intensity: Vec<u8> = (0..count).map(|i| (drawn(i) >> 7) as u8).collect();
    let time: Vec<i32> = (0..count).map(|i| (drawn(i) >> 20) as i32).collect();
    let ring: Vec<u16> = (0..count).map(|i| (drawn(i) >> 3) as u16).collect();
    PointCloud::new(column(0), column(1), column(2), intensity, time, ring).unwrap()
}

/// A sweep of a spinning sensor: column after column, the beams of which see walls at different distances.
fn swept(columns: usize, beams: usize, knows_beams: bool) -> PointCloud {
    let count = columns * beams;
    let place = |i: usize| {
        let (column, beam) = (i / beams, i % beams);
        let azimuth = column as f32 * 0.0035;
        let distance = 4.0 + (beam * 7 % beams) as f32 * 2.0 + (drawn(i) >> 59) as f32 * 1e-3;
        let up = (beam as f32 - beams as f32 / 2.0) * 0.02;
        [distance * azimuth.cos(), -distance * azimuth.sin(), distance * up]
    };
    let coordinate = |k: usize| (0..count).map(|i| place(i)[k]).collect::<Vec<f32>>();
    let ring: Vec<u16> = (0..count)
        .map(|i| if knows_beams { (i % beams) as u16 } else { 0 })
        .collect();
    let time: Vec<i32> = (0..count).map(|i| (i / beams) as i32 * 55_556 - 50_000_000).collect();
    let intensity: Vec<u8> = (0..count)
        .map(|i| (i % beams) as u8 * 2 + (drawn(i) >> 62) as u8)
        .collect();
    PointCloud::new(coordinate(0), coordinate(1), coordinate(2), intensity, time, ring).unwrap()
}

/// Half a step, and half of what separates the number that came back from the next one.
fn bound(step_m: f64, found: f32) -> f64 {
    let next = f32::from_bits(found.abs().to_bits() + 1);
    0.5 * step_m * (1.0 + 1e-9) + 0.5 * f64::from(next - found.abs())
}

fn assert_close(found: &PointCloud, sent: &PointCloud, config: &EncoderConfig) {
    assert_eq!(found.len(), sent.len());
    for (found, sent) in [(&found.x, &sent.x), (&found.y, &sent.y), (&found.z, &sent.z)] {
        for (i, (found, sent)) in found.iter().zip(&**sent).enumerate() {
            let error = (f64::from(*found) - f64::from(*sent)).abs();
            assert!(
                error <= bound(config.step_m, *found),
                "{i}: {found} for {sent}, {config:?}"
            );
        }
    }
    let zeros = |sent: bool| if sent { 1 } else { 0 };
    let time: Vec<i32> = sent.time.iter().map(|v| v * zeros(config.time)).collect();
    let ring: Vec<u16> = sent.ring.iter().map(|v| v * zeros(config.ring) as u16).collect();
    assert!(found.intensity == sent.intensity && *found.time == *time && *found.ring == *ring);
}

fn all_configs() -> impl Iterator<Item = EncoderConfig> {
    let flags = [(false, false), (true, false), (false, true), (true, true)];
    let zstd = [None, Some(1), Some(-7), Some(9)];
    [0.01, 0.001, 1.0].into_iter().flat_map(move |step_m| {
        zstd.into_iter().flat_map(move |zstd| {
            flags.map(|(time, ring)| EncoderConfig {
                time,
                ring,
                ..config(step_m, zstd, false)
            })
        })
    })
}

#[test]
fn points_come_back_in_their_order_within_half_a_step() {
    let one = scattered(1, 70.0);
    let clouds = [
        PointCloud::empty(),
        one,
        scattered(3, 1e3),
        scattered(1000, 1e-4),
        scattered(3000, 5e5),
        swept(120, 32, false),
        swept(120, 32, true),
    ];
    for config in all_configs() {
        let (mut encoder, mut decoder) = (Encoder::new(&config).unwrap(), Decoder::new(LIMIT).unwrap());
        for cloud in &clouds {
            let steps = &mut Steps::default();
            let (packet, dropped) = encoder.encode(&message(cloud.clone()), steps).unwrap();
            assert_eq!(dropped.points, 0);
            let chain = ["step", "delta", "shuffle"]
                .into_iter()
                .chain(config.zstd.map(|_| "zstd"));
            assert_eq!(packet.codec, chain.chain(["plain"]).collect::<Vec<_>>());
            let content = decoder.decode(&packet.bytes, steps).unwrap();
            let found = content
                .into_message(message(cloud.clone()).header, &packet.codec)
                .unwrap();
            let Payload::PointCloud(found) = found.payload else {
                panic!("not points")
            };
            assert_close(&found, cloud, &config);
        }
    }
}

#[test]
fn a_million_points_cross_and_equal_ones_take_no_bytes() {
    let usual = config(0.01, Some(1), true);
    let sent = scattered(1 << 20, 200.0);
    let (packet, _) = encoded(sent.clone(), &usual);
    assert_close(&decoded(&packet.bytes, LIMIT).unwrap(), &sent, &usual);
    let count = 1 << 20;
    let column = |v: f32| vec![v; count];
    let equal = PointCloud::new(
        column(-1.5),
        column(40.25),
        column(0.0),
        vec![9u8; count],
        vec![-7; count],
        vec![3u16; count],
    );
    let equal = equal.unwrap();
    let (packet, _) = encoded(equal.clone(), &usual);
    assert_eq!(packet.bytes.len(), ENVELOPE + 4 + 1 + 8 + 1 + 6 * 5);
    assert_close(&decoded(&packet.bytes, LIMIT).unwrap(), &equal, &usual);
}

#[test]
fn a_cloud_too_far_out_for_its_step_crosses_as_it_is() {
    // The largest f32 below 2³¹, and that number.
    for (far, quantised) in [(2_147_483_520.0f32, true), (2_147_483_648.0, false), (f32::MAX, false)] {
        for far in [far, -far] {
            let mut cloud = scattered(100, 5.0);
            let mut y = cloud.y.to_vec();
            y[17] = far;
            cloud.y = y.into();
            let config = config(1.0, Some(1), true);
            let (packet, _) = encoded(cloud.clone(), &config);
            let found = decoded(&packet.bytes, LIMIT).unwrap();
            assert_eq!(packet.codec.len() > 1, quantised, "{far}: {:?}", packet.codec);
            match quantised {
                true => assert_close(&found, &cloud, &config),
                false => assert_eq!(found, cloud),
            }
        }
    }
}

#[test]
fn points_that_are_not_finite_stay_behind_with_all_their_columns() {
    let mut cloud = swept(60, 16, false);
    let mut z = cloud.z.to_vec();
    (z[0], z[500]) = (f32::NAN, f32::NEG_INFINITY);
    cloud.z = z.into();
    let config = config(0.01, Some(1), true);
    let (packet, dropped) = encoded(cloud.clone(), &config);
    assert_eq!(dropped, 2);
    let kept: Vec<usize> = (1..500).chain(501..cloud.len()).collect();
    assert_close(&decoded(&packet.bytes, LIMIT).unwrap(), &pick(&cloud, &kept), &config);
}

/// Behind the envelope, the count, the flags and the step.
const LANES: usize = ENVELOPE + 4 + 1 + 8;

#[test]
fn beams_that_fire_in_turn_get_lanes_and_lines_do_not() {
    let config = config(0.01, Some(1), false);
    let size = |cloud: &PointCloud, lanes: u8| {
        let (packet, _) = encoded(cloud.clone(), &config);
        assert_eq!(packet.bytes[LANES], lanes);
        packet.bytes.len()
    };
    let reported = size(&swept(300, 32, true), 1);
    let guessed = size(&swept(300, 32, false), 1);
    let mut on_a_roof = swept(300, 32, false);
    on_a_roof.z = on_a_roof.z.iter().map(|z| z + 2.0).collect();
    let guessed = guessed.max(size(&on_a_roof, 1));
    // As beam by beam, where every point is beside the one before.
    let cloud = swept(300, 32, true);
    let by_beam: Vec<usize> = (0..32)
        .flat_map(|beam| (0..300).map(move |column| column * 32 + beam))
        .collect();
    let lines = size(&pick(&cloud, &by_beam), 0);
    assert!(
        reported < lines + lines / 5 && guessed < lines + lines / 5,
        "{reported}, {guessed}, {lines}"
    );
    size(&scattered(5000, 80.0), 0);
}

/// Three points at steps of 0.5 m with every column, not compressed.
fn small() -> Vec<u8> {
    let cloud = PointCloud::new(
        vec![1.0f32, -1.0, 150.2],
        vec![2.0f32; 3],
        vec![0.0f32, 0.25, 0.75],
        vec![10u8, 12, 9],
        vec![-5, 5, 5],
        vec![7u16, 7, 300],
    );
    encoded(cloud.unwrap(), &config(0.5, None, true)).0.bytes.to_vec()
}

#[test]
fn bytes_are_laid_out_as_documented() {
    let mut expected = vec![3, 0, 0, 0, 7];
    expected.extend(0.5f64.to_le_bytes());
    expected.push(0);
    // x: 2, -2, 300; y: 4, 4, 4; z: 0, 0 (midway, to the even one), 2.
    for (min, width) in [(-2i32, 2), (4, 0), (0, 1), (9, 1), (-5, 1), (7, 2)] {
        expected.extend(min.to_le_bytes());
        expected.push(width);
    }
    // x: 4, -4, 302; z: 0, 0, 2; intensity: 1, 2, -3; time: 0, 10, 0; ring: 0, 0, 293.
    expected.extend([8, 7, 604u16 as u8, 0, 0, 2]);
    expected.extend([0, 0, 4, 2, 4, 5, 0, 20, 0]);
    expected.extend([0, 0, 586u16 as u8, 0, 0, 2]);
    assert_eq!(small()[ENVELOPE..], expected);
    // As before there were steps.
    let cloud = PointCloud::new(
        vec![1.0f32],
        vec![2.0f32],
        vec![-0.5f32],
        vec![9u8],
        vec![7],
        vec![3u16],
    )
    .unwrap();
    let (packet, _) = encoded(cloud, &config(0.0, Some(1), false));
    assert_eq!(packet.codec, ["plain"]);
    assert_eq!(
        packet.bytes[ENVELOPE..],
        [1, 0, 0, 0, 0, 0, 0, 0x80, 0x3f, 0, 0, 0, 0x40, 0, 0, 0, 0xbf, 9]
    );
}

#[test]
fn fields_that_cannot_be_are_refused_by_name() {
    let bytes = small();
    let changed = |at: usize, with: &[u8]| {
        let mut bytes = bytes.clone();
        bytes[at..at + with.len()].copy_from_slice(with);
        refused(&bytes)
    };
    let flags = ENVELOPE + 4;
    assert!(changed(flags, &[16]).contains("`flags of the points`"));
    assert!(changed(flags, &[8]).contains("zstd of quantised points only"));
    for step in [0.0, -0.01, 1.5, 1e-7, f64::NAN, f64::INFINITY] {
        assert!(changed(flags + 1, &step.to_le_bytes()).contains("`step`"), "{step}");
    }
    assert!(changed(LANES, &[2]).contains("`lanes`"));
    assert!(changed(LANES, &[1]).contains("bytes end in `planes`"));
    assert!(changed(LANES + 5, &[5]).contains("`width of a column`"));
    for (column, width) in [(3, 2), (5, 3)] {
        let found = changed(LANES + 5 * (column + 1), &[width]);
        assert!(found.contains("`width of a column`"), "{column}: {found}");
    }
    // Not compressed, more points take more bytes; in memory, a point takes 19.
    assert!(changed(ENVELOPE, &[4]).contains("bytes end in `planes`"));
    assert!(changed(ENVELOPE, &[0xff; 4]).contains("`max_bytes`"));
    assert!(decoded(&bytes, 3 * 19).is_ok());
    let (count, size, limit) = (3, 57, 56);
    assert_eq!(decoded(&bytes, limit), Err(DecodeError::Points { count, size, limit }));
    for length in ENVELOPE..bytes.len() {
        assert!(matches!(
            decoded(&bytes[..length], LIMIT),
            Err(DecodeError::Truncated { .. })
        ));
    }
}

#[test]
fn a_frame_makes_exactly_one_byte_of_each_point() {
    let (packet, _) = encoded(scattered(300, 1.0), &config(0.01, Some(1), false));
    let sound = packet.bytes.to_vec();
    assert!(decoded(&sound, LIMIT).is_ok());
    for count in [299u32, 301, 1 << 20] {
        let mut bytes = sound.clone();
        bytes[ENVELOPE..ENVELOPE + 4].copy_from_slice(&count.to_le_bytes());
        let found = refused(&bytes);
        assert!(
            found.contains("`compressed plane`") && found.contains(&count.to_string()),
            "{found}"
        );
    }
    let first = LANES + 1 + 4 * 5;
    let mut bytes = sound.clone();
    bytes[first + 4] ^= 0xff;
    assert!(refused(&bytes).contains("`compressed plane`"));
    bytes[first..first + 4].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(refused(&bytes).contains("bytes end in `compressed plane`"));
}

#[test]
fn steps_that_are_none_are_refused() {
    for step_m in [-0.01, 1e-7, 1.1, f64::NAN, f64::INFINITY] {
        let error = Encoder::new(&config(step_m, None, false))
            .err()
            .expect("refused")
            .to_string();
        assert!(error.contains("`step_m`"), "{error}");
    }
}

#[test]
fn every_step_is_timed_by_its_name() {
    let clock: fn() -> i64 = || 0;
    let names = |steps: &mut Steps| steps.take().into_iter().map(|(name, _)| name).collect::<Vec<_>>();
    let ways = [
        (
            config(0.01, Some(1), true),
            vec!["packaging", "quantisation", "lanes", "prediction", "compression"],
            vec!["parsing", "decompression", "reconstruction"],
        ),
        (
            config(0.0, None, true),
            vec!["packaging", "quantisation", "serialisation"],
            vec!["parsing", "deserialisation"],
        ),
    ];
    for (config, encoding, decoding) in ways {
        let (mut encoder, mut steps) = (Encoder::new(&config).unwrap(), Steps::timed_by(clock));
        let (packet, _) = encoder.encode(&message(swept(60, 16, true)), &mut steps).unwrap();
        assert_eq!(names(&mut steps), encoding);
        let decoder = &mut Decoder::new(LIMIT).unwrap();
        decoder.decode(&packet.bytes, &mut steps).unwrap();
        assert_eq!(names(&mut steps), decoding);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn any_finite_cloud_comes_back_within_half_a_step(
        points in prop::collection::vec((any::<[f32; 3]>(), any::<u8>(), any::<i32>(), any::<u16>()), 0..200),
        power in -30i32..100,
        step_m in prop_oneof![Just(1.0), Just(0.01), Just(1e-6), 1e-6..1.0],
        zstd in prop_oneof![Just(None), Just(Some(1))],
        columns in any::<bool>(),
    ) {
        let finite = |v: f32| if v.is_finite() { v * 2f32.powi(-power) } else { 0.0 };
        let coordinate = |k: usize| points.iter().map(|point| finite(point.0[k])).collect::<Vec<f32>>();
        let intensity: Vec<u8> = points.iter().map(|point| point.1).collect();
        let time: Vec<i32> = points.iter().map(|point| point.2).collect();
        let ring: Vec<u16> = points.iter().map(|point| point.3).collect();
        let sent = PointCloud::new(coordinate(0), coordinate(1), coordinate(2), intensity, time, ring).unwrap();
        // Any bits, times any power of two: some are not finite any more.
        let kept: Vec<usize> = (0..sent.len())
            .filter(|i| [sent.x[*i], sent.y[*i], sent.z[*i]].iter().all(|v| v.is_finite()))
            .collect();
        let config = config(step_m, zstd, columns);
        let (packet, dropped) = encoded(sent.clone(), &config);
        prop_assert_eq!(dropped as usize, sent.len() - kept.len());
        assert_close(&decoded(&packet.bytes, LIMIT).unwrap(), &pick(&sent, &kept), &config);
    }

    #[test]
    fn changed_bytes_are_taken_or_refused(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
        compressed in any::<bool>(),
    ) {
        let cloud = swept(20, 16, true);
        let (packet, _) = encoded(cloud, &config(0.01, compressed.then_some(1), true));
        let mut bytes = packet.bytes.to_vec();
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if let Ok(cloud) = decoded(&bytes, LIMIT) {
            let lengths = [cloud.y.len(), cloud.z.len(), cloud.intensity.len(), cloud.time.len(), cloud.ring.len()];
            prop_assert!(lengths.iter().all(|length| *length == cloud.len()));
            prop_assert!(all_finite(&cloud.x) && all_finite(&cloud.y) && all_finite(&cloud.z));
        }
    }
}

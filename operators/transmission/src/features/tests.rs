use realo_schemas::{Header, Kind, Message, Packet};

use super::*;
use crate::{Decoder, Encoder, EncoderSettings};

const LIMIT: usize = 1 << 20;
const SHAPE: [usize; 3] = [6, 8, 5];
/// Bytes of the envelope of [`message`].
const ENVELOPE: usize = 2 + 3 + 16 + 1 + 4;
/// Bytes between it and what follows the model's name: shape, cell and origin, element type, name.
const HEAD: usize = 12 + 24 + 1 + 1 + 6;

/// Mostly empty, as behind a ReLU: channel 0 never is anything, channel 4 has both signs.
fn number(i: usize) -> f32 {
    let drawn = ((i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as f32 / (1u64 << 24) as f32;
    match i % SHAPE[2] {
        0 => 0.0,
        4 => 40.0 * (drawn - 0.5),
        _ => 9.0 * (drawn - 0.7).max(0.0),
    }
}

fn map_of(numbers: Vec<f32>) -> FeatureMap {
    FeatureMap {
        rows: SHAPE[0] as u32,
        columns: SHAPE[1] as u32,
        channels: SHAPE[2] as u32,
        cell: 0.8,
        origin: [-102.4, -40.0],
        dtype: DType::F32,
        data: Buffer::from_vec(numbers),
        model: "lite-0".into(),
        confidence: None,
    }
}

fn message(map: FeatureMap) -> Message {
    Message::new(
        Header::origin(&"r".into(), &"cav2".into(), Kind::Features, 3, 5, 8),
        map,
    )
}

fn numbers() -> Vec<f32> {
    (0..SHAPE.iter().product()).map(number).collect()
}

fn config(elements: Elements, shuffle: bool, zstd: Option<i32>) -> EncoderSettings {
    EncoderSettings {
        elements,
        shuffle,
        zstd,
        ..EncoderSettings::default()
    }
}

fn encoded(map: FeatureMap, config: &EncoderSettings) -> Result<(Packet, u64), EncodeError> {
    let (packet, dropped) = Encoder::new(config)?.encode(&message(map), &mut Steps::default())?;
    Ok((packet, dropped.range))
}

fn decoded(bytes: &[u8]) -> Result<FeatureMap, DecodeError> {
    let content = Decoder::new(LIMIT).unwrap().decode(bytes, &mut Steps::default())?;
    match content.payload {
        realo_schemas::Payload::FeatureMap(map) => Ok(map),
        other => panic!("{other:?}"),
    }
}

fn refused(bytes: &[u8]) -> String {
    decoded(bytes).expect_err("refused").to_string()
}

fn all_configs() -> impl Iterator<Item = EncoderSettings> {
    let zstd = [None, Some(1), Some(-7)];
    [Elements::F32, Elements::F16, Elements::Int8]
        .into_iter()
        .flat_map(move |elements| {
            [false, true]
                .into_iter()
                .flat_map(move |shuffle| zstd.map(|zstd| config(elements, shuffle, zstd)))
        })
}

#[test]
fn a_map_comes_back_within_what_its_elements_allow() {
    let sent = numbers();
    for config in all_configs() {
        let (packet, beyond) = encoded(map_of(sent.clone()), &config).unwrap();
        let steps = packet.codec.iter().map(String::as_str).collect::<Vec<_>>();
        let expected = match config.elements {
            Elements::F32 => vec![],
            Elements::F16 => vec!["f16"],
            Elements::Int8 => vec!["int8"],
        };
        let shuffled = config.shuffle.then_some("shuffle");
        let expected = expected
            .into_iter()
            .chain(shuffled)
            .chain(config.zstd.map(|_| "zstd"))
            .chain(["plain"]);
        assert_eq!(steps, expected.collect::<Vec<_>>());
        let found = decoded(&packet.bytes).unwrap();
        assert_eq!(
            found,
            FeatureMap {
                data: found.data.clone(),
                ..map_of(vec![])
            },
            "all but the numbers"
        );
        assert_eq!(beyond, 0);
        for (i, (found, sent)) in found.numbers().unwrap().iter().zip(&sent).enumerate() {
            let bound = match (config.elements, i % SHAPE[2]) {
                (Elements::F32, _) | (Elements::Int8, 0) => 0.0,
                (Elements::F16, _) => sent.abs() * 2f32.powi(-11),
                // Half of a 255th of the range, 40 and 2.7 at most.
                (Elements::Int8, 4) => 0.501 * 40.0 / 255.0,
                (Elements::Int8, _) => 0.501 * 2.7 / 255.0,
            };
            assert!((found - sent).abs() <= bound, "{config:?}: {found} for {sent}");
            assert!(
                *sent != 0.0 || i % SHAPE[2] == 4 || *found == 0.0,
                "an empty cell stays empty"
            );
        }
    }
}

#[test]
fn one_encoder_and_one_decoder_serve_maps_of_all_sizes() {
    let (mut encoder, mut decoder) = (
        Encoder::new(&EncoderSettings::default()).unwrap(),
        Decoder::new(LIMIT).unwrap(),
    );
    for rows in [6u32, 40, 1, 7, 40] {
        let numbers = (0..rows as usize * 40).map(number).collect();
        let map = FeatureMap {
            rows,
            ..map_of(numbers)
        };
        let (packet, _) = encoder.encode(&message(map.clone()), &mut Steps::default()).unwrap();
        let alone = encoded(map, &EncoderSettings::default()).unwrap().0;
        assert_eq!(packet, alone, "nothing stays of the map before");
        let content = decoder.decode(&packet.bytes, &mut Steps::default()).unwrap();
        assert_eq!(content.payload, decoded(&alone.bytes).unwrap().into());
    }
}

#[test]
fn maps_of_other_elements_cross_as_they_are() {
    for dtype in [DType::F16, DType::Bf16, DType::U8] {
        let data: Vec<u8> = (0..240 * dtype.size()).map(|i| (i % 100) as u8).collect();
        let map = FeatureMap {
            dtype,
            data: data.into(),
            ..map_of(vec![])
        };
        for config in all_configs() {
            let (packet, _) = encoded(map.clone(), &config).unwrap();
            assert_eq!(decoded(&packet.bytes).unwrap(), map, "{config:?}");
        }
    }
}

#[test]
fn every_step_is_timed_by_its_name() {
    let mut steps = Steps::timed_by(|| 0);
    let names = |steps: &mut Steps| steps.take().into_iter().map(|(step, _)| step).collect::<Vec<_>>();
    let sent = message(map_of(numbers()));
    let (packet, _) = Encoder::new(&EncoderSettings::default())
        .unwrap()
        .encode(&sent, &mut steps)
        .unwrap();
    let expected = ["packaging", "quantisation", "shuffling", "compression", "serialisation"];
    assert_eq!(names(&mut steps), expected);
    Decoder::new(LIMIT).unwrap().decode(&packet.bytes, &mut steps).unwrap();
    let expected = [
        "parsing",
        "deserialisation",
        "decompression",
        "unshuffling",
        "dequantisation",
    ];
    assert_eq!(names(&mut steps), expected);
}

#[test]
fn poisoned_maps_are_neither_sent_nor_taken() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut poisoned = numbers();
        poisoned[77] = bad;
        for config in all_configs() {
            let error = encoded(map_of(poisoned.clone()), &config).unwrap_err();
            assert_eq!(error, EncodeError::NotFinite("feature map"));
        }
        let sound = encoded(map_of(numbers()), &config(Elements::F32, false, None))
            .unwrap()
            .0;
        let mut bytes = sound.bytes.to_vec();
        let at = bytes.len() - 4 * (240 - 77);
        bytes[at..at + 4].copy_from_slice(&bad.to_le_bytes());
        assert!(refused(&bytes).contains("`elements`: expected finite numbers"));
    }
    let sound = encoded(map_of(numbers()), &config(Elements::F16, false, None))
        .unwrap()
        .0;
    let mut bytes = sound.bytes.to_vec();
    let at = bytes.len() - 1;
    bytes[at] = 0x7c;
    assert!(refused(&bytes).contains("`elements`: expected finite numbers"));
    let mut far = numbers();
    (far[3], far[8]) = (f32::MAX, -f32::MAX);
    let error = encoded(map_of(far), &EncoderSettings::default())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("channel 3 goes from") && error.contains("`elements=f32`"),
        "{error}"
    );
}

#[test]
fn features_beyond_half_precision_are_bounded_and_counted() {
    let mut great = numbers();
    (great[1], great[2]) = (1e6, -1e9);
    let (packet, beyond) = encoded(map_of(great), &config(Elements::F16, true, Some(1))).unwrap();
    let found = decoded(&packet.bytes).unwrap();
    assert_eq!(
        (beyond, &found.numbers().unwrap()[1..3]),
        (2, &[65_504.0, -65_504.0][..])
    );
}

#[test]
fn scales_that_no_encoder_makes_are_refused() {
    let packet = encoded(map_of(numbers()), &config(Elements::Int8, false, None))
        .unwrap()
        .0;
    let min = ENVELOPE + HEAD + 2;
    let step = min + 4 * SHAPE[2];
    let with = |at: usize, value: f32| {
        let mut bytes = packet.bytes.to_vec();
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        bytes
    };
    assert!(decoded(&with(min + 8, -3.0)).is_ok() && decoded(&with(step + 8, 0.5)).is_ok());
    for (at, value) in [
        (min, f32::NAN),
        (min, f32::INFINITY),
        (step, f32::NAN),
        (step, f32::INFINITY),
        (step, 0.0),
        (step, -0.5),
        (step, 1e38),
    ] {
        let error = refused(&with(at + 8, value));
        assert!(
            error.contains("`scale of a channel`") && error.contains("in channel 2"),
            "{value}: {error}"
        );
    }
}

#[test]
fn codes_and_flags_that_are_unknown_are_refused() {
    let packet = encoded(map_of(numbers()), &config(Elements::F32, false, None))
        .unwrap()
        .0;
    let changed = |at: usize, value: u8| {
        let mut bytes = packet.bytes.to_vec();
        bytes[at] = value;
        refused(&bytes)
    };
    let dtype = ENVELOPE + 12 + 24;
    assert!(changed(dtype, 4).contains("`element type`: expected 0 to 3, found 4"));
    assert!(changed(ENVELOPE + HEAD, 3).contains("`conversion`: expected 0 to 2, found 3"));
    assert!(
        changed(ENVELOPE + HEAD + 1, 8).contains("`flags of the elements`: expected known flags, found 0b00001000")
    );
    let halves = FeatureMap {
        dtype: DType::F16,
        data: vec![0u8; 480].into(),
        ..map_of(vec![])
    };
    let mut bytes = encoded(halves, &config(Elements::F32, false, None))
        .unwrap()
        .0
        .bytes
        .to_vec();
    bytes[ENVELOPE + HEAD] = 2;
    let error = refused(&bytes);
    assert!(
        error.contains("`conversion`") && error.contains("Int8 for F16"),
        "{error}"
    );
}

/// A packet whose shape and elements are forged.
fn forged(rows: u32, elements: &[u8]) -> Vec<u8> {
    let packet = encoded(map_of(numbers()), &config(Elements::Int8, true, Some(1)))
        .unwrap()
        .0;
    let mut bytes = packet.bytes[..ENVELOPE + HEAD + 2 + 8 * SHAPE[2]].to_vec();
    bytes[ENVELOPE..ENVELOPE + 4].copy_from_slice(&rows.to_le_bytes());
    bytes.extend((elements.len() as u32).to_le_bytes());
    bytes.extend(elements);
    bytes
}

#[test]
fn a_frame_makes_exactly_the_bytes_of_the_shape() {
    let zeros = |n: usize| zstd::bulk::compress(&vec![0; n], 1).unwrap();
    let row = SHAPE[1] * SHAPE[2];
    assert_eq!(decoded(&forged(6, &zeros(6 * row))).unwrap().data.len(), 4 * 6 * row);
    let bomb = zeros(64 << 20);
    assert!(bomb.len() < 10_000, "{} bytes for 64 MiB", bomb.len());
    let many = [zeros(3 * row), zeros(4 * row)].concat();
    let mut broken = zeros(6 * row);
    broken[5] ^= 0x55;
    for (what, elements) in [
        ("a bomb", bomb),
        ("a byte less", zeros(6 * row - 1)),
        ("a byte more", zeros(6 * row + 1)),
        ("two frames", many),
        ("a broken frame", broken),
        ("no frame", vec![]),
        ("other bytes", vec![7; 100]),
    ] {
        let error = refused(&forged(6, &elements));
        assert!(error.contains("expected a zstd frame of 240 bytes"), "{what}: {error}");
    }
    let cut = forged(6, &zeros(6 * row));
    assert!(refused(&cut[..cut.len() - 1]).contains("bytes end in `compressed elements`: "));
}

#[test]
fn a_shape_beyond_the_limit_is_refused_before_anything_is_made() {
    let zeros = zstd::bulk::compress(&[0; 40], 1).unwrap();
    for rows in [LIMIT as u32 / 160 + 1, u32::MAX] {
        let error = refused(&forged(rows, &zeros));
        assert!(
            error.contains("at most 1048576 are made (setting `max_bytes`)"),
            "{error}"
        );
        assert!(
            error.contains(&format!("takes {} bytes", u64::from(rows) * 160)),
            "{error}"
        );
    }
}

/// The map of [`numbers`], the surer of a cell the greater its number; of the first cell not at all.
fn unsure() -> FeatureMap {
    let confidence = (0..48).map(|cell| cell as f32 / 47.0);
    FeatureMap {
        confidence: Some(confidence.collect::<Vec<f32>>().into()),
        ..map_of(numbers())
    }
}

fn cells_there(map: &FeatureMap) -> Vec<usize> {
    let confidence = map.confidence.as_ref().expect("a map of some cells");
    (0..48).filter(|cell| confidence[*cell] > 0.0).collect()
}

#[test]
fn of_a_map_of_which_some_cells_cross_these_come_back_and_zeros() {
    for config in all_configs() {
        let config = EncoderSettings {
            min_confidence: 0.7,
            ..config
        };
        let mut encoder = Encoder::new(&config).unwrap();
        let (packet, dropped) = encoder.encode(&message(unsure()), &mut Steps::default()).unwrap();
        assert_eq!((dropped.cells, packet.codec[0].as_str()), (33, "cells"));
        let found = decoded(&packet.bytes).unwrap();
        assert_eq!(cells_there(&found), (33..48).collect::<Vec<_>>());
        for (found, sent) in found
            .confidence
            .iter()
            .flatten()
            .zip(unsure().confidence.iter().flatten())
        {
            assert!(*found == 0.0 || (found - sent).abs() < 1.0 / 255.0);
        }
        let kept = map_of(numbers()[33 * 5..].to_vec());
        let kept = FeatureMap {
            rows: 1,
            columns: 15,
            ..kept
        };
        let plain = EncoderSettings {
            min_confidence: 0.0,
            ..config.clone()
        };
        let expected = decoded(&encoded(kept, &plain).unwrap().0.bytes).unwrap();
        let (empty, there) = found.data.split_at(33 * 5 * 4);
        assert_eq!(
            there,
            expected.data.as_slice(),
            "{config:?}: as a map of these cells alone"
        );
        assert!(empty.iter().all(|byte| *byte == 0));
    }
}

#[test]
fn a_budget_holds_the_surest_cells_and_nearly_as_many_as_fit() {
    for config in all_configs() {
        let within = |budget: Option<usize>| {
            let config = EncoderSettings {
                budget_bytes: budget,
                min_confidence: if budget.is_none() { 1e-6 } else { 0.0 },
                ..config.clone()
            };
            let mut encoder = Encoder::new(&config).unwrap();
            let found = encoder.encode(&message(unsure()), &mut Steps::default());
            found.map(|(packet, _)| packet)
        };
        let all = within(None).unwrap().bytes.len();
        let most = cells_there(&decoded(&within(None).unwrap().bytes).unwrap());
        assert_eq!(most.len(), 47, "all but the one of which nothing is known");
        let mut before = 0;
        for budget in (ENVELOPE + HEAD + 60..all + 40).step_by(7) {
            let packet = within(Some(budget)).unwrap();
            assert!(
                packet.bytes.len() <= budget,
                "{config:?} {budget}: {}",
                packet.bytes.len()
            );
            let there = cells_there(&decoded(&packet.bytes).unwrap());
            assert_eq!(there, (48 - there.len()..48).collect::<Vec<_>>(), "the surest");
            let each = 5 * 4 + 1;
            let room = budget - packet.bytes.len();
            assert!(
                there.len() == 47 || room < 6 * each + 60,
                "{config:?} {budget}: room for {room} bytes"
            );
            assert!(
                there.len() + 5 >= before,
                "{config:?} {budget}: {} after {before}",
                there.len()
            );
            before = before.max(there.len());
        }
        assert!(before >= 46, "{config:?}: {before}");
        let error = within(Some(ENVELOPE + HEAD)).unwrap_err().to_string();
        assert!(error.contains("without any cell: expected a `budget_bytes`"), "{error}");
    }
    let config = EncoderSettings {
        budget_bytes: Some(100_000),
        ..EncoderSettings::default()
    };
    let error = encoded(map_of(numbers()), &config).unwrap_err().to_string();
    assert!(error.contains("confidence=true"), "{error}");
    let config = EncoderSettings {
        min_confidence: 1.5,
        ..EncoderSettings::default()
    };
    let error = Encoder::new(&config).err().expect("refused").to_string();
    assert!(
        error.contains("`min_confidence`: expected 0 to 1, found 1.5"),
        "{error}"
    );
}

#[test]
fn a_map_of_which_no_cell_is_sure_crosses_without_any() {
    for config in all_configs() {
        let config = EncoderSettings {
            min_confidence: 1.0,
            ..config
        };
        let doubtful = FeatureMap {
            confidence: Some(vec![0.25; 48].into()),
            ..unsure()
        };
        let (packet, _) = encoded(doubtful, &config).unwrap();
        let found = decoded(&packet.bytes).unwrap();
        assert_eq!((cells_there(&found), found.data.len()), (vec![], 960));
        assert!(found.data.iter().all(|byte| *byte == 0));
    }
}

#[test]
fn cells_that_are_not_as_many_as_a_packet_says_are_refused() {
    let config = EncoderSettings {
        min_confidence: 0.7,
        ..config(Elements::F32, false, None)
    };
    let packet = encoded(unsure(), &config).unwrap().0;
    let at = ENVELOPE + HEAD + 2;
    let changed = |at: usize, value: u8| {
        let mut bytes = packet.bytes.to_vec();
        bytes[at] = value;
        refused(&bytes)
    };
    assert!(
        changed(at, 49).contains("`number of cells that cross`: expected at most those of the map, found 49 of 48")
    );
    assert!(changed(at, 14).contains("`cells that cross`"));
    assert!(changed(at + 4, 1).contains("found 16 for 15 of 48"));
    assert!(changed(at + 4 + 6, 0).contains("`confidence of a cell`"));
    assert!(refused(&packet.bytes[..at + 8]).contains("bytes end in `cells that cross`"));
}

#[test]
fn levels_that_zstd_does_not_have_are_refused() {
    for level in [0, 20, -8, i32::MIN] {
        let error = Encoder::new(&config(Elements::F32, false, Some(level)))
            .err()
            .unwrap()
            .to_string();
        assert!(
            error.contains("`zstd`: expected") && error.contains("-7 to 19"),
            "{error}"
        );
    }
}

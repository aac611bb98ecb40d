//! Packets of real LiDARs: as many returns, with the same sums, as the makers' own drivers decode.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use realo_bags::packets::ouster::{Decoder, Format, Frame};
use realo_bags::{Bag, decoded, open, survey};
use realo_logs::cloud::decode;
use realo_schemas::PointCloud;

fn ouster(name: &str) -> Option<PathBuf> {
    Some(skipped::shared("data/packets/ouster")?.join(name))
}

/// The frames of a capture, by metadata.
fn frames(capture: &Path, metadata: &Path) -> Vec<Frame> {
    let format = Format::parse(&fs::read_to_string(metadata).unwrap()).unwrap();
    let bag = open(capture).unwrap();
    let lidar = bag
        .connections()
        .iter()
        .position(|connection| connection.topic == "/udp/7502")
        .unwrap();
    let mut messages = bag.messages(&BTreeSet::from([lidar])).unwrap();
    let (mut decoder, mut frames) = (Decoder::new(&format), Vec::new());
    while let Some(message) = messages.next().unwrap() {
        frames.extend(decoder.take(message.data()).unwrap());
    }
    frames.extend(decoder.finish());
    frames
}

fn place(frame: &Frame) -> [f64; 3] {
    [0, 1, 2].map(|axis| frame.returns.iter().map(|point| f64::from(point.at[axis])).sum())
}

/// The figures of the vendor's SDK 1.0.1.
#[test]
fn a_low_data_rate_frame_has_the_sums_of_the_sdk() {
    let Some(capture) = ouster("OS-1-128_v2.3.0_1024x10_first80.pcap") else {
        return;
    };
    let metadata = capture.with_file_name("OS-1-128_v2.3.0_1024x10.json");
    let found = frames(&capture, &metadata);
    assert_eq!(found.iter().map(|frame| frame.number).collect::<Vec<_>>(), [1795, 1796]);
    let whole = &found[0];
    assert_eq!(
        (whole.columns, whole.all_columns, whole.returns.len()),
        (1024, 1024, 107_647)
    );
    let sums = whole.sums;
    assert_eq!(
        (sums.range, sums.reflectivity, sums.near_ir),
        (1_695_188_032, 1_529_820, 91_845_616)
    );
    assert_eq!((whole.first, whole.last), (991_587_364_520, 991_687_215_910));
    for (found, expected) in place(whole).iter().zip([15_229.48, 205_214.69, 64_598.95]) {
        // Places are rounded to single precision, each by 4 µm at most.
        assert!((found - expected).abs() < 0.5, "{found} m, expected {expected} m");
    }
    let part = &found[1];
    assert_eq!(
        (part.columns, part.returns.len(), part.sums.range),
        (80, 5316, 107_384_688)
    );
}

#[test]
fn frames_of_two_returns_have_the_sums_of_their_first() {
    let Some(capture) = ouster("OS-1-128_767798045_1024x10_20230712_120049.pcap") else {
        return;
    };
    let found = frames(&capture, &capture.with_extension("json"));
    let [frame] = &found[..] else {
        panic!("{} frames", found.len())
    };
    assert_eq!((frame.number, frame.columns, frame.returns.len()), (229, 128, 16_373));
    let sums = frame.sums;
    assert_eq!(
        (sums.range, sums.reflectivity, sums.near_ir),
        (13_017_424, 840_760, 12_520_528)
    );
    let capture = capture.with_file_name("OS-0-32-U1_v2.2.0_1024x10-single-packet.pcap");
    let found = frames(&capture, &capture.with_file_name("OS-0-32-U1_v2.2.0_1024x10.json"));
    let [frame] = &found[..] else {
        panic!("{} frames", found.len())
    };
    assert_eq!(
        (frame.number, frame.columns, frame.returns.len(), frame.sums.range),
        (1453, 16, 223, 983_655)
    );
}

/// The clouds of the topic that is decoded from another, with their stamps and frames, and why some are none.
fn clouds(bag: &dyn Bag, topic: &str) -> (Vec<(i64, PointCloud)>, Vec<String>) {
    let place = bag
        .connections()
        .iter()
        .position(|connection| connection.topic == topic);
    let place = place.unwrap_or_else(|| panic!("{topic} is not among {:?}, {:?}", bag.connections(), bag.notes()));
    let mut messages = bag.messages(&BTreeSet::from([place])).unwrap();
    let (mut found, mut faults) = (Vec::new(), Vec::new());
    while let Some(message) = messages.next().unwrap() {
        match message.fault() {
            Some(fault) => faults.push(fault.to_string()),
            None => found.push(decode(message.data()).unwrap()),
        }
    }
    (found, faults)
}

#[test]
fn captures_have_topics_of_clouds_by_the_metadata_beside_them() {
    let Some(capture) = ouster("OS-1-128_v2.3.0_1024x10_first80.pcap") else {
        return;
    };
    let bag = decoded(open(&capture).unwrap()).unwrap();
    let (found, faults) = clouds(bag.as_ref(), "/udp/7502/points");
    let [(stamp, cloud)] = &found[..] else {
        panic!("{} clouds, {faults:?}", found.len())
    };
    assert_eq!(cloud.len(), 107_647);
    // The sensor counts from when it was switched on; the recorder's clock is that of the capture.
    let [first, last] = bag.span().unwrap();
    assert!(
        (first - 200_000_000..=last).contains(stamp),
        "{stamp} is not in {first} to {last}"
    );
    assert_eq!(cloud.time.iter().copied().min(), Some(0));
    assert_eq!(cloud.time.iter().copied().max(), Some(99_851_390));
    assert!(cloud.ring.contains(&127));
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert!(
        faults[0].contains("a sweep of 80 of 1024 columns, less than half"),
        "{faults:?}"
    );
    let shown = survey(bag.as_ref()).unwrap().to_string();
    assert!(
        shown.contains("`/udp/7502` is decoded as `/udp/7502/points`: RNG15_RFL8_NIR8 of OS-1-128 (128 × 1024)"),
        "{shown}"
    );
}

#[test]
fn a_bag_of_packets_has_its_metadata_in_itself() {
    let Some(bag) = skipped::shared("data/rosbag1/ouster_512x10_raw.bag") else {
        return;
    };
    let bag = decoded(open(&bag).unwrap()).unwrap();
    let topics: Vec<&str> = bag
        .connections()
        .iter()
        .map(|connection| connection.topic.as_str())
        .collect();
    let topic = topics.iter().find(|topic| topic.ends_with("/points"));
    let topic = topic.unwrap_or_else(|| panic!("{topics:?} {:?}", bag.notes()));
    let (found, faults) = clouds(bag.as_ref(), topic);
    assert!(
        !found.is_empty() && found.iter().all(|(_, cloud)| cloud.len() > 1000),
        "{} clouds, {faults:?}",
        found.len()
    );
}

#[test]
fn metadata_that_are_missing_or_of_a_profile_that_is_not_read_are_named() {
    let Some(capture) = ouster("OS-1-128_v2.3.0_1024x10_first80.pcap") else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("drive.pcap");
    fs::copy(&capture, &own).unwrap();
    let notes = || decoded(open(&own).unwrap()).unwrap().notes().join("\n");
    assert!(
        notes().contains("or in `") && notes().contains("drive.json` beside the file, found none"),
        "{}",
        notes()
    );
    let text = fs::read_to_string(capture.with_file_name("OS-1-128_v2.3.0_1024x10.json")).unwrap();
    for (from, to, named) in [
        (
            "RNG15_RFL8_NIR8",
            "RNG19_RFL8_SIG16_NIR16_ZONE16",
            "found `RNG19_RFL8_SIG16_NIR16_ZONE16`; play the packets",
        ),
        (
            "RNG15_RFL8_NIR8",
            "RNG19_RFL8_SIG16_NIR16",
            "expected packets of 24832 bytes for RNG19_RFL8_SIG16_NIR16 of 128 pixels",
        ),
        (
            "\"pixels_per_column\"",
            "\"pixels\"",
            "data_format.pixels_per_column: expected 1 to 4096, found null",
        ),
        (
            "\"lidar_origin_to_beam_origin_mm\"",
            "\"origin\"",
            "lidar_origin_to_beam_origin_mm: expected mm, found null",
        ),
        ("{", "[", "expected JSON"),
    ] {
        let changed = text.replacen(from, to, 1);
        assert_ne!(changed, text);
        fs::write(dir.path().join("drive.json"), changed).unwrap();
        assert!(notes().contains(named), "{named} is not in\n{}", notes());
    }
}

#[test]
fn cut_captures_are_read_up_to_the_cut() {
    let Some(capture) = ouster("OS-1-128_v2.3.0_1024x10_first80.pcap") else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let bytes = fs::read(capture).unwrap();
    let cut = dir.path().join("cut.pcap");
    let whole: u64 = 80;
    for end in [bytes.len() - 1, bytes.len() / 2, 30, 24] {
        fs::write(&cut, &bytes[..end]).unwrap();
        let bag = open(&cut).unwrap();
        let messages: u64 = bag.connections().iter().map(|connection| connection.messages).sum();
        assert!(messages < whole);
        assert_eq!(
            bag.notes()
                .iter()
                .any(|note| note.contains("the capture was cut at byte")),
            end > 24,
            "{end}"
        );
    }
    fs::write(&cut, [&[0x0a, 0x0d, 0x0d, 0x0a][..], &[0; 40]].concat()).unwrap();
    let error = open(&cut).err().unwrap().to_string();
    assert!(
        error.contains("a capture of the newer form; convert it by `editcap -F pcap"),
        "{error}"
    );
}

/// A point of the cloud that RoboSense's packets were decoded to by the driver of their origin.
struct Point {
    at: [f32; 3],
    intensity: u8,
    channel: u16,
}

fn points_of_the_origin(path: &Path) -> Vec<Point> {
    let bytes = fs::read(path).unwrap();
    let begin = bytes.windows(12).position(|part| part == b"DATA binary\n").unwrap() + 12;
    let float = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap());
    // x, y, z, intensity, return type, channel, azimuth, elevation, distance, time.
    let point = |row: &[u8]| Point {
        at: [0, 4, 8].map(|at| float(&row[at..at + 4])),
        intensity: row[12],
        channel: u16::from_le_bytes([row[14], row[15]]),
    };
    bytes[begin..].chunks_exact(32).map(point).collect()
}

#[test]
fn every_point_of_the_origins_driver_is_among_those_of_helios() {
    let Some(folder) = skipped::shared("data/packets/robosense_helios16p") else {
        return;
    };
    let bag = decoded(open(&folder).unwrap()).unwrap();
    let (found, faults) = clouds(bag.as_ref(), "/robosense_packets/points");
    assert_eq!((found.len(), faults.len()), (5, 0), "{faults:?}");
    let (stamp, cloud) = &found[0];
    assert_eq!(*stamp, 1_691_031_766_681_512_355, "when the first packet came");
    let last = cloud.time.iter().copied().max().unwrap();
    assert!((95_000_000..101_000_000).contains(&last), "{last}");
    let expected = points_of_the_origin(&folder.join("1691031766781547066_decoded.pcd"));
    assert_eq!(expected.len(), 15_258);
    // The origin's scan was cut anew: points of its beginning are of a later turn.
    let both: Vec<&PointCloud> = found.iter().take(2).map(|(_, cloud)| cloud).collect();
    let missing = expected
        .iter()
        .filter(|point| !both.iter().any(|cloud| has(cloud, point)));
    assert_eq!(missing.count(), 0);
}

fn has(cloud: &PointCloud, point: &Point) -> bool {
    // Channels count from below there; azimuths are rounded to hundredths of a degree.
    let ring = 15 - point.channel;
    let alike =
        (0..cloud.len()).filter(|index| cloud.ring[*index] == ring && cloud.intensity[*index] == point.intensity);
    alike.into_iter().any(|index| {
        let at = [cloud.x[index], cloud.y[index], cloud.z[index]];
        let apart = (0..3)
            .map(|axis| (at[axis] - point.at[axis]).powi(2))
            .sum::<f32>()
            .sqrt();
        let range = at.iter().map(|v| v * v).sum::<f32>().sqrt();
        apart < 0.003 + 3e-4 * range
    })
}

#[test]
fn packets_without_the_sensors_angles_are_not_read() {
    let Some(capture) = skipped::shared("data/packets/robosense_helios16p/helios16p_scan0_rewrapped.pcap") else {
        return;
    };
    let bag = decoded(open(&capture).unwrap()).unwrap();
    let connection = &bag.connections()[0];
    assert_eq!((connection.topic.as_str(), connection.messages), ("/udp/6699", 150));
    assert!(
        bag.notes()
            .iter()
            .any(|note| note.contains("packets of `/udp/6699` are not read")),
        "{:?}",
        bag.notes()
    );
}

/// A capture of packets of UDP over IP, each with the port that it is sent to.
fn capture_of(packets: &[(u16, Vec<u8>)]) -> Vec<u8> {
    let mut file = vec![
        0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff, 0, 0, 101, 0, 0, 0,
    ];
    for (index, (port, payload)) in packets.iter().enumerate() {
        let bytes = (payload.len() + 28) as u32;
        for word in [1_700_000_000, index as u32, bytes, bytes] {
            file.extend(word.to_le_bytes());
        }
        let mut ip = [0; 20];
        (ip[0], ip[9]) = (0x45, 17);
        file.extend(ip);
        for half in [5000, *port, payload.len() as u16 + 8, 0] {
            file.extend(half.to_be_bytes());
        }
        file.extend(payload);
    }
    file
}

/// The payloads of a real capture.
fn payloads(capture: &Path) -> Vec<(u16, Vec<u8>)> {
    let bag = open(capture).unwrap();
    let mut messages = bag.messages(&(0..bag.connections().len()).collect()).unwrap();
    let mut found = Vec::new();
    while let Some(message) = messages.next().unwrap() {
        let topic = &bag.connections()[message.connection].topic;
        found.push((topic["/udp/".len()..].parse().unwrap(), message.data().to_vec()));
    }
    found
}

#[test]
fn metadata_of_another_sensor_or_mode_are_refused_and_packets_that_came_twice_count_once() {
    let Some(capture) = ouster("OS-1-128_v2.3.0_1024x10_first80.pcap") else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("drive.pcap");
    let text = fs::read_to_string(capture.with_file_name("OS-1-128_v2.3.0_1024x10.json")).unwrap();
    let packets = payloads(&capture);
    fs::write(&own, capture_of(&packets)).unwrap();
    let opened = |metadata: &str| {
        fs::write(dir.path().join("drive.json"), metadata).unwrap();
        decoded(open(&own).unwrap()).unwrap()
    };
    // Packets of both are as long.
    let other = fs::read_to_string(capture.with_file_name("OS-0-32-U1_v2.2.0_1024x10.json")).unwrap();
    let notes = opened(&other).notes().join("\n");
    assert!(
        notes.contains("expected packets of the sensor 992137000142, whose metadata these are, found packets of the sensor 122201000998"),
        "{notes}"
    );
    for (columns, expected) in [
        ("512", "expected columns 0 to 511 of a turn, found"),
        ("2048", "expected columns 0 to 2047 of a turn, found none beyond 1023"),
    ] {
        let mode = text.replacen(
            "\"columns_per_frame\": 1024",
            &format!("\"columns_per_frame\": {columns}"),
            1,
        );
        assert_ne!(mode, text);
        let mode = mode.replacen("\"column_window\"", "\"window\"", 1);
        if columns == "2048" {
            let twice: Vec<_> = packets
                .iter()
                .cloned()
                .chain(packets.iter().cloned().map(later))
                .collect();
            fs::write(&own, capture_of(&twice)).unwrap();
        }
        let notes = opened(&mode).notes().join("\n");
        assert!(notes.contains(expected), "{notes}");
    }
    let bag = opened(&text.replacen("7109750", "7109751", 1));
    assert!(
        bag.decoded().join("\n").contains("OF ANOTHER START OF THE SENSOR"),
        "{:?}",
        bag.decoded()
    );
    assert!(bag.notes().is_empty(), "{:?}", bag.notes());
    let twice: Vec<_> = packets
        .iter()
        .flat_map(|packet| [packet.clone(), packet.clone()])
        .collect();
    fs::write(&own, capture_of(&twice)).unwrap();
    let bag = opened(&text);
    let said = bag.decoded().join("\n");
    assert!(said.contains("packets came before: each counts once"), "{said}");
    assert!(said.contains("`/udp/7503` is the port of the inertial unit"), "{said}");
    let (found, _) = clouds(bag.as_ref(), "/udp/7502/points");
    assert_eq!(found[0].1.len(), 107_647);
}

/// A packet of points of a later turn.
fn later((port, mut packet): (u16, Vec<u8>)) -> (u16, Vec<u8>) {
    packet[2] = packet[2].wrapping_add(10);
    (port, packet)
}

#[test]
fn packets_of_other_makers_in_captures_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("drive.pcap");
    let begins = |begin: &[u8], bytes: usize| {
        let mut packet = begin.to_vec();
        packet.resize(bytes, 0);
        packet
    };
    for (packet, maker) in [
        (begins(&[0x55, 0xaa, 0x05, 0x5a], 1248), "RoboSense"),
        (begins(&[0xff, 0xee], 1206), "Velodyne"),
        (begins(&[0xee, 0xff, 1, 4], 812), "Hesai"),
    ] {
        fs::write(&own, capture_of(&[(6699, packet)])).unwrap();
        let notes = decoded(open(&own).unwrap()).unwrap().notes().join("\n");
        assert!(notes.contains(&format!("they are of {maker}")), "{notes}");
        assert!(!notes.contains("metadata"), "{notes}");
    }
}

//! PCD files that lie about their fields, sizes and compression are clouds or errors, and take no more memory than their
//! size allows.
//!
//! `REALO_FUZZ_CASES=1000000 cargo test --release -p realo-importer --test fuzz` runs as many cases.

use damage::{Draw, cases, most_held};
use realo_importer::{PcdCloud, parse_pcd};

/// LZF makes 88 bytes of one; they are there unpacked, as columns, and while these grow.
fn bound(bytes: usize) -> u64 {
    (64 << 10) + 4 * 88 * bytes as u64
}

/// LZF of a few runs: literals, and copies from near and far.
fn lzf(draw: &mut Draw, values: &[u8]) -> Vec<u8> {
    let mut packed = Vec::new();
    let mut at = 0;
    while at < values.len() {
        let back = draw.pick(&[1, 4, 12, 100]);
        let mut same = 0;
        while at >= back && at + same < values.len() && same < 264 && values[at + same] == values[at + same - back] {
            same += 1;
        }
        if same < 3 {
            let run = (1 + draw.below(32)).min(values.len() - at);
            packed.push(run as u8 - 1);
            packed.extend(&values[at..at + run]);
            at += run;
            continue;
        }
        let (length, distance) = (same - 2, back - 1);
        if length < 7 {
            packed.push((length << 5 | distance >> 8) as u8);
        } else {
            packed.extend([(7 << 5 | distance >> 8) as u8, (length - 7) as u8]);
        }
        packed.push(distance as u8);
        at += same;
    }
    packed
}

/// A file in the making. Without lies it is a sound one of `points` points.
fn forge(draw: &mut Draw, lies: bool) -> (Vec<u8>, usize) {
    const FIELDS: [(&str, usize, &str); 7] = [
        ("x", 4, "F"),
        ("y", 4, "F"),
        ("z", 4, "F"),
        ("intensity", 1, "U"),
        ("intensity", 4, "F"),
        ("timestamp", 8, "F"),
        ("ring", 2, "U"),
    ];
    let mut fields = FIELDS[..3].to_vec();
    for _ in 0..draw.below(4) {
        let field = draw.pick(&FIELDS[3..]);
        // No sound file has a field twice.
        if lies || fields.iter().all(|(name, ..)| *name != field.0) {
            fields.push(field);
        }
    }
    let points = draw.pick(&[0, 1, 7, 200]);
    let size: usize = fields.iter().map(|(_, size, _)| size).sum();
    // Of such bytes all numbers are small: points of a sound file are near.
    let mask = if lies { 0xff } else { 0x3f };
    let mut values: Vec<u8> = (0..size * points).map(|i| (i / 13) as u8 & mask).collect();
    let lie = |draw: &mut Draw, truth: usize| match lies && draw.chance(12) {
        true => draw.length(truth as u64).to_string(),
        false => truth.to_string(),
    };
    if lies && draw.chance(6) {
        let wrong = draw.below(fields.len());
        fields[wrong] = draw.pick(&[
            ("x", 8, "F"),
            ("", 4, "F"),
            ("timestamp", 4, "F"),
            ("intensity", 0, "U"),
        ]);
    }
    let column =
        |cell: &mut dyn FnMut(&(&str, usize, &str)) -> String| fields.iter().map(cell).collect::<Vec<_>>().join(" ");
    let names = column(&mut |field| field.0.into());
    let sizes = column(&mut |field| lie(draw, field.1));
    let kinds = column(&mut |field| field.2.into());
    let count = if lies && draw.chance(20) { "COUNT 1 3 1\n" } else { "" };
    let said = lie(draw, points);
    let compressed = draw.chance(2);
    let data = if compressed { "binary_compressed" } else { "binary" };
    let data = if lies && draw.chance(30) { "ascii" } else { data };
    let mut out = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS {names}\nSIZE {sizes}\nTYPE {kinds}\n{count}WIDTH {points}\nHEIGHT 1\n\
         POINTS {said}\nDATA {data}\n"
    )
    .into_bytes();
    if compressed {
        let unpacked = values.len();
        let mut packed = lzf(draw, &values);
        if lies && draw.chance(4) {
            draw.damage(&mut packed);
        }
        let mut number = |truth: usize| match lies && draw.chance(12) {
            true => draw.length(truth as u64) as u32,
            false => truth as u32,
        };
        values = [number(packed.len()), number(unpacked)]
            .iter()
            .flat_map(|n| n.to_le_bytes())
            .collect();
        values.extend(packed);
    }
    out.extend(values);
    (out, points)
}

fn check(case: u64, bytes: &[u8]) -> Option<PcdCloud> {
    let mut cloud = None;
    let held = most_held(|| cloud = parse_pcd(bytes).ok());
    assert!(
        held <= bound(bytes.len()),
        "case {case} of {} bytes took {held} bytes",
        bytes.len()
    );
    if let Some(cloud) = &cloud {
        let n = cloud.x.len();
        assert_eq!(
            [cloud.y.len(), cloud.z.len(), cloud.intensity.len()],
            [n; 3],
            "case {case}"
        );
        assert!(
            cloud.timestamp.as_ref().is_none_or(|times| times.len() == n),
            "case {case}"
        );
        // Twelve bytes a point, packed or not.
        assert!(12 * n <= 88 * bytes.len(), "case {case}");
    }
    cloud
}

#[test]
fn forged_files_are_clouds_or_errors() {
    for seed in 0..200 {
        let (sound, points) = forge(&mut Draw::new(seed), false);
        assert_eq!(
            check(seed, &sound).expect("a sound file is read").x.len(),
            points,
            "seed {seed}"
        );
    }
    let (mut read, mut refused) = (0, 0);
    for case in 0..cases(50_000) {
        let mut draw = Draw::new(case);
        let (mut bytes, _) = forge(&mut draw, true);
        if draw.chance(3) {
            draw.damage(&mut bytes);
        }
        match check(case, &bytes) {
            Some(_) => read += 1,
            None => refused += 1,
        }
    }
    assert!(
        read > refused / 20 && refused > read / 20,
        "{read} read, {refused} refused"
    );
}

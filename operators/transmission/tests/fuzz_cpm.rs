//! CPMs that lie, cut, damaged or made up, are messages or errors; what is taken is sound and no more than their bytes can say,
//! and takes no more memory than their size allows.
//!
//! Seeds are the messages of `corpus/cpm`. `REALO_FUZZ_CASES=1000000 cargo test --release -p realo-transmission --test fuzz_cpm`
//! runs as many cases.

use std::path::Path;

use damage::{Draw, cases, most_held};
use realo_operator::Steps;
use realo_schemas::{Header, Message, Packet, Payload, geometry};
use realo_transmission::cpm::{Geodetic, received};
use realo_transmission::{BoxesLayout, Decoder, Encoder, EncoderConfig};

/// Smallest bits of an object that makes a box.
const OBJECT: usize = 8 * 14;

/// 255 objects decoded take 50 KB and their boxes as much, twice while the list grows. A length that somebody made up reserves an element
/// for every bit that is left at most, the largest of which takes 24 bytes.
fn bound(bytes: usize) -> u64 {
    (256 << 10) + (8 * 24 + 64) * bytes as u64
}

fn corpus() -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus/cpm");
    let files = std::fs::read_dir(folder).expect("the corpus");
    let mut files: Vec<_> = files.map(|file| file.unwrap().path()).collect();
    files.sort();
    files.iter().map(|path| std::fs::read(path).unwrap()).collect()
}

/// The message and the packet that it came in, with the origin of the map where the sender says that it is.
fn decode(bytes: &[u8], origins: &[Geodetic]) -> Option<(Message, Geodetic)> {
    let message = received(bytes, &"run".into(), 1, 0).ok()?;
    let (header, packet): (Header, Packet) = message.into_parts().ok()?;
    origins.iter().find_map(|origin| {
        let mut decoder = Decoder::new(1 << 20).ok()?.with_origin(*origin);
        let found = decoder.message(header.clone(), &packet, &mut Steps::default());
        Some((found.ok()?.0, *origin))
    })
}

/// Whether the bytes were taken.
fn check(case: u64, bytes: &[u8], origins: &[Geodetic]) -> bool {
    let mut found = None;
    let held = most_held(|| found = decode(bytes, origins));
    assert!(
        held <= bound(bytes.len()),
        "case {case} of {} bytes took {held} bytes",
        bytes.len()
    );
    let Some((message, origin)) = found else { return false };
    let Payload::Boxes(boxes) = &message.payload else {
        panic!("case {case}: not boxes")
    };
    assert!(boxes.0.iter().all(geometry::is_valid), "case {case}: {boxes:?}");
    let reported = OBJECT * boxes.0.len();
    assert!(reported <= 8 * bytes.len(), "case {case}: {} boxes", boxes.0.len());
    // What was taken can be sent on.
    let config = EncoderConfig {
        boxes: BoxesLayout::Cpm,
        origin,
        ..EncoderConfig::default()
    };
    let sent = Encoder::new(&config).unwrap().encode(&message, &mut Steps::default());
    match sent {
        Ok((packet, dropped)) => {
            assert_eq!(dropped.boxes, 0, "case {case}");
            let again = decode(&packet.bytes, &[origin]).expect("what was sent is accepted");
            let Payload::Boxes(again) = again.0.payload else {
                panic!("case {case}: not boxes")
            };
            let left_out = (dropped.out_of_range + dropped.surplus) as usize;
            assert_eq!(again.0.len() + left_out, boxes.0.len(), "case {case}");
        }
        Err(error) => panic!("case {case}: {error}"),
    }
    true
}

fn origins() -> Vec<Geodetic> {
    [
        "48.1374,11.5755,519",
        "-33.8688,-70.6693",
        "-17,179.9999",
        "52.3456789,13.456789",
        "0,0",
    ]
    .map(|text| Geodetic::try_from(text.to_string()).unwrap())
    .to_vec()
}

#[test]
fn forged_cpms_are_messages_or_errors() {
    let (corpus, origins) = (corpus(), origins());
    assert!(corpus.len() >= 9, "{} messages", corpus.len());
    for (case, bytes) in corpus.iter().enumerate() {
        assert!(
            check(case as u64, bytes, &origins),
            "message {case} of the corpus is taken"
        );
    }
    let (mut taken, mut refused) = (0, 0);
    for case in 0..cases(50_000) {
        let mut draw = Draw::new(case);
        let mut bytes = corpus[draw.below(corpus.len())].clone();
        match draw.below(8) {
            0 => {
                let other = &corpus[draw.below(corpus.len())];
                let (at, from) = (draw.below(bytes.len()), draw.below(other.len()));
                bytes.truncate(at);
                bytes.extend(&other[from..]);
            }
            // Random bytes, behind a header of a CPM or none.
            1 => {
                let keep = draw.pick(&[0, 2, 6, 30]);
                bytes.truncate(keep);
                bytes.extend((0..draw.below(600)).map(|_| draw.number() as u8));
            }
            // Lengths of lists are bits, which damage to whole bytes hardly makes greater.
            2 => {
                let (at, long) = (30 + draw.below(bytes.len() - 30), draw.below(4_000));
                bytes[at] = draw.pick(&[0xc4, 0xff, 0x7f, 0xbf]);
                bytes.extend((0..long).map(|_| draw.pick(&[0, 0xff, 0x55])));
            }
            // One bit of the containers.
            3 | 4 => {
                let at = 20 + draw.below(bytes.len() - 20);
                bytes[at] ^= 1 << draw.below(8);
            }
            _ => draw.damage(&mut bytes),
        }
        match check(case, &bytes, &origins) {
            true => taken += 1,
            false => refused += 1,
        }
    }
    assert!(
        taken > refused / 20 && refused > taken / 20,
        "{taken} taken, {refused} refused"
    );
}

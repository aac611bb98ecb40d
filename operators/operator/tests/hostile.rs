//! What a program sends is checked before it is used: no bytes panic, and none make the host take much memory.

#[path = "common/replies.rs"]
mod replies;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use arrow_buffer::Buffer;
use realo_operator::pipe::words::{Call, Reply, Told};
use realo_operator::pipe::{frame, hello, is_reading};
use realo_operator::{Argument, Describe, Error, Operator, Outputs, Port, PortId, Registration};
use realo_schemas::{Message, PayloadType};
use replies::{boxes, reply, whole};

/// Changed frames of each sort.
const CASES: usize = 4000;
/// What reading a frame may take at once, bytes; the frames have some thousands.
const MOST: usize = 4 << 20;

/// Remembers the biggest block that was asked for.
struct Watched;

static BIGGEST: AtomicUsize = AtomicUsize::new(0);

#[allow(unsafe_code)]
// SAFETY: every call goes to the system's allocator as it came.
unsafe impl GlobalAlloc for Watched {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        BIGGEST.fetch_max(layout.size(), Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        unsafe { System.dealloc(block, layout) }
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        BIGGEST.fetch_max(size, Ordering::Relaxed);
        unsafe { System.realloc(block, layout, size) }
    }
}

#[global_allocator]
static MEMORY: Watched = Watched;

struct Mine;

impl Describe for Mine {
    type Config = std::collections::BTreeMap<String, String>;
    const NAME: &'static str = "mine";
    const ABOUT: &'static str = "stands for a program";
    const ARGUMENTS: &'static [Argument] = &[];
    const INPUTS: &'static [Port] = &[Port::new("ego", &[PayloadType::Boxes], "own").latest().joined("frame")];
    const OUTPUTS: &'static [Port] = &[Port::new(
        "boxes",
        &[PayloadType::Boxes, PayloadType::PointCloud],
        "joint",
    )];
}

impl Operator for Mine {
    fn new(_: Self::Config) -> Result<Self, Error> {
        Ok(Mine)
    }

    fn on_input(&mut self, _: PortId, _: Message, _: &mut Outputs) -> Result<(), Error> {
        Ok(())
    }
}

/// A stream of numbers from a seed (SplitMix64).
struct Draw(u64);

impl Draw {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound.max(1) as u64) as usize
    }
}

/// Some changes of a frame: single bytes, words of lengths and offsets, cuts, and parts in other places.
fn changed(bytes: &[u8], draw: &mut Draw) -> Vec<u8> {
    const WORDS: [i64; 10] = [
        0,
        1,
        -1,
        7,
        i32::MAX as i64,
        i32::MIN as i64,
        u32::MAX as i64,
        1 << 40,
        i64::MAX,
        i64::MIN,
    ];
    let mut bytes = bytes.to_vec();
    for _ in 0..1 + draw.below(4) {
        let at = draw.below(bytes.len());
        match draw.below(6) {
            0 | 1 => bytes[at] = draw.next() as u8,
            2 | 3 => {
                let (size, word) = ([4, 8][draw.below(2)], WORDS[draw.below(WORDS.len())]);
                let at = at / 4 * 4;
                let end = bytes.len().min(at + size);
                bytes[at..end].copy_from_slice(&word.to_le_bytes()[..end - at]);
            }
            4 => bytes.truncate(at.max(1)),
            _ => {
                let part = bytes[at..bytes.len().min(at + 1 + draw.below(64))].to_vec();
                let to = draw.below(bytes.len());
                bytes.splice(to..to, part);
            }
        }
    }
    bytes
}

#[test]
fn changed_frames_are_errors_and_cost_little() {
    let print = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        // One that is caught within the reader is an error like any other.
        if !is_reading() {
            print(panic);
        }
    }));
    let registration = const { &Registration::operator::<Mine>() };
    let port = "ego".to_string();
    let message = Box::new(boxes("cav1", 2));
    type Reads = fn(Buffer) -> bool;
    let sorts: [(&str, Vec<u8>, Reads); 3] = [
        ("hello", whole(hello::write(registration, true)), |bytes| {
            hello::read(bytes).is_ok()
        }),
        ("reply", whole(reply(9).to_parts()), |bytes| {
            Reply::from_bytes(bytes).is_ok()
        }),
        ("call", whole(Call::Input { port, message }.to_parts(7)), |bytes| {
            Call::from_bytes(bytes).is_ok()
        }),
    ];
    for (name, bytes, read) in sorts {
        assert!(read(Buffer::from_vec(bytes.clone())), "{name}: as it was");
        let (mut draw, mut good) = (Draw(20), 0);
        for case in 0..CASES {
            let bytes = changed(&bytes, &mut draw);
            BIGGEST.store(0, Ordering::Relaxed);
            good += usize::from(read(Buffer::from_vec(bytes)));
            let biggest = BIGGEST.load(Ordering::Relaxed);
            assert!(biggest <= MOST, "{name}, case {case}: took {biggest} bytes at once");
        }
        println!("{name}: {good} of {CASES} changed frames still say something");
    }

    let mut stream = Vec::new();
    let parts = [Buffer::from_vec(vec![7u8; 100])];
    for _ in 0..3 {
        frame::write(&mut stream, &parts, false).expect("memory can be written");
    }
    let mut draw = Draw(21);
    for case in 0..CASES {
        let bytes = changed(&stream, &mut draw);
        let mut rest = bytes.as_slice();
        BIGGEST.store(0, Ordering::Relaxed);
        while let Ok(Some(_)) = frame::read(&mut rest) {}
        let biggest = BIGGEST.load(Ordering::Relaxed);
        assert!(biggest <= MOST, "frames, case {case}: took {biggest} bytes at once");
    }
}

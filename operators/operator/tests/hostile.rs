//! What a program sends is checked before it is used: no bytes panic, and none make the host take much memory.

#[path = "common/replies.rs"]
mod replies;

use arrow_buffer::Buffer;
use damage::{Draw, most_held};
use realo_operator::pipe::memory::Memory;
use realo_operator::pipe::words::{Call, Reply, Reported};
use realo_operator::pipe::{frame, hello, is_reading};
use realo_operator::{Describe, Error, Inputs, Operator, Outputs, Registration, Settings};
use realo_schemas::{Boxes, Header, Message};
use replies::{boxes, reply, whole};
use serde::{Deserialize, Serialize};

/// Changed frames of each sort.
const CASES: u64 = 4000;
/// What reading a frame may take, bytes; the frames have some thousands.
const MOST: u64 = 4 << 20;

/// Stands for a program.
#[derive(Describe)]
#[stage(settings = Nothing)]
struct Mine;

/// Nothing is to be set.
#[derive(Settings, Serialize, Deserialize)]
struct Nothing {}

/// What comes in.
#[derive(Inputs)]
enum Input {
    /// The ego's own.
    #[port(latest, joined("frame"))]
    Ego(#[allow(dead_code)] Header, #[allow(dead_code)] Boxes),
}

/// What it sends.
#[derive(Outputs)]
enum Output {
    /// Those of all.
    #[port(any_of(Boxes, PointCloud))]
    #[allow(dead_code)]
    Boxes(Message),
}

impl Operator for Mine {
    fn build(_: Nothing) -> Result<Self, Error> {
        Ok(Mine)
    }

    fn on_input(&mut self, _: Input, _: &mut Outputs<Output>) -> Result<(), Error> {
        Ok(())
    }
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
        ("hello", whole(hello::write(registration, &[], true)), |bytes| {
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
        let mut good = 0;
        for case in 0..CASES {
            let mut bytes = bytes.clone();
            Draw::new(case).damage(&mut bytes);
            let held = most_held(|| good += u64::from(read(Buffer::from_vec(bytes))));
            assert!(held <= MOST, "{name}, case {case}: took {held} bytes");
        }
        println!("{name}: {good} of {CASES} changed frames still say something");
    }

    let mut stream = Vec::new();
    let parts = [Buffer::from_vec(vec![7u8; 100])];
    for _ in 0..3 {
        frame::write(&mut stream, &parts, &Memory::default(), false).expect("memory can be written");
    }
    for case in 0..CASES {
        let mut bytes = stream.clone();
        Draw::new(case).damage(&mut bytes);
        let held = most_held(|| {
            let (mut rest, memory) = (bytes.as_slice(), Memory::default());
            while let Ok(Some(_)) = frame::read(&mut rest, &memory) {}
        });
        assert!(held <= MOST, "frames, case {case}: took {held} bytes");
    }
}

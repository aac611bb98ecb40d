//! An operator in a process of its own, driven over two pipes: how plug-ins take part in a run.
//!
//! The driver starts the program that the graph names, with the graph's settings, in the graph's folder, and with
//! `REALO_DRIVER=pipe` in its environment. It writes to the program's standard input and reads from its standard
//! output, so the program must print nothing else there; what it writes to standard error is passed on, and quoted if
//! it fails.
//!
//! Both directions carry frames: an Arrow IPC stream of one batch with one row. On the pipe lie numbers of 4 bytes, little
//! endian: the length of the stream, at most [`FRAME_LIMIT`]; how many files of the other side are given back, and
//! their numbers; then the stream. Of one above [`SHARED_FROM`] the length is 0xffffffff, and instead of the stream
//! follow three more numbers: the process that lends it, the number of an open file there, the length. That file is in
//! memory (`memfd_create`) and sealed against shrinking, so that its reader maps `/proc/PROCESS/fd/NUMBER`, once, and
//! copies nothing. The number stands for that file as long as its process runs; it is written again only after it was
//! given back. A hello, alike in all versions, is its length and the stream alone.
//!
//! A host that has such memory puts the place of some into the program's environment ([`MEMORY_VARIABLE`]: process, file,
//! length); only a program that can read it, and has some too, says `memfd` in its hello, and only then frames take this
//! way.
//!
//! | frame | direction | columns |
//! |---|---|---|
//! | hello | first from the program | `version` (u32), `name`, `memory` (`memfd` or `pipe`), `ports` (JSON: `role`, where it is not `operator`; `inputs` and `outputs`, each a list of `name`, `types`, `about`, for inputs also `queue`, `class`, `required`, `join`, `accounts`, `wire`, and for both `lane` and `map` (`size`: rows, columns, channels, null where any may come; `by`)) |
//! | refusal | in place of the hello | `version` (u32), `name`, `refused`: why the program hosts no stage, as wrong settings; it then exits with 1 |
//! | call | to the program | `call` (`input`, `wake` or `end`), `port`, `now` (i64, ns), for an input `message` (struct) |
//! | reply | one for each call | `error` (empty: none), `ports` (list), `message_0`, `message_1`, … (structs; one for each of `ports`), `wakes` (list of i64, ns), `counters` (list), `counts` (list of u64), `reported` (JSON: `fates` and `traffic`, what the operator says of messages that cross links; `losses`, by counter what is lost: `meaning`, `note`, `remedy`, `agents`) |
//!
//! Of a port only `name` and `types` are needed; all else may be left out, as `map`, which came within version 4: programs in Python and
//! those built before do not say it. A field that a host does not know is refused by name, so that neither a slip nor a newer program
//! is taken for what it is not. A field that a host must know to be right needs a new version.
//!
//! A message is a struct as [`realo_schemas::wire`] makes it; its `ready` is when the program wishes it to be sent. An
//! error in a reply belongs to one message and is counted; a program that exits, closes its output or answers
//! something else fails the run. After the reply to `end` its standard input is closed, and it exits with 0.
//!
//! A program may be a source or a sink of a graph in realtime, too. A source has no inputs; it is woken again and again, waits up to
//! 0.1 s for what comes from outside, replies with what came, and ends its streams by a reply without wakes. A sink has no outputs; it is
//! woken once, before its first input, to open what it needs.

pub mod frame;
pub mod hello;
pub mod memory;
mod row;
mod serve;
pub mod words;

pub use frame::{FRAME_LIMIT, FrameError, SHARED_FROM};
pub use row::is_reading;
pub use serve::serve;

/// The version of the protocol; both sides must have the same.
pub const VERSION: u32 = 4;

/// Is set to [`DRIVER`] for a program that is to serve the protocol.
pub const DRIVER_VARIABLE: &str = "REALO_DRIVER";

/// Names memory of the host, for a program to try whether it can read it.
pub const MEMORY_VARIABLE: &str = "REALO_MEMORY";

/// The value of [`DRIVER_VARIABLE`].
pub const DRIVER: &str = "pipe";

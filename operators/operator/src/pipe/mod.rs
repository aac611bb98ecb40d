//! An operator in a process of its own, driven over two pipes: how plug-ins take part in a run.
//!
//! The driver starts the program that the graph names, with the graph's arguments, in the graph's folder, and with
//! `REALO_DRIVER=pipe` in its environment. It writes to the program's standard input and reads from its standard
//! output, so the program must print nothing else there; what it writes to standard error is passed on, and quoted if
//! it fails.
//!
//! Both directions carry frames: the length as 4 bytes, little endian, at most [`FRAME_LIMIT`], then an Arrow IPC
//! stream of one batch with one row.
//!
//! | frame | direction | columns |
//! |---|---|---|
//! | hello | first from the program | `version` (u32), `name`, `ports` (JSON: `inputs` and `outputs`, each a list of `name`, `types`, `about`, for inputs also `queue`, `class`, `required`, `join`) |
//! | call | to the program | `call` (`input`, `wake` or `end`), `port`, `now` (i64, ns), for an input `message` (struct) |
//! | reply | one for each call | `error` (empty: none), `ports` (list), `message_0`, `message_1`, … (structs; one for each of `ports`), `wakes` (list of i64, ns), `counters` (list), `counts` (list of u64), `told` (JSON: `fates` and `traffic`, what the operator says of messages that cross links) |
//!
//! A message is a struct as [`realo_schemas::wire`] makes it; its `ready` is when the program wishes it to be sent. An
//! error in a reply belongs to one message and is counted; a program that exits, closes its output or answers
//! something else fails the run. After the reply to `end` its standard input is closed, and it exits with 0.

pub mod frame;
pub mod hello;
mod row;
mod serve;
pub mod words;

pub use frame::{FRAME_LIMIT, FrameError};
pub use serve::serve;

/// The version of the protocol; both sides must have the same.
pub const VERSION: u32 = 2;

/// Is set to [`DRIVER`] for a program that is to serve the protocol.
pub const DRIVER_VARIABLE: &str = "REALO_DRIVER";

/// The value of [`DRIVER_VARIABLE`].
pub const DRIVER: &str = "pipe";

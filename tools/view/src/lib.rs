//! Serves a page and the pictures of a run that goes on, over HTTP and WebSocket, to browsers on this machine.
//!
//! Who looks never slows what is shown: pictures go to a ring of bounded size; each client takes from it what it can, and who is
//! slow misses some. The server answers its own page alone: `Host` has to name this machine, and `Origin` the page's own address.
//! Whatever clients send or leave undone, memory is bounded: connections, threads, the size of heads and frames, and the time that
//! a client may take.
//!
//! HTTP is one GET, and WebSocket is one direction: both are written here, where these bounds can be seen.
//!
//! | module | what it gives |
//! |---|---|
//! | `address` | where to serve, as people write it |
//! | `head` | a request, and whether it is answered |
//! | `frames` | WebSocket: the handshake and its frames |
//! | `ring` | the newest pictures |
//! | `client` | one browser |
//! | `server` | all of them |

mod address;
mod client;
mod frames;
mod head;
mod ring;
mod server;

pub use address::{AddressError, address};
pub use server::{Server, ServerError};

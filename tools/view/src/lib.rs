//! Serves a page and the pictures of a run that goes on, over HTTP and WebSocket, to browsers on this machine; and its messages to
//! Foxglove's viewers.
//!
//! Who looks never slows what is shown: pictures go to a ring of bounded size; each client takes from it what it can, and who is
//! slow misses some. The server answers its own page alone: `Host` has to name this machine, and `Origin` the page's own address.
//! Whatever clients send or leave undone, memory is bounded: connections, threads, the size of heads and frames, and the time that
//! a client may take.
//!
//! HTTP is one GET, and of WebSocket a client says little: both are written here, where these bounds can be seen.
//!
//! | module | what it gives |
//! |---|---|
//! | `address` | where to serve, as people write it |
//! | `head` | a request, and whether it is answered |
//! | `frames` | WebSocket: the handshake and its frames |
//! | `ring` | the newest pictures |
//! | `client` | one browser |
//! | `server` | all of them |
//! | `foxglove` | channels of messages, for viewers of Foxglove's protocol |
//! | `listening` | connections, within bounds |

mod address;
mod awaited;
mod client;
mod foxglove;
mod frames;
mod head;
mod listening;
mod ring;
mod server;

pub use address::{AddressError, address, address_at};
pub use foxglove::{Foxglove, Session};
pub use listening::{ServerError, from_elsewhere};
pub use server::Server;

//! Two machines in one: network namespaces that are joined by a link with a rate, a delay, jitter, loss, copies and a bounded
//! queue.
//!
//! Where the kernel has no netem, packets are carried in user space between two TUN devices. It needs Linux, `/dev/net/tun`, `ip` of
//! iproute2, and root (CAP_NET_ADMIN) or a user namespace ([`Ground`]). Where there is neither, a [`Relay`] on loopback has the link's
//! rate, delay and cuts for TCP. On a busy machine delays grow by what threads have to wait.
//!
//! ```no_run
//! let link = linkemu::Link::default();
//! link.set("rate", 27.0);
//! link.set("delay", 20.0);
//! let machines = linkemu::Machines::join("car", "roadside", link.into())?;
//! machines.command(0, "hostname").status()?; // 10.9.0.1; the other is 10.9.0.2
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod clock;
mod ground;
mod interrupt;
mod link;
mod machines;
mod relay;
mod tun;

pub use ground::Ground;
pub use interrupt::Interrupts;
pub use link::{Counts, Link, Unit};
pub use machines::{ADDRESSES, Error, Machines};
pub use relay::Relay;

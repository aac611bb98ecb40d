//! The link between agents: a channel model on the true bytes of packets, and the range gate before it.
//!
//! | port | direction | types | meaning |
//! |---|---|---|---|
//! | `ego_state` | in, all, state | EgoState | where the ego is |
//! | `states` | in, all, state | EgoState | where the others are |
//! | `ego` | in, all, optional | Packet | what the ego sends |
//! | `others` | in, all, optional | Packet | what the others send |
//! | `to_ego` | out | Packet | the others' packets, delivered to the ego |
//! | `to_others` | out | Packet | the ego's packets, a copy for each other agent that is known |
//! | `report` | out | Report | topic `link`: what crossed each channel, at the end |
//!
//! Delivered packets name their receiver in `header.to`; their `ready` is the time of sending plus the delay, exact in
//! nanoseconds. Others are known once their state or a packet of theirs came in, the ego by the argument `ego` or once
//! its own state or packet did; what comes in for nobody counts as `no_receiver`.
//!
//! **Range gate**: a packet is sent if the newest known positions of the two agents lie at most `range_m` apart in
//! (x, y). It acts before `sent`. Packets for the ego wait until their sender has told a position, offline until the ego has
//! too, at most 16 of each sender; their delay counts from when they were sent all the same. A packet of which a position
//! is unknown then is out of range too, and the counter `unplaced` says how many they were. There is always a gate; a
//! `range_m` as large as the map lets everything through that is placed.
//!
//! **Profiles** are TOML or YAML files; `perfect` (default: everything arrives at once) and `paper` are built in:
//! ```toml
//! about = "A shared 20 Mbit/s channel"  # one line
//! [default]                      # for kinds without a table of their own; all keys may be left out
//! fixed_ms = 2.0                 # delay whatever the size
//! bits_per_second = 20_000_000   # plus 8 × bytes / this
//! jitter = { gaussian_ms = 1.5 } # plus N(0, σ); uniform_ms = w: plus U(-w, w); the sum is never below 0
//! loss = 0.02                    # probability that a packet is lost
//! duplicate = 0.0                # probability that one more copy arrives, with a jitter of its own
//! [kinds.boxes]                  # points, features, boxes, ego_state
//! fixed_ms = 10.0
//! ```
//! Draws hash (key of the seed, from, to, kind, seq), so no order of events changes them.

mod channel;
mod draw;
mod operator;
mod profile;

pub use channel::{Arrivals, transmit};
pub use draw::{Draws, StreamKey};
pub use operator::{Link, LinkConfig};
pub use profile::{BUILT_IN, Jitter, Model, Profile, ProfileError};

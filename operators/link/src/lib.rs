//! The link between agents: a channel model on the true bytes of packets, and the range gate before it.
//!
//! Delivered packets name their receiver in `header.to`; their `ready` is the time of sending plus the delay, exact in
//! nanoseconds. Others are known once their state or a packet of theirs came in, the ego by the setting `ego` or once
//! its own state or packet did; what comes in for nobody counts as `no_receiver`.
//!
//! **Range gate**: a packet is sent if the newest known positions of the two agents lie at most `range_m` apart in
//! (x, y). It acts before `sent`. Packets for the ego wait until their sender has reported a position, offline until the ego has
//! too, at most 16 of each sender; their delay counts from when they were sent all the same. A packet of which a position
//! is unknown then is out of range too, and the counter `unplaced` says how many they were. There is always a gate; a
//! `range_m` as large as the map lets everything through that is placed.
//!
//! **Profiles** are TOML or YAML files; `perfect` (default: everything arrives at once), `paper` and `cv2x-measured` are built in:
//! ```toml
//! about = "A shared 20 Mbit/s channel"  # one line
//! [default]                      # for kinds without a table of their own; all keys may be left out
//! fixed_ms = 2.0                 # delay whatever the size
//! bits_per_second = 20_000_000   # plus 8 × bytes / this
//! jitter = { gaussian_ms = 1.5 } # plus N(0, σ); uniform_ms = w: plus U(-w, w); the sum is never below 0
//! step_ms = 0.0                  # cuts delays down to multiples of this; 0: not at all
//! loss = 0.02                    # probability that a packet is lost
//! duplicate = 0.0                # probability that one more copy arrives, with a jitter of its own
//! [kinds.boxes]                  # points, features, boxes, agent_state
//! fixed_ms = 10.0
//! [channel]                      # what all packets share; without it each crosses as if it was alone
//! bits_per_second = 27_000_000   # or trace = "drive.csv", with lines seconds,bits_per_second,delay_ms,loss
//! queue_ms = 100.0               # a packet that would wait longer for those before it is lost
//! half_duplex = true             # all ways between agents are one; false: each for itself
//! ```
//! **What a sender is told.** For each packet to the ego the output `on_air` says when it had left its sender, and no more than that
//! sender's own radio knows: the packet's bytes and time on the channel, how busy the channel was since the one before, or that the
//! queue was full. Without a channel bytes take no time.
//!
//! # Draws
//! A draw depends on seed, sender, receiver, kind and seq of the message and on its own number, so no order of events
//! changes it. All words have 64 bits, are read little endian and wrap around.
//!
//! - The *key* is the first word that ChaCha with 8 rounds makes (block 0, nonce 0) of the 32 bytes: the seed (8 bytes),
//!   then the stream's name `link`, filled with zeros.
//! - *mix(w)*: w += `9e3779b97f4a7c15`; w = (w ^ w >> 30) × `bf58476d1ce4e5b9`; w = (w ^ w >> 27) × `94d049bb133111eb`;
//!   w ^ w >> 31 (SplitMix64, Steele et al. 2014).
//! - *hash*: begins as the key; for each word w it becomes mix(hash ^ w). The words are, for each of the texts from, to and
//!   kind, the text's length in bytes and its bytes, 8 to a word, the last filled with zeros; then seq; then the draw's
//!   number n.
//! - Draw n is *u(n)* = (hash >> 11) / 2⁵³, in [0, 1).
//!
//! A packet is lost if u(0) < `loss`. One more copy of a packet that is not lost arrives if u(1) < `duplicate`. The packet's
//! jitter takes the draws from n = 16 on, the copy's those from n = 20 on: with w = `uniform_ms` and σ = `gaussian_ms` it
//! is w (2 u(n) - 1) + σ √(-2 ln(1 - u(n + 1))) cos(2π u(n + 2)) ms (Box and Muller).
//!
//! A packet of a link with a channel first waits until those before it on its way have crossed, and crosses at the channel's rate; all
//! else is added to that. It is lost if u(0) < 1 - (1 - `loss`) (1 - the channel's loss when it has crossed).
//!
//! The delay is the sum of `fixed_ms`, 8 × bytes / `bits_per_second` (at most a day) and the jitter, each rounded to whole
//! ns (halves away from 0), but not below 0; then cut down to a multiple of `step_ms`, if there is one.

mod channel;
mod inline;
mod medium;
mod operator;
mod profile;

pub use channel::{Arrivals, delay, transmit};
pub use inline::{in_words, with_base};
pub use medium::{Medium, Passed, Phase};
pub use operator::{Link, Settings, in_reach};
pub use profile::{BUILT_IN, Channel, Jitter, Model, Profile, ProfileError, files};

//! What goes out when, and what came in: a state machine for each peer, without socket or clock.
//!
//! Of each kind only the newest message waits. Boxes, poses and all else that is *small* goes out at once. *Bulk*, points and
//! features, goes in parts under a window of bytes that are not acknowledged yet, so that what stands in queues on the way,
//! which small messages share, stays below [`Settings::queue`] of time. A message that cannot arrive before its deadline does
//! not begin, and where several kinds carry the same moment, only the richest that arrives in time goes.
//!
//! ```text
//! offer -> slot of its kind -> transfer, part by part -> [window] -> frame -> network -> frame -> Receiver -> message
//!                                                           ^------------- acknowledgement --------------'
//! ```
//!
//! Times are ns of a clock of one's own that never steps; only differences of the peer's times are used.

mod frame;
mod receiver;
mod sender;
mod transfer;
mod window;

pub use frame::{ACKNOWLEDGEMENT_BYTES, Acknowledgement, Frame, FrameError, HEAD_BYTES, Head};
pub use receiver::{Arrived, Received, Receiver, ReceiverCounts};
pub use sender::{Offer, Outcome, Report, Sender, Settings};
pub use window::Window;

use realo_schemas::Kind;

/// Whether messages of a kind go out in parts, under the window.
pub fn is_bulk(kind: Kind) -> bool {
    matches!(kind, Kind::Points | Kind::Features)
}

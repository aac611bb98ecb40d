//! The feature bank: holds what collaborators sent, of any payload, and answers each message of the ego with what to
//! fuse. Online nobody waits for a collaborator, unless the graph gives the bank patience.
//!
//! **Online** a query takes, of each sender, the message of newest stamp that was ready when the query was, unless it
//! is older than the window (age = the query's ready - the message's stamp).
//! With `patience_ms` a query of whose senders one is due (a whole number of its periods after its newest message came, at
//! most the patience before or after the query) waits until all those have sent a newer one, the next query comes, or the
//! patience ends, and then takes the newest that are there. A sender's period is the difference of stamps of its newest
//! message and of the one that was the newest before, by that of their seq; one whose newest is older than the window is
//! not waited for, and a message that comes after a newer one changes no period and ends no wait. A patient bank's query
//! that does not wait, since nobody is due or its patience is over when its turn comes, takes what is there then, not only
//! what was when it was ready. Ages, and the window, count to when the query was ready all the same. Offline nobody has
//! patience.
//!
//! **Offline** it takes the message of smallest |difference in stamp| within ±50 ms (tie: the earlier one), and is answered
//! 50 ms after its stamp.
//!
//! **Several forms**: where agents send points and boxes of the same moments, a bank of points and one of boxes follow each other,
//! and the first one's selections are `fused` for the second: who is in the one for a seq already is in the ego's message of that seq
//! and is skipped by its query here.
//!
//! **Limit**: of each sender 16 messages are held. Where one more comes, that of the oldest stamp makes room (of one
//! stamp the one that came first), which may be the one that came; no query takes it any more. So a query that has waited
//! for its turn may find nothing of a sender of which 16 newer messages have come since. Online what made room is
//! superseded, unless a query took it before; offline later queries still say which of the fates below it has.
//!
//! Every message that enters `others` departs exactly once. Of one that was in a Selection the fusion says what became;
//! of any other the bank says its fate, the first that fits:
//!
//! | fate | meaning |
//! |---|---|
//! | `stale` | too old when a query asked its sender: online beyond the window, offline more than 50 ms before the query and never within reach of one; its sender was never `fused` when one did |
//! | `superseded` | online a newer one of its sender was there before any query, offline a nearer one was taken; or its sender was `fused` |
//! | `rejected` | it came before the first query, which has another payload |
//! | `in_flight` | held at the end, and no query had asked for it |
//!
//! Copies of a message that was seen before (same agent, kind, seq and stamp among the sender's last 64) count as
//! `repeated` and the ego's own messages as `from_ego`; neither is held nor departs. A sender that starts its seq
//! afresh is welcome as long as its stamps go on. A message from the future (setting `ahead_ms`) or of one agent too
//! many (setting `max_agents`), and one whose payload is not that of the queries, is an error, hence rejected.

mod bank;
mod operator;
mod sender;

pub use bank::{Answer, Bank, BankError, Taken};
pub use operator::{FeatureBank, Settings};

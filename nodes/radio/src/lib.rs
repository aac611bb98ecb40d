//! Packets between agents on different machines, fresh on links that are slow, lossy and shared.
//!
//! [`protocol`] decides what goes out when, without socket or clock.

pub mod protocol;

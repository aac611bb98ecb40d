//! All that an operator needs: the trait, ports, settings, outputs, and the pipe protocol of plug-ins.
//!
//! - [`macro@Describe`], [`macro@Settings`], [`macro@Inputs`], [`macro@Outputs`]: derives by which a stage says its name,
//!   settings and ports.
//! - [`Operator`], [`Source`], [`Sink`], [`Gateway`]: what a stage implements; [`Port`] its contract.
//! - [`Counter`]: what a stage counts, declared with the note that a count above 0 makes.
//! - [`Outputs`]: what an operator hands to its driver, and what it says of messages that cross links; [`Steps`] time parts
//!   of a call.
//! - [`Registration`]: an operator whose type is no longer known; [`Registry`] what a binary hosts.
//! - [`StreamKey`]: random draws that depend on what they are for alone.
//! - [`run`], [`run_as`]: the whole `main` of a plug-in; [`pipe`] is what it speaks.

// Derived code names this crate from outside.
extern crate self as realo_operator;

mod books;
pub mod config;
mod counter;
mod draw;
mod operator;
pub mod pipe;
mod port;
mod registry;
mod run;
mod settings;
mod steps;
mod typed;

pub use books::{Books, Durations, InputBooks, NodeBooks, Tally};
pub use counter::{Counter, Counts, Loss, Meaning, Share};
pub use draw::{Draws, StreamKey};
pub use operator::{AnyOutput, Describe, Error, Gateway, Made, Operator, Outputs, Sink, Source, Waker};
pub use port::{Class, KnownMap, Port, PortId, Queue, Side, WrongType};
pub use realo_operator_derive::{Describe, Inputs, Outputs, Settings};
pub use registry::{AnyGateway, AnyOperator, AnySink, AnySource, Built, Registration, Registry, Role};
// What derived code names.
#[doc(hidden)]
pub use realo_schemas::{Message, PayloadType};
pub use run::{run, run_as};
pub use settings::{SettingInfo, StageSettings};
pub use steps::Steps;
pub use typed::{NoInput, NoOutput, PortError, PortPayload, StageInputs, StageOutputs};

//! What threads of a host share.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard};
use std::time::Duration;

use dora_node_api::dora_core::config::DataId;
use dora_node_api::{DoraNode, MetadataParameters, NodeResult};
use realo_clock::wall_now;
use realo_engine::{Engine, Leaving};
use realo_operator::{Built, PortId};
use realo_schemas::{Message, Nanos, wire};

use super::LINGER;
use super::outbox::Outbox;
use crate::Tap;
use crate::dora::HostError;
use crate::dora::inbox::WakeHandle;
use crate::dora::load::Load;
use crate::dora::marks::{End, Hello};
use crate::stages::Tapped;

/// `None` once the process has left dora.
pub(super) type Sender = Option<DoraNode>;

/// What all threads of the process share.
pub(crate) struct Shared {
    pub id: String,
    pub(super) state: Mutex<State>,
    /// There may be a call to make.
    pub(super) work: Condvar,
    pub(super) outbox: Outbox<Leaving, Sender>,
    /// Wall time of the last message.
    pub(super) last_sent: AtomicI64,
    pub(super) exits: BTreeMap<(usize, PortId), Vec<DataId>>,
    pub(super) wake: WakeHandle,
    /// Who watches the run, and the outputs that are seen.
    pub(super) tap: Option<Tap>,
    pub(super) tapped: Tapped,
}

pub(crate) struct State {
    pub engine: Engine,
    /// Without those that are being called.
    pub(super) built: Vec<Option<Built>>,
    pub(super) load: Load,
    /// When the dora thread looks around again, in wall time.
    pub(super) next_poll: Nanos,
    pub(super) failed: Option<HostError>,
    pub(super) over: bool,
}

impl State {
    /// Says once which stage does not keep up.
    pub(super) fn report_load(&mut self) {
        let State { engine, load, .. } = self;
        let slow = load.slow(|stage| engine.skipped(stage), |stage| engine.id(stage).to_string());
        if let Some(slow) = slow {
            eprintln!("{}", slow.to_line());
        }
    }

    /// The log's time, 0 while no message has brought the clock.
    pub fn log_now(&self) -> Nanos {
        self.engine.clock().map_or(0, |clock| clock.log_at(wall_now()))
    }

    pub(super) fn wall_at(&self, log: Nanos) -> Nanos {
        self.engine.clock().map_or(0, |clock| clock.wall_at(log))
    }
}

impl Shared {
    pub fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// Whether threads are to stop.
    pub fn is_over(&self) -> bool {
        let state = self.lock();
        state.over || state.failed.is_some()
    }

    /// After something has changed: prints, and wakes whoever has something to do.
    pub fn follow(&self, state: &mut State, now: Nanos) {
        for line in state.engine.take_complaints() {
            eprintln!("realo: {line}");
        }
        match state.engine.next_due() {
            Some(due) if due <= now => self.work.notify_one(),
            Some(due) if state.wall_at(due) < state.next_poll => self.wake.give(),
            _ => {}
        }
    }

    /// Puts what leaves the process into the outbox.
    pub fn post(&self, state: &mut State) {
        let leaving = state.engine.take_leaving();
        if let Some(tap) = &self.tap {
            for Leaving { stage, port, message } in &leaving {
                if let Some(output) = self.tapped.get(&(*stage, *port)) {
                    tap.see(*output, message);
                }
            }
        }
        self.outbox.post(leaving);
    }

    /// Sends what is in the outbox.
    pub fn send_posted(&self) -> Result<(), HostError> {
        self.outbox
            .send_all(|sender, Leaving { stage, port, message }| self.send(sender, (stage, port), &message))
    }

    /// Sends a mark on every output.
    pub fn send_hello(&self) -> Result<(), HostError> {
        let clock = self.lock().engine.clock();
        let hello = Hello.to_message(clock);
        let mut sender = self.outbox.sender();
        self.exits
            .keys()
            .try_for_each(|exit| self.send(&mut sender, *exit, &hello))
    }

    fn send(&self, sender: &mut Sender, exit: (usize, PortId), message: &Message) -> Result<(), HostError> {
        self.last_sent.store(wall_now(), Ordering::Relaxed);
        self.give_dora(sender, exit, |node, output| {
            node.send_output(output, MetadataParameters::new(), wire::to_arrow(message))
        })
    }

    pub(super) fn end(&self, exit: (usize, PortId), end: &End) -> Result<(), HostError> {
        self.give_dora(&mut self.outbox.sender(), exit, |node, output| {
            node.send_output_sample(output, end.to_parameters(), None)
        })
    }

    fn give_dora(
        &self,
        sender: &mut Sender,
        exit: (usize, PortId),
        mut send: impl FnMut(&mut DoraNode, DataId) -> NodeResult<()>,
    ) -> Result<(), HostError> {
        let Some(node) = sender else { return Ok(()) };
        for output in self.exits.get(&exit).into_iter().flatten() {
            send(node, output.clone()).map_err(|error| HostError::Dora {
                id: self.id.clone(),
                reason: error.to_string(),
            })?;
        }
        Ok(())
    }

    /// Leaves dora, some time after the last message.
    pub(super) fn leave(&self) {
        let left = self.last_sent.load(Ordering::Relaxed) + LINGER - wall_now();
        std::thread::sleep(Duration::from_nanos(u64::try_from(left).unwrap_or(0)));
        let node = self.outbox.sender().take();
        drop(node);
    }

    /// Lets the dora thread look around.
    pub fn wake(&self) {
        self.wake.give();
    }

    pub fn fail(&self, error: HostError) {
        self.fail_in(self.lock(), error);
    }

    pub(super) fn fail_in(&self, mut state: MutexGuard<State>, error: HostError) {
        state.failed.get_or_insert(error);
        self.work.notify_all();
        self.wake.give();
    }
}

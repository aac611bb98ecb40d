//! A stage of the engine: what waits for it, which servers are busy, and how far it has ended.

use std::collections::{BTreeMap, BTreeSet};

use realo_operator::{NodeBooks, PortId, Role};
use realo_schemas::report::Fated;
use realo_schemas::{Name, Nanos};

use crate::Wiring;
use crate::intake::Intake;
use crate::stage::Stage;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Life {
    Open,
    Ending,
    Ended,
}

/// One stage, as the engine sees it.
pub(super) struct Running {
    pub stage: Stage,
    pub intake: Intake,
    /// Until when each server is busy.
    pub busy: BTreeMap<Name, Nanos>,
    /// Wakes that were asked for and have not come yet.
    pub wakes: BTreeSet<(Nanos, Name)>,
    /// Wakes that came while their server was busy.
    pub late_wakes: BTreeSet<(Nanos, Name)>,
    pub consumers: Vec<Vec<(usize, PortId)>>,
    pub leaves: Vec<bool>,
    /// By output and by input: when the last message on it is ready.
    pub last_out: Vec<Nanos>,
    pub last_in: Vec<Nanos>,
    pub open_inputs: usize,
    /// Whether one of its inputs has ended.
    pub ends_early: bool,
    /// Of a sink: fates that it has not seen yet.
    pub fates: Vec<Fated>,
    pub life: Life,
}

impl Running {
    pub(super) fn new(wiring: &Wiring, index: usize) -> Self {
        let wired = &wiring.stages[index];
        let registration = wired.registration;
        let fed: Vec<bool> = wired.inputs.iter().map(Option::is_some).collect();
        let outputs = registration.outputs.len();
        let awaited = fed
            .iter()
            .zip(registration.inputs)
            .filter(|(fed, port)| **fed && !port.feedback);
        Running {
            stage: Stage::new(wired.id.clone(), registration),
            ends_early: false,
            open_inputs: awaited.count(),
            intake: Intake::new(registration.inputs, fed),
            busy: BTreeMap::new(),
            wakes: BTreeSet::new(),
            late_wakes: BTreeSet::new(),
            consumers: (0..outputs).map(|o| wiring.consumers(index, PortId(o))).collect(),
            leaves: wired.leaves.clone(),
            last_out: vec![Nanos::MIN; outputs],
            last_in: vec![Nanos::MIN; registration.inputs.len()],
            fates: Vec::new(),
            life: Life::Open,
        }
    }

    pub(super) fn role(&self) -> Role {
        self.stage.registration.role
    }

    pub(super) fn is_free(&self, server: &str, now: Nanos) -> bool {
        self.busy.get(server).is_none_or(|until| *until <= now)
    }

    pub(super) fn has_nothing_left(&self, now: Nanos) -> bool {
        let idle = self.intake.is_idle() && self.wakes.is_empty() && self.late_wakes.is_empty();
        let open = self.life == Life::Open && self.role() != Role::Source;
        open && self.open_inputs == 0 && idle && self.busy.values().all(|until| *until <= now)
    }

    pub(super) fn has_ended(&self, output: usize) -> bool {
        self.life == Life::Ended || self.is_closed(output)
    }

    /// Whether an output ended before its stage.
    pub(super) fn is_closed(&self, output: usize) -> bool {
        self.ends_early && self.stage.registration.outputs[output].ends_early
    }

    /// Which outputs have ended.
    pub(super) fn ended_outputs(&self) -> Vec<bool> {
        (0..self.consumers.len()).map(|output| self.has_ended(output)).collect()
    }

    pub(super) fn own_books(&self) -> NodeBooks {
        let inputs = self.intake.books().iter();
        NodeBooks {
            inputs: inputs.map(|(port, books)| (port.to_string(), books.clone())).collect(),
            ..self.stage.books.clone()
        }
    }
}

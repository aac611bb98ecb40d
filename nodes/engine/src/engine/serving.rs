//! Which call of a stage comes next: the oldest of its inputs and wakes, and at last its end.

use realo_operator::{Books, PortId, Role};
use realo_schemas::report::{Fate, Fated};
use realo_schemas::{Message, Name, Nanos};

use super::running::Life;
use super::{END, Engine, EngineError, Servers, Task, Ticket};
use crate::event::Order;
use crate::intake::Work;
use crate::stage::{Call, crossings, reported};

impl Engine {
    pub(super) fn server_of(&self, message: &Message) -> Name {
        match self.servers {
            Servers::PerStream => match &message.header.to {
                Some(to) => format!("{} > {to}", message.header.agent).into(),
                None => message.header.agent.clone(),
            },
            Servers::One => Name::default(),
        }
    }

    pub(super) fn arrive(&mut self, stage: usize, port: PortId, message: Message) -> Result<(), EngineError> {
        let server = self.server_of(&message);
        let running = &mut self.stages[stage];
        let input = &running.stage.registration.inputs[port.0];
        if input.feedback && running.life != Life::Open {
            return Ok(());
        }
        let admitted = input.admit(&message);
        admitted.map_err(|wrong| EngineError::Type {
            node: running.stage.id.to_string(),
            wrong,
        })?;
        let offered = running.intake.offer(&server, port, message);
        offered.map_err(|overflow| EngineError::Overflow {
            node: running.stage.id.to_string(),
            overflow,
        })?;
        self.skip_waiting(stage);
        self.open.push_back((stage, server));
        Ok(())
    }

    /// Says of messages over links that a stage will never be given that it passed them over.
    pub(super) fn skip_waiting(&mut self, stage: usize) {
        let gone = self.stages[stage].intake.take_skipped();
        let fates: Vec<Fated> = gone
            .iter()
            .flat_map(|message| reported(crossings(message), Fate::Skipped))
            .collect();
        if !fates.is_empty() {
            self.report(fates);
        }
    }

    /// The next call for a server that is free, or the stage's end.
    pub(super) fn serve(&mut self, stage: usize, server: &Name, now: Nanos) -> Option<Task> {
        let running = &mut self.stages[stage];
        if !running.is_free(server, now) {
            return None;
        }
        let wake = running.late_wakes.iter().find(|(_, of)| of == server).cloned();
        let wake_first = match (&wake, running.intake.first(server)) {
            (Some((at, _)), Some((ready, class))) => (*at, Order::Wake) < (ready, class.into()),
            (wake, None) => wake.is_some(),
            (None, Some(_)) => false,
        };
        if let (Some(wake), true) = (wake, wake_first) {
            running.late_wakes.remove(&wake);
            return Some(self.task(stage, server, now, now, "wake", Call::Wake));
        }
        if let Some(Work { ready, calls }) = running.intake.next(server) {
            let cause = running.stage.registration.inputs[calls[0].0.0].name;
            return Some(self.task(stage, server, now, ready, cause, Call::Inputs(calls)));
        }
        self.last_call(stage, now)
    }

    pub(super) fn task(
        &mut self,
        stage: usize,
        server: &Name,
        start: Nanos,
        input: Nanos,
        cause: &'static str,
        call: Call,
    ) -> Task {
        let running = &mut self.stages[stage];
        running.busy.insert(server.clone(), Nanos::MAX);
        Task {
            ticket: Ticket {
                stage,
                start,
                cause,
                server: server.clone(),
                input,
            },
            call,
            fates: std::mem::take(&mut running.fates),
        }
    }

    /// The end of a stage that has nothing left to do. Sinks end last, with the books of all others.
    pub(super) fn last_call(&mut self, stage: usize, now: Nanos) -> Option<Task> {
        let others_ended = || {
            let mut others = self.stages.iter().filter(|running| running.role() != Role::Sink);
            others.all(|running| running.life == Life::Ended)
        };
        let running = &self.stages[stage];
        let is_sink = running.role() == Role::Sink;
        if !running.has_nothing_left(now) || (is_sink && !others_ended()) {
            return None;
        }
        self.stages[stage].intake.close();
        self.skip_waiting(stage);
        let running = &mut self.stages[stage];
        running.life = Life::Ending;
        let mut books = Box::new(Books::default());
        if is_sink {
            *books = self.books.clone();
            let own = self.stages[stage].own_books();
            books.nodes.insert(self.stages[stage].stage.id.to_string(), own);
        }
        Some(self.task(stage, &Name::default(), now, now, END, Call::End(books)))
    }
}

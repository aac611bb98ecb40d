use realo_operator::{PortId, Registration};
use realo_schemas::Name;

/// Stages and the wires between them, in topological order.
#[derive(Clone, Default)]
pub struct Wiring {
    /// Every stage comes after those that feed it, but for feedback.
    pub stages: Vec<Wired>,
}

/// One stage of a [`Wiring`].
#[derive(Clone)]
pub struct Wired {
    /// Id in the graph.
    pub id: Name,
    /// What it is.
    pub registration: &'static Registration,
    /// For each declared input what feeds it.
    pub inputs: Vec<Option<Feed>>,
    /// Which outputs somebody outside of these stages takes.
    pub leaves: Vec<bool>,
}

/// What feeds an input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Feed {
    /// An output of a stage (index in [`Wiring::stages`]).
    Stage(usize, PortId),
    /// Somebody outside of these stages.
    Outside,
}

impl Wiring {
    /// Adds a stage; `inputs` are (port, source stage id, source port).
    ///
    /// # Errors
    /// Names a port or source that does not exist (sources must be added first).
    pub fn add(
        &mut self,
        id: &str,
        registration: &'static Registration,
        inputs: &[(&str, &str, &str)],
    ) -> Result<(), String> {
        let mut wired = vec![None; registration.inputs.len()];
        for (port, source, output) in inputs {
            let (PortId(index), _) = input_of(id, registration, port)?;
            let from = self.stages.iter().position(|stage| *stage.id == **source);
            let from = from.ok_or_else(|| format!("node `{id}`: input `{port}` comes from unknown node `{source}`"))?;
            let output_port = self.stages[from].registration.output(output);
            let (output, _) = output_port.ok_or_else(|| format!("node `{source}` has no output `{output}`"))?;
            wired[index] = Some(Feed::Stage(from, output));
        }
        self.stages.push(Wired {
            id: id.into(),
            registration,
            inputs: wired,
            leaves: vec![false; registration.outputs.len()],
        });
        Ok(())
    }

    /// Wires an input of feedback of a stage that was added; its source may come after it.
    ///
    /// # Errors
    /// Names a stage or port that does not exist.
    pub fn feed_back(&mut self, id: &str, port: &str, source: &str, output: &str) -> Result<(), String> {
        let of = |id: &str| {
            let found = self.stages.iter().position(|stage| *stage.id == *id);
            found.ok_or_else(|| format!("no stage `{id}`"))
        };
        let (to, from) = (of(id)?, of(source)?);
        let (PortId(index), _) = input_of(id, self.stages[to].registration, port)?;
        let made = self.stages[from].registration.output(output);
        let (output, _) = made.ok_or_else(|| format!("node `{source}` has no output `{output}`"))?;
        self.stages[to].inputs[index] = Some(Feed::Stage(from, output));
        Ok(())
    }

    /// Lets somebody outside feed an input of the stage that was added last.
    ///
    /// # Errors
    /// Names a port that does not exist.
    pub fn feed_from_outside(&mut self, port: &str) -> Result<(usize, PortId), String> {
        let index = self.stages.len().checked_sub(1).ok_or("no stage was added")?;
        let stage = &mut self.stages[index];
        let (port, _) = input_of(&stage.id, stage.registration, port)?;
        stage.inputs[port.0] = Some(Feed::Outside);
        Ok((index, port))
    }

    /// The inputs (stage, port) that an output feeds, in order of stages and ports.
    pub fn consumers(&self, from: usize, output: PortId) -> Vec<(usize, PortId)> {
        let edges = self.stages.iter().enumerate().flat_map(|(stage, wired)| {
            let fed = move |(port, source): (usize, &Option<Feed>)| {
                (*source == Some(Feed::Stage(from, output))).then_some((stage, PortId(port)))
            };
            wired.inputs.iter().enumerate().filter_map(fed)
        });
        edges.collect()
    }
}

impl Feed {
    /// Whether somebody outside feeds the input.
    pub fn is_outside(self) -> bool {
        self == Feed::Outside
    }
}

fn input_of(
    id: &str,
    registration: &'static Registration,
    port: &str,
) -> Result<(PortId, &'static realo_operator::Port), String> {
    let known = || registration.inputs.iter().map(|port| port.name).collect::<Vec<_>>();
    registration.input(port).ok_or_else(|| {
        format!(
            "node `{id}`: {} has no input `{port}`; it has: {}",
            registration.name,
            known().join(", ")
        )
    })
}

//! A graph as a picture: processes in layers from left to right, in each its stages from top to bottom, modules as frames
//! around stages, groups as frames around processes, and every wire from an output to an input.
//!
//! - [`svg()`]: for a page, dark or light as the reader's system is.
//! - [`text()`]: for a terminal of any width.
//!
//! A picture of a [`Diagram`] depends on nothing else, so it is the same on every machine.

mod blocks;
mod canvas;
mod column;
mod layers;
mod listing;
mod overview;
mod picture;
mod svg;
#[cfg(test)]
mod tests;

pub use listing::{Terminal, text};
pub use picture::{BoxAt, FrameAt, Picture, PortAt, Rect, WireAt, picture};
pub use svg::svg;

/// A graph, as far as it is drawn.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Diagram {
    /// What it is, in a line.
    pub title: String,
    /// What else there is to say, a line each.
    pub about: Vec<String>,
    /// Groups of processes, one below the other.
    pub groups: Vec<Group>,
    /// What the system starts.
    pub processes: Vec<Process>,
    /// Their stages; those of one process keep their order where no wire says otherwise.
    pub stages: Vec<Stage>,
    /// From outputs to inputs.
    pub wires: Vec<Wire>,
}

/// Processes that belong together.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Group {
    /// Its name.
    pub name: String,
    /// What holds it together, such as a module or a machine.
    pub what: String,
}

/// A process and the stages in it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Process {
    /// Its name.
    pub name: String,
    /// What it runs.
    pub what: String,
    /// Whether it is its only stage, and bears its name.
    pub is_stage: bool,
    /// Index of the group that it is in.
    pub group: Option<usize>,
}

/// A stage of a process.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Stage {
    /// Index of its process.
    pub process: usize,
    /// Names of the modules around it within the process, the outermost first.
    pub modules: Vec<String>,
    /// Its name within them.
    pub name: String,
    /// What it runs.
    pub what: String,
    /// What a run measured of it, a line each.
    pub facts: Vec<String>,
    /// Its inputs that are wired.
    pub inputs: Vec<Port>,
    /// Its outputs that somebody takes.
    pub outputs: Vec<Port>,
}

/// An input or output of a stage.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Port {
    /// Its name.
    pub name: String,
    /// The payload types of an output, as `Boxes`.
    pub payload: String,
    /// What a run measured of its arrow.
    pub facts: String,
    /// Whether `facts` has a loss.
    pub lost: bool,
    /// Who feeds an input that no stage does.
    pub from: String,
}

/// A port of a stage, by index.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct End {
    /// Index of the stage.
    pub stage: usize,
    /// Index of the port among its inputs or outputs.
    pub port: usize,
}

/// An output and an input that takes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wire {
    /// The output.
    pub from: End,
    /// The input.
    pub to: End,
    /// Whether it brings a stage word of what it sent itself.
    pub feedback: bool,
}

impl Diagram {
    /// The process of a stage.
    fn process_of(&self, end: End) -> usize {
        self.stages[end.stage].process
    }

    /// The band of each process: groups are bands one below the other, in their order, and whoever is in none comes last.
    fn bands(&self) -> Vec<usize> {
        let band = |process: &Process| process.group.unwrap_or(self.groups.len());
        self.processes.iter().map(band).collect()
    }

    /// Whether both ends are in one process.
    fn is_inside(&self, wire: &Wire) -> bool {
        self.process_of(wire.from) == self.process_of(wire.to)
    }

    /// A stage by its process and all modules around it; a process that is a stage is named once.
    pub fn name_of(&self, stage: usize) -> String {
        let process = &self.processes[self.stages[stage].process];
        match process.is_stage {
            true => process.name.clone(),
            false => format!("{}.{}", process.name, self.inner_name(stage)),
        }
    }

    /// A stage by the modules around it within its process.
    fn inner_name(&self, stage: usize) -> String {
        let Stage { modules, name, .. } = &self.stages[stage];
        modules.iter().chain([name]).cloned().collect::<Vec<_>>().join(".")
    }
}

use realo_schemas::report::Fated;
use realo_schemas::{Clock, Message, Nanos};
use serde_json::Value;

use crate::config::{ConfigError, defaults, did_you_mean, nearest_name, parse};
use crate::{
    Books, Counter, Counts, Error, Gateway, KnownMap, NoInput, NoOutput, Operator, Outputs, Port, PortId, SettingInfo,
    Sink, Source, StageInputs, StageOutputs, StageSettings, Waker,
};

/// What a node is to its graph.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Pure stage.
    Operator,
    /// Node that brings messages in.
    Source,
    /// Node that takes messages out.
    Sink,
    /// Node that exchanges messages with the world outside.
    Gateway,
}

/// An [`Operator`] whose type is no longer known.
pub trait AnyOperator: Send {
    /// See [`Operator::on_input`].
    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error>;
    /// See [`Operator::on_wake`].
    fn on_wake(&mut self, now: Nanos, out: &mut Outputs) -> Result<(), Error>;
    /// See [`Operator::on_end`].
    fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error>;
}

impl<O: Operator + Send> AnyOperator for O {
    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        out.of_stage(|out| Operator::on_message(self, port, message, out))
    }
    fn on_wake(&mut self, now: Nanos, out: &mut Outputs) -> Result<(), Error> {
        out.of_stage(|out| Operator::on_wake(self, now, out))
    }
    fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error> {
        out.of_stage(|out| Operator::on_end(self, out))
    }
}

/// A [`Gateway`] whose type is no longer known.
pub trait AnyGateway: Send {
    /// See [`Gateway::open`].
    fn open(&mut self, waker: Waker) -> Result<(), Error>;
    /// Its calls, which are those of an operator.
    fn stage(&mut self) -> &mut dyn AnyOperator;
}

/// The calls of a [`Gateway`] as those of an [`AnyOperator`].
struct Calls<G>(G);

impl<G: Gateway + Send> AnyOperator for Calls<G> {
    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        out.of_stage(|out| self.0.on_message(port, message, out))
    }
    fn on_wake(&mut self, now: Nanos, out: &mut Outputs) -> Result<(), Error> {
        out.of_stage(|out| self.0.on_wake(now, out))
    }
    fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error> {
        out.of_stage(|out| self.0.on_end(out))
    }
}

impl<G: Gateway + Send> AnyGateway for Calls<G> {
    fn open(&mut self, waker: Waker) -> Result<(), Error> {
        self.0.open(waker)
    }
    fn stage(&mut self) -> &mut dyn AnyOperator {
        self
    }
}

/// A [`Source`] whose type is no longer known.
pub trait AnySource: Send {
    /// See [`Source::next`].
    fn next(&mut self) -> Result<Option<(Nanos, PortId, Message)>, Error>;
    /// See [`Source::rate`].
    fn rate(&self) -> f64;
    /// See [`Source::clock`].
    fn clock(&self, first: Nanos) -> Option<Clock>;
    /// See [`Source::counts`].
    fn counts(&self) -> Counts;
    /// Whether its messages come from outside as they are made, so that the time line is wall time.
    fn is_live(&self) -> bool {
        false
    }
}

impl<S: Source + Send> AnySource for S {
    fn next(&mut self) -> Result<Option<(Nanos, PortId, Message)>, Error> {
        let next = Source::next(self)?;
        Ok(next.map(|(time, output)| {
            let (port, message) = output.into_message();
            (time, port, message)
        }))
    }
    fn rate(&self) -> f64 {
        Source::rate(self)
    }
    fn clock(&self, first: Nanos) -> Option<Clock> {
        Source::clock(self, first)
    }
    fn counts(&self) -> Counts {
        Source::counts(self)
    }
}

/// A [`Sink`] whose type is no longer known.
pub trait AnySink: Send {
    /// See [`Sink::accept`]; `out` takes counts.
    fn accept(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error>;
    /// See [`Sink::fates`].
    fn fates(&mut self, fates: &[Fated]) -> Result<(), Error>;
    /// See [`Sink::finish`]; `out` takes counts.
    fn finish(&mut self, books: &Books, out: &mut Outputs) -> Result<(), Error>;
    /// Whether an error is of one message, and the run goes on; else a sink that fails has lost what it should keep.
    fn outlives_errors(&self) -> bool {
        false
    }
}

impl<S: Sink + Send> AnySink for S {
    fn accept(&mut self, port: PortId, message: Message, _: &mut Outputs) -> Result<(), Error> {
        Sink::on_message(self, port, message)
    }
    fn fates(&mut self, fates: &[Fated]) -> Result<(), Error> {
        Sink::fates(self, fates)
    }
    fn finish(&mut self, books: &Books, _: &mut Outputs) -> Result<(), Error> {
        Sink::finish(self, books)
    }
}

/// A built operator or node.
pub enum Built {
    /// Pure stage.
    Operator(Box<dyn AnyOperator>),
    /// Brings messages in.
    Source(Box<dyn AnySource>),
    /// Takes messages out.
    Sink(Box<dyn AnySink>),
    /// Exchanges messages with the world outside.
    Gateway(Box<dyn AnyGateway>),
}

/// One operator or node that the binary hosts.
#[derive(Clone, Copy)]
pub struct Registration {
    /// Name in graphs.
    pub name: &'static str,
    /// One line.
    pub about: &'static str,
    /// What it is to its graph.
    pub role: Role,
    /// Inputs.
    pub inputs: &'static [Port],
    /// Outputs.
    pub outputs: &'static [Port],
    /// What its settings mean.
    pub settings: &'static [SettingInfo],
    /// What it counts.
    pub counters: &'static [Counter],
    /// Keys of its configuration with their defaults.
    pub defaults: fn() -> serde_json::Map<String, Value>,
    /// Whether it takes these settings; opens nothing.
    pub check: fn(&[String]) -> Result<(), ConfigError>,
    /// Looks at its settings and the files that they name; see [`Describe::examine`](crate::Describe::examine).
    pub examine: fn(&[String]) -> Result<(), Error>,
    /// The BEV maps of its ports, as far as these settings say them; see [`Describe::maps`](crate::Describe::maps).
    pub maps: fn(&[String]) -> Vec<(&'static str, KnownMap)>,
    /// Builds it from `key=value` settings.
    pub build: fn(&[String]) -> Result<Built, Error>,
}

macro_rules! registration {
    ($(#[$doc:meta])* $function:ident, $bound:ident, $role:expr, |$made:ident| $built:expr) => {
        $(#[$doc])*
        pub const fn $function<T: $bound + Send + 'static>() -> Self {
            Registration {
                name: T::NAME,
                about: T::ABOUT,
                role: $role,
                inputs: T::Input::PORTS,
                outputs: T::Output::PORTS,
                settings: T::Settings::SETTINGS,
                counters: T::COUNTERS,
                defaults: defaults::<T::Settings>,
                check: |args| parse::<T::Settings>(args).map(|_| ()),
                examine: |args| T::examine(&parse(args)?),
                maps: |args| parse(args).map(|settings| T::maps(&settings)).unwrap_or_default(),
                build: |args| {
                    let $made = T::build(parse(args)?)?;
                    Ok($built)
                },
            }
        }
    };
}

impl Registration {
    registration!(
        /// Registers an operator.
        operator, Operator, Role::Operator, |made| Built::Operator(Box::new(made))
    );
    registration!(
        /// Registers a source.
        source, Source, Role::Source, |made| Built::Source(Box::new(made))
    );
    registration!(
        /// Registers a sink.
        sink, Sink, Role::Sink, |made| Built::Sink(Box::new(made))
    );
    registration!(
        /// Registers a gateway.
        gateway, Gateway, Role::Gateway, |made| Built::Gateway(Box::new(Calls(made)))
    );

    /// A program that brings messages in while its graph runs, see [`pipe`](crate::pipe): its operator is woken for them.
    pub const fn source_program<T: Operator<Input = NoInput> + Send + 'static>() -> Self {
        Registration {
            role: Role::Source,
            ..Registration::operator::<T>()
        }
    }

    /// A program that takes messages out while its graph runs, see [`pipe`](crate::pipe).
    pub const fn sink_program<T: Operator<Output = NoOutput> + Send + 'static>() -> Self {
        Registration {
            role: Role::Sink,
            ..Registration::operator::<T>()
        }
    }

    /// The word before the name in a node's `args`: `operator` or `node`.
    pub fn word(&self) -> &'static str {
        match self.role {
            Role::Operator => "operator",
            Role::Source | Role::Sink | Role::Gateway => "node",
        }
    }

    /// The setting with a role, see [`SettingInfo::role`].
    pub fn setting(&self, role: &str) -> Option<&'static str> {
        let mut settings = self.settings.iter();
        settings
            .find(|setting| setting.role == Some(role))
            .map(|setting| setting.name)
    }

    /// An input by its name.
    pub fn input(&self, name: &str) -> Option<(PortId, &'static Port)> {
        find(self.inputs, name)
    }

    /// An output by its name.
    pub fn output(&self, name: &str) -> Option<(PortId, &'static Port)> {
        find(self.outputs, name)
    }
}

fn find(ports: &'static [Port], name: &str) -> Option<(PortId, &'static Port)> {
    ports
        .iter()
        .enumerate()
        .find(|(_, port)| port.name == name)
        .map(|(index, port)| (PortId(index), port))
}

/// Everything that a binary hosts.
#[derive(Clone, Copy)]
pub struct Registry(pub &'static [Registration]);

impl Registry {
    /// The operator (`word` = `operator`) or node (`node`) of a name.
    ///
    /// # Errors
    /// Says which names there are, the nearest first.
    pub fn find(&self, word: &str, name: &str) -> Result<&'static Registration, String> {
        let found = self.0.iter().find(|entry| entry.word() == word && entry.name == name);
        found.ok_or_else(|| {
            let known: Vec<&str> = self
                .0
                .iter()
                .filter(|entry| entry.word() == word)
                .map(|entry| entry.name)
                .collect();
            let hint = did_you_mean(&nearest_name(name, known.iter().copied()));
            format!("unknown {word} `{name}`{hint}; there are: {}", known.join(", "))
        })
    }
}

use std::collections::{BTreeMap, BTreeSet};
use std::marker::PhantomData;
use std::sync::Arc;
use std::{fmt, mem};

use realo_schemas::report::{Channel, Crossing, Entry, Fate, Fated, SensorClock, Traffic, Use};
use realo_schemas::{Clock, Header, Kind, Message, Name, Nanos};

use crate::{Counter, Counts, KnownMap, PortId, StageInputs, StageOutputs, StageSettings, Steps};

/// Why an operator or node could not go on with a message or a configuration.
pub type Error = Box<dyn std::error::Error + Send + Sync>;

/// What every operator, source and sink says of itself; `#[derive(Describe)]` makes it from the stage's struct.
pub trait Describe {
    /// Typed settings; a key that it does not have is refused with the nearest name.
    type Settings: StageSettings;
    /// What comes in, a variant for each port; [`NoInput`](crate::NoInput) of sources.
    type Input: StageInputs;
    /// What it sends, a variant for each port; [`NoOutput`](crate::NoOutput) of sinks.
    type Output: StageOutputs;
    /// Name in graphs: `realo operator NAME`, `realo node NAME`.
    const NAME: &'static str;
    /// One line for `realo operators`.
    const ABOUT: &'static str;
    /// All that it counts.
    const COUNTERS: &'static [Counter] = &[];

    /// Looks at settings and the files that they name before a run; opens no socket and writes nothing.
    ///
    /// # Errors
    /// What its `build` would say of that.
    fn examine(settings: &Self::Settings) -> Result<(), Error> {
        let _ = settings;
        Ok(())
    }

    /// The BEV maps that its ports carry, by the ports' names, as far as settings and the files that they name say it before a run.
    /// What cannot be read is said by `build`.
    fn maps(settings: &Self::Settings) -> Vec<(&'static str, KnownMap)> {
        let _ = settings;
        Vec::new()
    }
}

/// A pure stage of a graph: messages in, messages out.
///
/// It reads no clock, socket or environment, opens no file after `build`, and does not know which driver runs it.
pub trait Operator: Describe + Sized {
    /// Builds the stage, files and weights included. The settings are inside their declared ranges.
    ///
    /// # Errors
    /// Anything wrong with the configuration; the graph ends before its first message.
    fn build(settings: Self::Settings) -> Result<Self, Error>;

    /// Checks the declared ranges of the settings, then builds it.
    ///
    /// # Errors
    /// [`ConfigError::Range`](crate::config::ConfigError::Range), and errors of [`build`](Self::build).
    fn new(settings: Self::Settings) -> Result<Self, Error> {
        settings.check()?;
        Self::build(settings)
    }

    /// Takes one message. An error is counted and logged with the message's header; the run goes on.
    fn on_input(&mut self, input: Self::Input, out: &mut Outputs<Self::Output>) -> Result<(), Error>;

    /// Takes a message of a port, as drivers and tests have it.
    ///
    /// # Errors
    /// [`PortError`](crate::PortError), and those of [`on_input`](Self::on_input).
    fn on_message(&mut self, port: PortId, message: Message, out: &mut Outputs<Self::Output>) -> Result<(), Error> {
        self.on_input(Self::Input::read(port, message)?, out)
    }

    /// Is called at the times that [`Outputs::wake_at`] asked for.
    fn on_wake(&mut self, now: Nanos, out: &mut Outputs<Self::Output>) -> Result<(), Error> {
        let _ = (now, out);
        Ok(())
    }

    /// Is called once, after the last message and the last wake.
    fn on_end(&mut self, out: &mut Outputs<Self::Output>) -> Result<(), Error> {
        let _ = out;
        Ok(())
    }
}

/// A node that brings messages into a graph: a player, a sensor.
pub trait Source: Describe + Sized {
    /// Opens what it reads. The settings are inside their declared ranges.
    ///
    /// # Errors
    /// Anything wrong with the configuration or the files it names.
    fn build(settings: Self::Settings) -> Result<Self, Error>;

    /// Checks the declared ranges of the settings, then builds it.
    ///
    /// # Errors
    /// [`ConfigError::Range`](crate::config::ConfigError::Range), and errors of [`build`](Self::build).
    fn new(settings: Self::Settings) -> Result<Self, Error> {
        settings.check()?;
        Self::build(settings)
    }

    /// The next message, in order of its time of release on the log's time line; `None` at the end.
    ///
    /// # Errors
    /// What could not be read; the run fails.
    fn next(&mut self) -> Result<Option<(Nanos, Self::Output)>, Error>;

    /// Seconds of log time per second of wall time in a realtime run.
    fn rate(&self) -> f64 {
        1.0
    }

    /// How its times lie on the wall clock, if that is given; otherwise the message of time `first` is released at once.
    fn clock(&self, first: Nanos) -> Option<Clock> {
        let _ = first;
        None
    }

    /// What it counted so far, for the run's books.
    fn counts(&self) -> Counts {
        Counts::default()
    }
}

/// A node that exchanges messages with the world outside while its graph runs: a radio. It exists in realtime only.
///
/// Messages of the graph come as to an [`Operator`]. What comes from outside it keeps until it is called, which it asks for
/// by its [`Waker`], and sends in `on_wake`.
pub trait Gateway: Describe + Sized {
    /// Opens what it needs; nothing comes in yet. The settings are inside their declared ranges.
    ///
    /// # Errors
    /// Anything wrong with the configuration, or an address that cannot be had.
    fn build(settings: Self::Settings) -> Result<Self, Error>;

    /// Checks the declared ranges of the settings, then builds it.
    ///
    /// # Errors
    /// [`ConfigError::Range`](crate::config::ConfigError::Range), and errors of [`build`](Self::build).
    fn new(settings: Self::Settings) -> Result<Self, Error> {
        settings.check()?;
        Self::build(settings)
    }

    /// Is called once, before all other calls.
    ///
    /// # Errors
    /// What keeps it from the world outside; the run fails.
    fn open(&mut self, waker: Waker) -> Result<(), Error>;

    /// As [`Operator::on_input`]; it must not wait for anybody outside.
    fn on_input(&mut self, input: Self::Input, out: &mut Outputs<Self::Output>) -> Result<(), Error>;

    /// Takes a message of a port, as drivers and tests have it.
    ///
    /// # Errors
    /// [`PortError`](crate::PortError), and those of [`on_input`](Self::on_input).
    fn on_message(&mut self, port: PortId, message: Message, out: &mut Outputs<Self::Output>) -> Result<(), Error> {
        self.on_input(Self::Input::read(port, message)?, out)
    }

    /// As [`Operator::on_wake`], and whenever the waker has asked for it.
    fn on_wake(&mut self, now: Nanos, out: &mut Outputs<Self::Output>) -> Result<(), Error>;

    /// As [`Operator::on_end`]. Nothing comes in after it.
    fn on_end(&mut self, out: &mut Outputs<Self::Output>) -> Result<(), Error>;
}

/// Asks a driver to call a [`Gateway`], from any thread.
#[derive(Clone)]
pub struct Waker(Arc<dyn Fn() + Send + Sync>);

impl Waker {
    /// A waker that does this.
    pub fn new(wake: impl Fn() + Send + Sync + 'static) -> Self {
        Waker(Arc::new(wake))
    }

    /// Asks for a call of `on_wake`, soon.
    pub fn wake(&self) {
        (self.0)();
    }
}

impl fmt::Debug for Waker {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Waker")
    }
}

/// A node that takes messages out of a graph: a recorder, the results.
pub trait Sink: Describe + Sized {
    /// Opens what it writes. The settings are inside their declared ranges.
    ///
    /// # Errors
    /// Anything wrong with the configuration or the files it names.
    fn build(settings: Self::Settings) -> Result<Self, Error>;

    /// Checks the declared ranges of the settings, then builds it.
    ///
    /// # Errors
    /// [`ConfigError::Range`](crate::config::ConfigError::Range), and errors of [`build`](Self::build).
    fn new(settings: Self::Settings) -> Result<Self, Error> {
        settings.check()?;
        Self::build(settings)
    }

    /// Takes one message.
    ///
    /// # Errors
    /// What could not be written; the run fails.
    fn accept(&mut self, input: Self::Input) -> Result<(), Error>;

    /// Takes a message of a port, as drivers and tests have it.
    ///
    /// # Errors
    /// [`PortError`](crate::PortError), and those of [`accept`](Self::accept).
    fn on_message(&mut self, port: PortId, message: Message) -> Result<(), Error> {
        self.accept(Self::Input::read(port, message)?)
    }

    /// Takes what stages said of messages that crossed a link, in the order in which it reached this process.
    ///
    /// # Errors
    /// What could not be written; the run fails.
    fn fates(&mut self, fates: &[Fated]) -> Result<(), Error> {
        let _ = fates;
        Ok(())
    }

    /// Closes what it wrote, with the books of all stages of the graph but other sinks.
    ///
    /// # Errors
    /// What could not be written; the run fails.
    fn finish(&mut self, books: &crate::Books) -> Result<(), Error>;
}

/// What an operator hands to its driver during one call.
///
/// `O`: what it may send, its [`Describe::Output`]. Drivers, which know no stage's type, have `Outputs<AnyOutput>`.
///
/// ```
/// use realo_operator::{Message, Outputs};
///
/// #[derive(Outputs)]
/// enum Own {
///     /// Boxes.
///     #[port(any_of(Boxes))]
///     Boxes(Message),
/// }
///
/// fn stage(message: Message, out: &mut Outputs<Own>) {
///     out.send(Own::Boxes(message));
/// }
/// ```
///
/// The output of another stage is not taken:
///
/// ```compile_fail
/// # use realo_operator::{Message, Outputs};
/// # #[derive(Outputs)]
/// # enum Own {
/// #     /// Boxes.
/// #     #[port(any_of(Boxes))]
/// #     Boxes(Message),
/// # }
/// # #[derive(Outputs)]
/// # enum Other {
/// #     /// Boxes.
/// #     #[port(any_of(Boxes))]
/// #     Boxes(Message),
/// # }
/// fn stage(message: Message, out: &mut Outputs<Own>) {
///     out.send(Other::Boxes(message));
/// }
/// ```
#[derive(Debug)]
pub struct Outputs<O = AnyOutput> {
    now: Nanos,
    clock: Option<Clock>,
    made: Made,
    steps: Steps,
    stage: PhantomData<fn(O)>,
}

/// The output of a stage whose type is no longer known.
#[derive(Debug)]
pub enum AnyOutput {}

/// All that came of one call.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Made {
    /// Messages, in the order in which they were sent.
    pub sent: Vec<(PortId, Message)>,
    /// When the operator wishes to be called.
    pub wakes: BTreeSet<Nanos>,
    /// What it counted.
    pub counts: Counts,
    /// What fates mean here, see [`Outputs::explain`].
    pub explained: BTreeMap<Fate, String>,
    /// What became of messages that had crossed a link.
    pub fates: Vec<Fated>,
    /// What crossed links.
    pub traffic: Vec<Channel>,
    /// Steps that were timed, and what each took, ns.
    pub steps: Vec<(&'static str, Nanos)>,
}

impl<O> Outputs<O> {
    /// Empty outputs of a call that starts at `now`; drivers and tests of operators make them.
    pub fn at(now: Nanos) -> Self {
        Outputs {
            now,
            clock: None,
            made: Made::default(),
            steps: Steps::default(),
            stage: PhantomData,
        }
    }

    /// The same of a driver in real time: where the log lies on the wall clock, once that is known, and what times the steps of the call.
    pub fn in_real_time(self, clock: Option<Clock>, steps: fn() -> Nanos) -> Self {
        Outputs {
            clock,
            steps: Steps::timed_by(steps),
            ..self
        }
    }

    /// When the call started, on the log's time line.
    pub fn now(&self) -> Nanos {
        self.now
    }

    /// Where the log lies on the wall clock, for what goes on between calls; `None` in virtual time, and until a message has brought it.
    pub fn log_clock(&self) -> Option<Clock> {
        self.clock
    }

    /// Sends a message whose header derives from those of the inputs that made it. A `ready` before now becomes now;
    /// a later one is kept and delays the message.
    pub fn send(&mut self, output: O)
    where
        O: StageOutputs,
    {
        let (port, message) = output.into_message();
        self.put(port, message);
    }

    fn put(&mut self, port: PortId, mut message: Message) {
        message.header.ready = message.header.ready.max(self.now);
        self.made.sent.push((port, message));
    }

    /// Asks for a call of `on_wake` at `time`; the past means now.
    pub fn wake_at(&mut self, time: Nanos) {
        self.made.wakes.insert(time.max(self.now));
    }

    /// Adds `n` to a counter of [`Describe::COUNTERS`]; `agent` is whose data they are, or empty.
    pub fn count(&mut self, counter: &'static Counter, agent: &str, n: u64) {
        self.made.counts.add(counter, agent, n, 0);
    }

    /// The same, `n` of `of`; is called for what was not lost too, so that a note can say how many of how many.
    pub fn count_of(&mut self, counter: &'static Counter, agent: &str, n: u64, of: u64) {
        self.made.counts.add(counter, agent, n, of);
    }

    /// Says what was found of the first that an agent lost; see [`Counts::found`](crate::Counts::found).
    pub fn found(&mut self, counter: &'static Counter, agent: &str, words: impl FnOnce() -> String) {
        self.made.counts.found(counter, agent, words);
    }

    /// Says what is known of the clock of an agent's sensor; of each sensor the newest counts.
    pub fn clock(&mut self, clock: SensorClock) {
        self.made.counts.clocks.push(clock);
    }

    /// What was said of clocks in this call.
    pub fn clocks(&self) -> &[SensorClock] {
        &self.made.counts.clocks
    }

    /// Says what a fate means at this stage, by its settings, for notes: `Stale` is "older than 400 ms".
    pub fn explain(&mut self, fate: Fate, words: impl Into<String>) {
        self.made.explained.insert(fate, words.into());
    }

    /// Says what became of a message that crossed a link; of any other nothing is said.
    ///
    /// Only whoever ends a message's way says so; several may, and the first [`Fate`] that fits stands.
    pub fn report(&mut self, header: &Header, fate: Fate) {
        self.made.fates.extend(Fated::of(header, fate));
    }

    /// Says that a message took part in a fusion with the ego's message `query`.
    pub fn used(&mut self, header: &Header, query: &Header) {
        let fated = Crossing::of(header).map(|message| Fated {
            message,
            fate: Fate::Used,
            r#use: Some(Use {
                query: query.seq,
                age_ns: query.ready.saturating_sub(header.stamp),
            }),
            entry: None,
        });
        self.made.fates.extend(fated);
    }

    /// Says that a message entered its channel; what becomes of it others say.
    pub fn entered(&mut self, header: &Header, entry: Entry) {
        self.made.fates.extend(Fated::entered(header, entry));
    }

    /// Says what became of messages that crossed a link, as a peer or another stage has said it.
    pub fn know(&mut self, fates: Vec<Fated>) {
        self.made.fates.extend(fates);
    }

    /// Counts what a channel carried.
    pub fn carried(&mut self, from: &Name, to: &Name, kind: Kind, traffic: Traffic) {
        let (from, to) = (from.to_string(), to.to_string());
        self.made.traffic.push(Channel {
            from,
            to,
            kind,
            traffic,
        });
    }

    /// Times the steps of the call.
    pub fn steps(&mut self) -> &mut Steps {
        &mut self.steps
    }

    /// All that came of the call.
    pub fn into_made(mut self) -> Made {
        self.made.steps.append(&mut self.steps.take());
        self.made
    }

    /// What was sent so far, in order; for tests of operators.
    pub fn take_sent(&mut self) -> Vec<(PortId, Message)> {
        std::mem::take(&mut self.made.sent)
    }

    /// The wakes that were asked for; for tests of operators.
    pub fn take_wakes(&mut self) -> BTreeSet<Nanos> {
        std::mem::take(&mut self.made.wakes)
    }

    /// What was said of messages that crossed a link; for tests of operators.
    pub fn take_fates(&mut self) -> Vec<Fated> {
        std::mem::take(&mut self.made.fates)
    }

    /// A counter's value in this call, by its name; for tests of operators.
    pub fn counted(&self, counter: &str) -> u64 {
        self.made.counts.get(counter)
    }
}

impl Outputs {
    /// Sends on a port by its place, for who hands on what another process sent.
    pub fn send_on(&mut self, port: PortId, message: Message) {
        self.put(port, message);
    }

    /// Takes over what came of a call in another process.
    pub fn take_over(&mut self, made: Made) {
        let Made {
            sent,
            wakes,
            counts,
            explained,
            fates,
            traffic,
            steps,
        } = made;
        sent.into_iter().for_each(|(port, message)| self.put(port, message));
        wakes.into_iter().for_each(|time| self.wake_at(time));
        self.made.counts.extend(counts);
        self.made.explained.extend(explained);
        self.made.fates.extend(fates);
        self.made.traffic.extend(traffic);
        self.made.steps.extend(steps);
    }

    /// Makes a call of a stage that sends `O`.
    pub(crate) fn of_stage<O, T>(&mut self, call: impl FnOnce(&mut Outputs<O>) -> T) -> T {
        let mut out = Outputs {
            now: self.now,
            clock: self.clock,
            made: mem::take(&mut self.made),
            steps: mem::take(&mut self.steps),
            stage: PhantomData,
        };
        let done = call(&mut out);
        (self.made, self.steps) = (out.made, out.steps);
        done
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_in_real_time_knows_where_its_log_lies_on_the_wall_clock() {
        let clock = Clock {
            rate: 2.0,
            ..Clock::live(1_000)
        };
        let mut out = Outputs::<AnyOutput>::at(7);
        assert_eq!(out.of_stage(|out: &mut Outputs<()>| out.log_clock()), None);
        let mut out = out.in_real_time(Some(clock), || 0);
        assert_eq!(out.of_stage(|out: &mut Outputs<()>| out.log_clock()), Some(clock));
        assert_eq!(clock.log_at(1_500), 2_000);
    }
}

//! How far long work is: a bar on a terminal, and a line every ten seconds where standard error is something else.

use std::fmt::Write;
use std::io::IsTerminal;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::program;
use indicatif::{MultiProgress, ProgressBar, ProgressState, ProgressStyle};
use terminal_size::Width;

/// From one line to the next.
const EVERY: Duration = Duration::from_secs(10);

/// Letters of what is done that stand before a bar, at most.
const HEAD: usize = 26;
/// On terminals of fewer columns units and rates have no room.
const NARROW: u16 = 110;
/// The unit of work that takes its time.
const SECONDS: &str = "s";

/// How far some work is. Ends with [`Progress::finish`] or when it is dropped.
pub struct Progress {
    state: Arc<Mutex<State>>,
    shown: Shown,
}

enum Shown {
    Bar(ProgressBar, MultiProgress),
    Lines {
        /// Closed to end the thread.
        end: Option<Sender<()>>,
        thread: Option<JoinHandle<()>>,
    },
}

struct State {
    /// What is done, as "simulating".
    what: String,
    /// What is counted, as "sweeps"; empty if nothing is.
    unit: &'static str,
    begun: Instant,
    /// What was done before this work began.
    from: f64,
    done: f64,
    all: Option<f64>,
    /// What else there is to say.
    more: String,
}

impl Progress {
    /// Work of so many units, if that is known yet.
    pub fn new(what: impl Into<String>, unit: &'static str, all: Option<f64>) -> Self {
        match std::io::stderr().is_terminal() {
            true => Progress::bar(State::new(what, unit, all)),
            false => Progress::as_lines(what, unit, all),
        }
    }

    /// More work at the same time, as a bar below this one. Where there are no bars nothing is said of it.
    pub fn below(&self, what: impl Into<String>, unit: &'static str, all: f64) -> Option<Progress> {
        match &self.shown {
            Shown::Bar(_, group) => Some(Progress::bar_in(State::new(what, unit, Some(all)), group.clone())),
            Shown::Lines { .. } => None,
        }
    }

    /// Lines on a terminal too, where others print in between.
    pub fn as_lines(what: impl Into<String>, unit: &'static str, all: Option<f64>) -> Self {
        Progress::lines(State::new(what, unit, all), EVERY, |line| eprintln!("{line}"))
    }

    fn bar(state: State) -> Self {
        Progress::bar_in(state, MultiProgress::new())
    }

    fn bar_in(state: State, group: MultiProgress) -> Self {
        let bar = group.add(ProgressBar::new(state.all.unwrap_or(0.0).ceil() as u64).with_style(state.style()));
        bar.set_prefix(state.head());
        // What stands still is drawn too, with the time that went by.
        bar.enable_steady_tick(Duration::from_secs(1));
        Progress {
            state: Arc::new(Mutex::new(state)),
            shown: Shown::Bar(bar, group),
        }
    }

    fn lines(state: State, every: Duration, say: impl Fn(String) + Send + 'static) -> Self {
        let state = Arc::new(Mutex::new(state));
        let (end, ended) = channel::<()>();
        let reported = state.clone();
        let thread = std::thread::spawn(move || {
            while ended.recv_timeout(every) == Err(RecvTimeoutError::Timeout) {
                let line = open(&reported).line();
                say(line);
            }
        });
        Progress {
            state,
            shown: Shown::Lines {
                end: Some(end),
                thread: Some(thread),
            },
        }
    }

    /// Work of so many units begins now, where so much was done before.
    pub fn begin(&self, done: f64, all: f64) {
        let mut state = open(&self.state);
        (state.from, state.done, state.all, state.begun) = (done, done, Some(all), Instant::now());
        if let Shown::Bar(bar, _) = &self.shown {
            bar.set_style(state.style());
            bar.reset_eta();
        }
        self.draw(&state);
    }

    /// Work of so many units begins now.
    pub fn count(&self, unit: &'static str, all: f64) {
        open(&self.state).unit = unit;
        self.begin(0.0, all);
    }

    /// The work is another one from now on.
    pub fn rename(&self, what: impl Into<String>, unit: &'static str) {
        let mut state = open(&self.state);
        (state.what, state.unit) = (what.into(), unit);
        if let Shown::Bar(bar, _) = &self.shown {
            bar.set_prefix(state.head());
        }
    }

    /// So much is done in all.
    pub fn set(&self, done: f64) {
        let mut state = open(&self.state);
        state.done = done;
        self.draw(&state);
    }

    /// So much more is done.
    pub fn add(&self, more: f64) {
        let mut state = open(&self.state);
        state.done += more;
        self.draw(&state);
    }

    /// So much is done of so much.
    pub fn of(&self, done: f64, all: f64) {
        let mut state = open(&self.state);
        (state.done, state.all) = (done, Some(all));
        self.draw(&state);
    }

    /// What else there is to say, until the next call.
    pub fn say(&self, more: impl Into<String>) {
        let mut state = open(&self.state);
        state.more = more.into();
        if let Shown::Bar(bar, _) = &self.shown {
            bar.set_message(state.more.clone());
        }
    }

    /// Prints beside the bar.
    pub fn beside(&self, print: impl FnOnce()) {
        match &self.shown {
            Shown::Bar(_, group) => group.suspend(print),
            Shown::Lines { .. } => print(),
        }
    }

    /// Ends the bar or the lines.
    pub fn finish(self) {}

    fn draw(&self, state: &State) {
        if let Shown::Bar(bar, _) = &self.shown {
            bar.set_length(state.all.unwrap_or(state.done).ceil() as u64);
            bar.set_position(state.done as u64);
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        match &mut self.shown {
            Shown::Bar(bar, group) => {
                bar.finish_and_clear();
                group.remove(bar);
            }
            Shown::Lines { end, thread } => {
                drop(end.take());
                if let Some(thread) = thread.take() {
                    let _ = thread.join();
                }
            }
        }
    }
}

impl State {
    fn new(what: impl Into<String>, unit: &'static str, all: Option<f64>) -> Self {
        State {
            what: what.into(),
            unit,
            begun: Instant::now(),
            from: 0.0,
            done: 0.0,
            all,
            more: String::new(),
        }
    }

    /// What is done, as far as there is room for it beside a bar on 80 columns.
    fn head(&self) -> String {
        match self.what.chars().count() > HEAD {
            true => self.what.chars().take(HEAD - 1).chain(['…']).collect(),
            false => self.what.clone(),
        }
    }

    fn style(&self) -> ProgressStyle {
        self.style_on(terminal_size::terminal_size_of(std::io::stderr()).map_or(NARROW, |(Width(columns), _)| columns))
    }

    /// For so many columns.
    fn style_on(&self, columns: u16) -> ProgressStyle {
        let template = match self.all {
            // What else there is to say goes before units and rates.
            Some(_) if columns < NARROW => "{prefix} [{bar:8}] {pos}/{len}, {left} {wide_msg}".into(),
            // Seconds of a clock pass as they do.
            Some(_) => format!(
                "{{prefix}} [{{wide_bar}}] {{pos}}/{{len}}{}{}{}, {{left}} {{msg}}",
                if self.unit.is_empty() { "" } else { " " },
                self.unit,
                if self.unit == SECONDS { "" } else { ", {rate}" }
            ),
            None if self.unit.is_empty() => "{prefix} for {elapsed} {msg}".into(),
            None => format!("{{prefix}} {{pos}} {} in {{elapsed}} {{msg}}", self.unit),
        };
        let style = ProgressStyle::with_template(&template).expect("the templates are constants");
        style
            .with_key("rate", |state: &ProgressState, out: &mut dyn Write| {
                // A line that cannot be drawn is drawn again in a moment.
                let _ = write!(out, "{:.1}/s", state.per_sec());
            })
            .with_key("left", |state: &ProgressState, out: &mut dyn Write| {
                let _ = match state.pos() {
                    // How long it takes is not known before something is done.
                    0 => write!(out, "{} so far", duration(state.elapsed().as_secs_f64())),
                    _ => write!(out, "{} left", duration(state.eta().as_secs_f64())),
                };
            })
            .progress_chars("=> ")
    }

    fn line(&self) -> String {
        let seconds = self.begun.elapsed().as_secs_f64();
        let rate = (self.done - self.from) / seconds;
        let far = match self.all {
            None if self.unit.is_empty() => "running".into(),
            Some(all) => format!("{} of {} {}", number(self.done), number(all), self.unit),
            None => format!("{} {}", number(self.done), self.unit),
        };
        let far = far.trim_end();
        let pace = match (rate > 0.0, self.all) {
            (false, _) => format!(", {} so far", duration(seconds)),
            (true, None) => format!(", {rate:.1} a second"),
            (true, Some(all)) => {
                let left = ((all - self.done) / rate).max(0.0);
                format!(", {rate:.1} a second, {} left", duration(left))
            }
        };
        let more = if self.more.is_empty() {
            String::new()
        } else {
            format!("; {}", self.more)
        };
        format!("{}: {}: {far}{pace}{more}", program::name(), self.what)
    }
}

/// A count as it is, seconds to a tenth.
fn number(value: f64) -> String {
    match value.fract() == 0.0 {
        true => format!("{value:.0}"),
        false => format!("{value:.1}"),
    }
}

pub(crate) fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..60 => format!("{whole} s"),
        60..3600 => format!("{}:{:02} min", whole / 60, whole % 60),
        _ => format!("{}:{:02} h", whole / 3600, whole % 3600 / 60),
    }
}

/// A thread that panicked leaves whole numbers behind.
fn open(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(all: Option<f64>, done: f64, ago: u64) -> State {
        State {
            what: "simulating".into(),
            unit: "sweeps",
            begun: Instant::now() - Duration::from_secs(ago),
            from: 0.0,
            done,
            all,
            more: String::new(),
        }
    }

    #[test]
    fn a_line_says_what_how_far_how_fast_and_how_long() {
        let line = state(Some(400.0), 100.0, 10).line();
        assert_eq!(line, "realo: simulating: 100 of 400 sweeps, 10.0 a second, 30 s left");
        let mut uncounted = state(None, 0.0, 20);
        uncounted.unit = "";
        assert_eq!(uncounted.line(), "realo: simulating: running, 20 s so far");
        uncounted.all = Some(3.0);
        assert_eq!(uncounted.line(), "realo: simulating: 0 of 3, 20 s so far");
        let line = state(None, 100.0, 10).line();
        assert_eq!(line, "realo: simulating: 100 sweeps, 10.0 a second");
        let mut long = state(Some(10_000.0), 0.0, 70);
        assert_eq!(long.line(), "realo: simulating: 0 of 10000 sweeps, 1:10 min so far");
        (long.done, long.from, long.more) = (70.0, 35.0, "loss 0.5".into());
        assert_eq!(
            long.line(),
            "realo: simulating: 70 of 10000 sweeps, 0.5 a second, 5:31 h left; loss 0.5"
        );
    }

    #[test]
    fn lines_come_while_work_stands_still_and_end_with_it() {
        let (say, said) = channel();
        let progress = Progress::lines(state(Some(4.0), 1.0, 1), Duration::from_millis(1), move |line| {
            let _ = say.send(line);
        });
        let first = said.recv_timeout(Duration::from_secs(60)).expect("a line");
        assert!(first.starts_with("realo: simulating: 1 of 4 sweeps"), "{first}");
        progress.set(3.0);
        let at_three = |line: &String| line.starts_with("realo: simulating: 3 of 4 sweeps");
        assert!((0..100_000).any(|_| {
            said.recv_timeout(Duration::from_secs(60))
                .is_ok_and(|line| at_three(&line))
        }));
        progress.finish();
        // The thread has ended, and with it whoever could say more.
        while said.try_recv().is_ok() {}
        assert!(said.recv().is_err());
    }
}

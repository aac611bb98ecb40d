//! Last words of a program.

use std::io::{Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::process::{Command, ExitStatus};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use super::relay::Relay;
use super::{Child, QUOTED};
use crate::virtual_time::is_ending;

/// Lines of standard error that are quoted at most.
const LAST_LINES: usize = 12;
/// Letters of a command line that are shown.
const SHOWN: usize = 160;
/// Where else to look.
pub(super) const TABLE: &str = "docs/reference/plugins.md, \"When something stops you\", says what to do";

/// A command as it was started, as far as a message shows it.
pub(super) fn command_line(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    let words: Vec<_> = words.map(|word| word.to_string_lossy()).collect();
    let line = shlex::try_join(words.iter().map(AsRef::as_ref)).unwrap_or_else(|_| words.join(" "));
    match line.char_indices().nth(SHOWN) {
        Some((end, _)) => format!("{} …", &line[..end]),
        None => line,
    }
}

/// What to do about a program that ended in the middle of a run.
pub(super) fn advice(status: ExitStatus) -> &'static str {
    match (status.signal(), status.code()) {
        (Some(9), _) | (_, Some(137)) => {
            "it was killed: if the system did it for its memory (`dmesg` says so), give it smaller inputs or more memory"
        }
        (Some(_), _) | (_, Some(128..)) => {
            "it crashed in compiled code: PYTHONFAULTHANDLER=1 shows where in a program in Python, a debugger in others"
        }
        _ => "mend what its last lines name; docs/reference/plugins.md, \"When something stops you\", has more",
    }
}

impl Child {
    /// How the program ended, if it does so in time.
    pub(super) fn exited(&mut self, patience: Duration) -> Option<ExitStatus> {
        let until = Instant::now() + patience;
        loop {
            match self.process.try_wait() {
                Ok(Some(status)) => return Some(status),
                Ok(None) if Instant::now() < until && !is_ending() => std::thread::sleep(Duration::from_millis(2)),
                _ => return None,
            }
        }
    }

    /// What is known of a program from which no reply can come: whether it ended or closed its standard output, what it said.
    pub(super) fn farewell(&mut self, when: &str) -> String {
        self.calls = None;
        if let Some(status) = self.exited(Duration::from_secs(2)) {
            return self.quoted(format!("it ended with {status} {when}"));
        }
        self.stop();
        self.quoted(format!(
            "it closed its standard output {when} and went on, so it was stopped: replies go through standard output, leave \
             it open"
        ))
    }

    /// How it ended, which it is given some time for.
    fn ending(&mut self) -> String {
        match self.exited(Duration::from_secs(2)) {
            Some(status) => format!("it ended with {status}"),
            None => {
                self.stop();
                "it was stopped".into()
            }
        }
    }

    /// What is known of a program that failed: the reason, how it ended, what it said.
    pub(super) fn last_words(&mut self, reason: &str) -> String {
        self.calls = None;
        let ended = self.ending();
        self.quoted(format!("{reason}; {ended}"))
    }

    /// What a program says that refuses its settings.
    pub(super) fn refused(&mut self, reason: &str) -> String {
        self.calls = None;
        let ended = self.ending();
        let mend = missing_module(reason).map_or(String::new(), |mend| format!("; {mend}"));
        format!("program `{}`: {reason}{mend} ({ended})", self.program)
    }

    /// What is known, with what the program said on standard error.
    fn quoted(&self, known: String) -> String {
        let until = Instant::now() + Duration::from_secs(1);
        while !self.listener.is_finished() && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(2));
        }
        let said = self.said.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let said = String::from_utf8_lossy(&said);
        let lines: Vec<&str> = said.trim().lines().collect();
        let last = match self.registration.name {
            // Whoever starts it sees all of it above.
            "" => &lines[lines.len().saturating_sub(1)..],
            _ => &lines[lines.len().saturating_sub(LAST_LINES)..],
        };
        let known = format!("program `{}`: {known}", self.program);
        match last {
            [] => format!("{known}; it said nothing on standard error"),
            [line] => format!("{known}; it said on standard error: {line}"),
            lines => format!(
                "{known}; it said on standard error, at last:\n    {}",
                lines.join("\n    ")
            ),
        }
    }
}

/// What to do about a module that Python does not find, if that is what a program said last.
pub(super) fn missing_module(said: &str) -> Option<String> {
    let (_, rest) = said.split_once("ModuleNotFoundError: No module named '")?;
    let (module, _) = rest.split_once('\'')?;
    let package = module.split('.').next().unwrap_or(module);
    let python = crate::program::python();
    Some(match package {
        "realo" | "realo_operator" | "realo_geometry" | "realo_log" => {
            format!("it lies in `python/` of a checkout of realo: `{python} -m pip install CHECKOUT/python`")
        }
        _ => format!("`{python} -m pip install {package}` installs it; `realo doctor` says for which Python"),
    })
}

/// Passes on what a program says on standard error, and keeps the end of it.
pub(super) fn listen(mut stderr: impl Read, said: &Mutex<Vec<u8>>, mut relay: Relay<impl Write>) {
    let mut chunk = [0; 1024];
    while let Ok(n @ 1..) = stderr.read(&mut chunk) {
        relay.pass(&chunk[..n], Instant::now());
        let mut said = said.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        said.extend_from_slice(&chunk[..n]);
        let surplus = said.len().saturating_sub(QUOTED);
        said.drain(..surplus);
    }
    relay.end();
}

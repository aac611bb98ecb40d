//! Last words of a program.

use std::io::{Read, Write};
use std::process::ExitStatus;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use super::relay::Relay;
use super::{Child, QUOTED};
use crate::virtual_time::is_ending;

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

    /// What is known of a program that failed: the reason, how it ended, what it said.
    pub(super) fn last_words(&mut self, reason: &str) -> String {
        self.calls = None;
        let ended = match self.exited(Duration::from_secs(2)) {
            Some(status) => format!("it ended with {status}"),
            None => {
                self.stop();
                "it was stopped".into()
            }
        };
        self.quoted(format!("{reason}; {ended}"))
    }

    /// What is known, with what the program said on standard error.
    fn quoted(&self, known: String) -> String {
        let until = Instant::now() + Duration::from_secs(1);
        while !self.listener.is_finished() && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(2));
        }
        let said = self.said.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let said = String::from_utf8_lossy(&said);
        let said = match self.registration.name {
            // Whoever starts it sees all of it above.
            "" => said.trim().lines().next_back().unwrap_or_default(),
            _ => said.trim(),
        };
        match said {
            "" => format!("{known}; it said nothing on standard error"),
            said => format!("{known}; it said on standard error: {said}"),
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

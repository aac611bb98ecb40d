use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use eyre::{Result, WrapErr, eyre};
use serde::Serialize;
use serde_json::Value;

use super::detector::spread;

const SCRIPT: &str = include_str!("peers.py");

/// Prints which of its arguments cannot be imported.
const MISSING: &str = "\
import importlib.util, sys
print(*[name for name in sys.argv[1:] if importlib.util.find_spec(name) is None])";

/// A Python program that makes the same step, to be timed in turns with ours.
pub struct Peer {
    /// What it is, with its version.
    pub name: String,
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

/// The same step by another program, in turns.
#[derive(Serialize)]
pub struct PeerTimes {
    pub name: String,
    pub minimum_ms: f64,
    pub median_ms: f64,
    /// Our minimum over theirs.
    pub minimum_ratio: f64,
    /// Median over the rounds of our time over theirs in the same round.
    pub paired_ratio: f64,
    pub goal: f64,
}

impl PeerTimes {
    /// Of times in seconds, round by round.
    pub fn of(name: String, ours: &[f64], theirs: &[f64], goal: f64) -> Self {
        let pairs: Vec<f64> = ours.iter().zip(theirs).map(|(ours, theirs)| ours / theirs).collect();
        let (minimum, median) = spread(theirs);
        PeerTimes {
            name,
            minimum_ms: minimum * 1e3,
            median_ms: median * 1e3,
            minimum_ratio: spread(ours).0 / minimum,
            paired_ratio: spread(&pairs).1,
            goal,
        }
    }
}

impl Peer {
    /// Starts one of `peers.py` by an interpreter that has its packages.
    pub fn start(python: &Path, which: &str, reported: &Value) -> Result<Self> {
        let mut child = Command::new(python)
            .args(["-c", SCRIPT, which, &reported.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .wrap_err_with(|| format!("--python {}", python.display()))?;
        let (input, output) = child
            .stdin
            .take()
            .zip(child.stdout.take())
            .ok_or_else(|| eyre!("no pipes"))?;
        let mut peer = Peer {
            name: String::new(),
            child,
            input,
            output: BufReader::new(output),
        };
        peer.name = peer
            .line()
            .wrap_err_with(|| format!("--python {}: `{which}` did not start", python.display()))?;
        Ok(peer)
    }

    /// Whether an interpreter has some packages.
    ///
    /// # Errors
    /// All that are missing, at once.
    pub fn check(python: &Path, packages: &[&str]) -> Result<()> {
        let found = Command::new(python).args(["-c", MISSING]).args(packages).output();
        let found = found.wrap_err_with(|| format!("--python {}", python.display()))?;
        let shown = python.display();
        if !found.status.success() {
            let said = String::from_utf8_lossy(&found.stderr);
            return Err(eyre!(
                "--python {shown}: expected an interpreter of Python 3: {}",
                said.trim()
            ));
        }
        let missing = String::from_utf8_lossy(&found.stdout);
        let missing: Vec<&str> = missing.split_whitespace().collect();
        match missing.is_empty() {
            true => Ok(()),
            false => Err(eyre!(
                "--python {shown}: it needs {}, and does not have {}: {shown} -m pip install {}",
                packages.join(", "),
                missing.join(", "),
                missing.join(" ")
            )),
        }
    }

    /// Seconds of one run.
    pub fn run(&mut self) -> Result<f64> {
        writeln!(self.input, "run")?;
        let line = self.line()?;
        line.parse()
            .wrap_err_with(|| format!("{}: expected seconds, found `{line}`", self.name))
    }

    fn line(&mut self) -> Result<String> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        match line.trim() {
            "" => Err(eyre!("it ended, with what it said above")),
            line => Ok(line.to_string()),
        }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_missing_packages_are_named_at_once() {
        let python = Path::new("python3");
        if Command::new(python).arg("--version").output().is_err() {
            eprintln!("not decided here: there is no python3");
            return;
        }
        Peer::check(python, &["json", "sys"]).unwrap();
        let error = Peer::check(python, &["json", "no_such_one", "nor_this_one"]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "--python python3: it needs json, no_such_one, nor_this_one, and does not have no_such_one, nor_this_one: python3 -m pip \
             install no_such_one nor_this_one"
        );
        assert!(Peer::check(Path::new("/bin/false"), &["json"]).is_err());
    }
}

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use eyre::{Result, WrapErr, eyre};
use serde_json::Value;

const SCRIPT: &str = include_str!("peers.py");

/// A Python program that makes the same step, to be timed in turns with ours.
pub struct Peer {
    /// What it is, with its version.
    pub name: String,
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

impl Peer {
    /// Starts one of `peers.py` by an interpreter that has its packages.
    pub fn start(python: &Path, which: &str, told: &Value) -> Result<Self> {
        let mut child = Command::new(python)
            .args(["-c", SCRIPT, which, &told.to_string()])
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
        peer.name = peer.line().wrap_err_with(|| {
            let packages = "numpy and spconv (detector) or torch (train)";
            format!("--python {}: expected an interpreter with {packages}", python.display())
        })?;
        Ok(peer)
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

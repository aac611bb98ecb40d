//! Runs that are watched while they go on.

use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use super::{REALO, end, graph, kill, not_built, root, simulated};

/// Longer than any run takes.
pub const PATIENCE: Duration = Duration::from_secs(180);

fn log() -> PathBuf {
    let args = ["--seed", "913", "--seconds", "4", "--agents", "cav1,cav2,rsu1"];
    simulated("view_small", &args)
}

/// The options of a run over the small log, of one ego.
pub fn options(graph_name: &str, out: &Path, more: &[&str]) -> Vec<String> {
    let (log, out) = (log(), out.to_string_lossy().into_owned());
    let mut all: Vec<String> = vec![
        "run".into(),
        graph(graph_name),
        "--log".into(),
        log.to_string_lossy().into_owned(),
    ];
    all.extend([
        "--ego".into(),
        "cav1".into(),
        "--recorded-detections".into(),
        "--out".into(),
        out,
    ]);
    all.extend(more.iter().map(|more| more.to_string()));
    all
}

/// A run that is watched, and the lines that it says.
pub struct Watched {
    pub process: Child,
    pub lines: Receiver<String>,
    /// Host and port of its server.
    pub host: String,
}

impl Watched {
    /// Starts one with options, and waits until it says where it is shown: `http://` or `ws://`.
    pub fn start(options: Vec<String>, scheme: &str) -> Self {
        let mut command = Command::new(REALO);
        command
            .args(options)
            .current_dir(root())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .process_group(0);
        let mut process = command.spawn().unwrap_or_else(|error| not_built(&error));
        let said = BufReader::new(process.stderr.take().expect("it is piped"));
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            said.lines()
                .map_while(Result::ok)
                .try_for_each(|line| sender.send(line))
        });
        let mut watched = Watched {
            process,
            lines,
            host: String::new(),
        };
        let line = watched.until(scheme);
        let url = line.split_once(scheme).expect("an address").1;
        let host = url.split([' ', '/']).next().expect("a host");
        watched.host = host.to_string();
        watched
    }

    /// The first line from now on that has these words.
    pub fn until(&self, words: &str) -> String {
        let mut said = Vec::new();
        loop {
            let line = self
                .lines
                .recv_timeout(PATIENCE)
                .unwrap_or_else(|_| panic!("never said: {words}: {said:#?}"));
            if line.contains(words) {
                return line;
            }
            said.push(line);
        }
    }

    /// Ends the view, and gives the exit code.
    pub fn close(mut self) -> Option<i32> {
        kill(self.process.id(), "INT");
        self.process.wait().expect("it was started").code()
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        if !matches!(self.process.try_wait(), Ok(Some(_))) {
            end(&mut self.process);
        }
    }
}

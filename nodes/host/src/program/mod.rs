//! Plug-ins: programs that serve a stage over pipes ([`realo_operator::pipe`]).

mod child;
mod guard;
mod outside;

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use serde_yaml::Value;

use realo_graph::FlatNode;
use realo_operator::Registration;
use realo_operator::pipe::{DRIVER, DRIVER_VARIABLE, MEMORY_VARIABLE, memory};

pub use child::Child;
use child::Silence;
pub use guard::Guard;

/// How long a program may take to say hello: it loads its weights before, and Python its packages.
const PATIENCE: Duration = Duration::from_secs(120);
/// How long a call may take in virtual time, which waits for whatever is slow.
const VIRTUAL: Silence = Silence {
    first: Duration::from_secs(600),
    later: Duration::from_secs(600),
};
/// How long a call may take in realtime.
const REALTIME: Silence = Silence {
    first: PATIENCE,
    later: Duration::from_secs(10),
};

/// A program that hosts an operator, as a node of a graph names it.
#[derive(Clone)]
pub struct Program {
    node: String,
    path: PathBuf,
    args: Vec<String>,
    env: BTreeMap<String, OsString>,
    folder: PathBuf,
    silence: Silence,
    /// One that was started to ask for its ports and has not been used yet.
    waiting: Arc<Mutex<Option<Child>>>,
}

impl Program {
    /// The program of a node `program PATH key=value …` in a graph that lies in `folder`; `None` for any other node.
    pub fn of(node: &FlatNode, folder: &Path) -> Option<Self> {
        let path = node.program()?;
        Some(Program {
            node: node.id.clone(),
            path: folder.join(path),
            args: node.settings().to_vec(),
            env: node
                .env
                .iter()
                .map(|(name, value)| (name.clone(), expanded(value)))
                .collect(),
            folder: folder.to_path_buf(),
            silence: VIRTUAL,
            waiting: Arc::default(),
        })
    }

    /// Has nobody wait long for what the program does not answer.
    pub(crate) fn run_in_realtime(&mut self) {
        self.silence = REALTIME;
    }

    /// What the program declares of itself; it is started for that, and kept for [`Program::start`].
    ///
    /// # Errors
    /// Why it is no host of an operator, by the node's id.
    pub fn ask(&self) -> Result<&'static Registration, String> {
        let child = self.start()?;
        let registration = child.registration();
        *self.waiting() = Some(child);
        Ok(registration)
    }

    /// The running program.
    ///
    /// # Errors
    /// As [`Program::ask`].
    pub fn start(&self) -> Result<Child, String> {
        let waiting = self.waiting().take();
        let mut child = match waiting {
            Some(child) => child,
            None => Child::start(&self.node, self.command(), PATIENCE)?,
        };
        child.limit_silence(self.silence);
        Ok(child)
    }

    fn waiting(&self) -> MutexGuard<'_, Option<Child>> {
        self.waiting.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    fn command(&self) -> Command {
        let is_python = self.path.extension().is_some_and(|extension| extension == "py");
        let mut command = match is_python {
            true => {
                let mut python = Command::new(python());
                python.arg("-u").arg(&self.path);
                python
            }
            false => Command::new(&self.path),
        };
        if is_python {
            command.env("PYTHONPATH", python_path(self.env.get("PYTHONPATH")));
        }
        command
            .args(&self.args)
            .envs(self.env.iter().filter(|(name, _)| !is_python || *name != "PYTHONPATH"))
            .env(DRIVER_VARIABLE, DRIVER)
            .current_dir(&self.folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        match memory::probe() {
            Some(place) => command.env(MEMORY_VARIABLE, place.to_string()),
            None => command.env_remove(MEMORY_VARIABLE),
        };
        command
    }
}

/// The name of the interpreter on `PATH` that plug-ins in Python are started by: the one that dora tries first.
pub fn python() -> &'static str {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let there = std::env::split_paths(&path).any(|folder| folder.join("python").is_file());
    if there { "python" } else { "python3" }
}

/// A command of the interpreter that runs plug-ins in Python, which finds the modules that they find.
pub fn interpreter() -> Command {
    let mut command = Command::new(python());
    command.env("PYTHONPATH", python_path(None));
    command
}

/// Where Python looks for modules first: what `PYTHONPATH` says, in the graph or else in the environment; then `python/` of
/// the checkout that this program is of, so that nobody has to install `realo_operator`.
fn python_path(of_graph: Option<&OsString>) -> OsString {
    let given = of_graph.cloned().or_else(|| std::env::var_os("PYTHONPATH"));
    let mut path = given.unwrap_or_default();
    if let Some(folder) = python_folder() {
        if !path.is_empty() {
            path.push(":");
        }
        path.push(folder);
    }
    path
}

/// `python/` of the checkout that this program lies in, or was built from.
fn python_folder() -> Option<PathBuf> {
    let program = std::env::current_exe().and_then(|path| path.canonicalize()).ok();
    let built = Path::new(env!("CARGO_MANIFEST_DIR"));
    let above = program
        .iter()
        .flat_map(|path| path.ancestors())
        .chain(built.ancestors());
    let mut folders = above.map(|folder| folder.join("python"));
    folders.find(|folder| folder.join("realo_operator/__init__.py").is_file())
}

/// A value of `env` with its variables replaced, as dora does it; an unset one is empty.
fn expanded(value: &Value) -> OsString {
    let text = match value {
        Value::String(text) => text.clone(),
        Value::Bool(flag) => flag.to_string(),
        Value::Number(number) => number.to_string(),
        _ => String::new(),
    };
    let mut out = OsString::new();
    let mut rest = text.as_str();
    while let Some((before, after)) = rest.split_once('$') {
        out.push(before);
        rest = after;
        if let Some(after) = rest.strip_prefix('$') {
            out.push("$");
            rest = after;
            continue;
        }
        let (name, after) = variable(rest);
        match name {
            "" => out.push("$"),
            name => out.push(std::env::var_os(name).unwrap_or_default()),
        }
        rest = after;
    }
    out.push(rest);
    out
}

/// The name after a `$`, braces taken away, and what follows it.
fn variable(text: &str) -> (&str, &str) {
    if let Some((name, after)) = text.strip_prefix('{').and_then(|inner| inner.split_once('}')) {
        return (name, after);
    }
    let end = text.find(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    text.split_at(end.unwrap_or(text.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variables_of_the_environment_are_replaced() {
        let home = std::env::var("PATH").unwrap();
        let read = |text: &str| expanded(&Value::from(text)).into_string().unwrap();
        assert_eq!(read("a ${PATH}/b"), format!("a {home}/b"));
        assert_eq!(read("$PATH:$REALO_NO_SUCH_VARIABLE!"), format!("{home}:!"));
        assert_eq!(
            (read("5 $$ and $ alone"), read("${open")),
            ("5 $ and $ alone".into(), "${open".into())
        );
        assert_eq!(expanded(&Value::from(3)), "3");
    }
}

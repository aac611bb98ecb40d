//! Python for the tests: an environment of its own under the target folder.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::build::workspace_target;
use crate::common::python::environment;
use crate::common::root;

/// The folder of its programs. Installs it on first use; the running test is left out if that fails.
pub fn bin() -> Option<PathBuf> {
    let target = workspace_target().join("plugins");
    std::fs::create_dir_all(&target).expect("the folder can be made");
    environment(&target.join("python"), &["numpy", "pyarrow"], "numpy, pyarrow")
}

/// Runs a program with that Python first on the path, and the module to be found by it.
pub fn with(bin: &Path, program: &str, args: &[String]) -> Output {
    let mut command = Command::new(program);
    command.args(args).current_dir(root());
    first_on_path(&mut command, bin)
        .env("PYTHONPATH", root().join("python"))
        .output()
        .expect("it can be started")
}

/// Lets a command find that Python first.
pub fn first_on_path<'a>(command: &'a mut Command, bin: &Path) -> &'a mut Command {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths([bin.to_path_buf()].into_iter().chain(std::env::split_paths(&path)));
    command
        .env("PATH", path.expect("a path can be made"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
}

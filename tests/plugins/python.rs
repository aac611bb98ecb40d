//! Python for the tests: an environment of its own under the target folder.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::common::{REALO, root, text};

/// What the host module needs; `dora-rs` for runs on dora only.
const PACKAGES: [&str; 3] = ["pyarrow", "numpy", "dora-rs==1.1.0"];

/// The folder of its programs. Installs it on first use; says loudly that a test is skipped if that fails.
pub fn bin(test: &str) -> Option<PathBuf> {
    let target = Path::new(REALO)
        .ancestors()
        .nth(2)
        .expect("the program lies in a target folder");
    let home = target.join("plugins/python");
    std::fs::create_dir_all(target.join("plugins")).expect("the folder can be made");
    let lock = File::create(target.join("plugins/python.lock")).expect("the lock can be made");
    lock.lock().expect("locks work");
    let python = home.join("bin/python");
    let works = || {
        Command::new(&python)
            .args(["-c", "import dora, numpy, pyarrow"])
            .output()
            .is_ok_and(|o| o.status.success())
    };
    if !works() {
        let steps = [
            Command::new("python3").args(["-m", "venv"]).arg(&home).output(),
            Command::new(&python)
                .args(["-m", "pip", "install", "--quiet"])
                .args(PACKAGES)
                .output(),
        ];
        let said: Vec<String> = steps.into_iter().flatten().map(|output| text(&output.stderr)).collect();
        if !works() {
            eprintln!(
                "SKIPPED {test}: {} cannot be installed: {}",
                PACKAGES.join(", "),
                said.join("\n")
            );
            return None;
        }
    }
    Some(home.join("bin"))
}

/// Runs a program with that Python first on the path, and the host module to be found by it.
pub fn with(bin: &Path, program: &str, args: &[String]) -> Output {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths([bin.to_path_buf()].into_iter().chain(std::env::split_paths(&path)));
    Command::new(program)
        .args(args)
        .current_dir(root())
        .env("PATH", path.expect("a path can be made"))
        .env("PYTHONPATH", root().join("python"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .expect("it can be started")
}

//! Python for tests: environments of their own.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::text;

/// The folder of the programs of an environment at `home` with these packages, which can import these modules. Installs it on first
/// use; the running test is left out if that fails.
pub fn environment(home: &Path, packages: &[&str], modules: &str) -> Option<PathBuf> {
    let lock = File::create(home.with_extension("lock")).expect("the lock can be made");
    lock.lock().expect("locks work");
    let python = home.join("bin/python");
    let works = || {
        let tried = Command::new(&python)
            .args(["-c", &format!("import {modules}")])
            .output();
        tried.is_ok_and(|output| output.status.success())
    };
    if !works() {
        let install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
        let steps = [
            Command::new("python3").args(["-m", "venv"]).arg(home).output(),
            Command::new(&python).args(install).args(packages).output(),
        ];
        let said: Vec<String> = steps.into_iter().flatten().map(|output| text(&output.stderr)).collect();
        if !works() {
            skipped::skip(&format!(
                "Python 3 with {}, which could not be installed: {}",
                packages.join(", "),
                said.join(" ").trim().replace('\n', " ")
            ));
            return None;
        }
    }
    Some(home.join("bin"))
}

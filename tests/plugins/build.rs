//! Builds crates of plug-ins as their authors would, without the network.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use crate::common::{REALO, root, text};

/// The program of `examples/fusion_nearest`.
pub fn fusion_nearest() -> PathBuf {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    let built = BUILT.get_or_init(|| {
        cargo(&example(), &["build", "--release"]);
        target().join("release/fusion-nearest")
    });
    built.clone()
}

/// The example, with the versions that the workspace was tested with.
pub fn example() -> PathBuf {
    let example = root().join("examples/fusion_nearest");
    if !example.join("Cargo.lock").exists() {
        fs::copy(root().join("Cargo.lock"), example.join("Cargo.lock")).expect("the lock file can be copied");
    }
    example
}

/// Where plug-ins are built: all of them share it.
pub fn target() -> PathBuf {
    example().join("target")
}

/// Runs cargo on a crate, which must succeed; gives what it said.
pub fn cargo(folder: &Path, command: &[&str]) -> String {
    let _compiling = crate::compiling();
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    // What a cargo above says of the crate under test is no matter of this one.
    let above = std::env::vars_os().map(|(name, _)| name).filter(|name| {
        let name = name.to_string_lossy();
        name.starts_with("CARGO") && name != "CARGO_HOME" && name != "CARGO_BUILD_JOBS"
    });
    for name in above {
        cargo.env_remove(name);
    }
    let output = cargo
        .args(command)
        .current_dir(folder)
        .env("CARGO_NET_OFFLINE", "true")
        .output()
        .expect("cargo can be started");
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{command:?}: {out}\n{err}");
    out
}

/// The folder of the program under test's own target folder, for what the tests install.
pub fn workspace_target() -> PathBuf {
    let target = Path::new(REALO).ancestors().nth(2);
    target.expect("the program lies in a target folder").into()
}

//! Builds crates of plug-ins as their authors would, without the network.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;

use crate::common::{REALO, root, text};

/// What plug-ins do is tested, not how fast they are; one level for all, so that nothing is compiled twice.
pub const OPT_LEVEL: &str = "0";

/// The program of `examples/fusion_nearest`.
pub fn fusion_nearest() -> PathBuf {
    built("fusion_nearest", "fusion-nearest")
}

/// The program of an example, built once.
pub fn built(folder: &str, program: &str) -> PathBuf {
    static BUILT: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    let mut built = BUILT.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    if built.insert(folder.into()) {
        cargo(&example_named(folder), &["build", "--release"]);
    }
    target().join("release").join(program)
}

/// `examples/fusion_nearest`.
pub fn example() -> PathBuf {
    example_named("fusion_nearest")
}

/// An example, with the versions that the workspace was tested with and the target folder that all plug-ins share.
pub fn example_named(folder: &str) -> PathBuf {
    let example = root().join("examples").join(folder);
    if !example.join("Cargo.lock").exists() {
        fs::copy(root().join("Cargo.lock"), example.join("Cargo.lock")).expect("the lock file can be copied");
    }
    let own = example.join("target");
    if own != target() && !own.exists() {
        fs::create_dir_all(target()).expect("the folder can be made");
        let linked = std::os::unix::fs::symlink(target(), &own);
        // Another test may have made it.
        assert!(linked.is_ok() || own.exists(), "links can be made: {linked:?}");
    }
    example
}

/// Where plug-ins are built.
pub fn target() -> PathBuf {
    root().join("examples/fusion_nearest/target")
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
        .env("CARGO_PROFILE_RELEASE_OPT_LEVEL", OPT_LEVEL)
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

//! Builds the Rust example with the workspace's lock file and target folder, without the network.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use crate::common::{REALO, root, text};

/// Features that the workspace gives to crates which the example shares with it. Cargo chooses features anew for each
/// workspace; with others it would compile dora once more. A list that is out of date makes the build slow, not wrong.
const SAME_FEATURES: &str = r#"
[target."cfg(all())".dependencies]
bitflags = { version = "2", features = ["std"] }
crc32fast = "1"
crossbeam-deque = "0.8"
hashbrown = { version = "0.16", features = ["serde"] }
matrixmultiply = { version = "0.3", features = ["cgemm"] }
serde_json = { version = "1", features = ["float_roundtrip"] }

[build-dependencies]
cc = { version = "1", features = ["parallel"] }
either = "1"
proc-macro2 = { version = "1", features = ["span-locations"] }
syn = { version = "2", features = ["fold"] }
"#;

/// The program of `examples/fusion_nearest`.
pub fn fusion_nearest() -> PathBuf {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    let built = BUILT.get_or_init(|| {
        cargo(&example(), &["build"]);
        Path::new(REALO).with_file_name("fusion-nearest")
    });
    built.clone()
}

/// Runs cargo on a crate, which must succeed.
pub fn cargo(folder: &Path, command: &[&str]) {
    let profile = Path::new(REALO)
        .parent()
        .expect("the program lies in the profile's folder");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut cargo = Command::new(cargo);
    cargo.args(command).args(["--offline", "--quiet"]);
    if profile.ends_with("release") {
        cargo.arg("--release");
    }
    let output = cargo.arg("--target-dir").arg(target()).current_dir(folder).output();
    let output = output.expect("cargo can be started");
    assert!(
        output.status.success(),
        "{command:?}: {}\n{}",
        text(&output.stdout),
        text(&output.stderr)
    );
}

/// The workspace's target folder.
pub fn target() -> PathBuf {
    Path::new(REALO)
        .ancestors()
        .nth(2)
        .expect("the program lies in a target folder")
        .into()
}

/// The example's manifest for its sources, where the build may write.
pub fn example() -> PathBuf {
    static PREPARED: OnceLock<PathBuf> = OnceLock::new();
    let prepare = || {
        let example = root().join("examples/fusion_nearest");
        let manifest = fs::read_to_string(example.join("Cargo.toml")).expect("the example has a manifest");
        let manifest = manifest.replace("\"../../", &format!("\"{}/", root().display()));
        let (lib, main) = (example.join("src/lib.rs"), example.join("src/main.rs"));
        let sources = format!("\n[lib]\npath = {lib:?}\n\n[[bin]]\nname = \"fusion-nearest\"\npath = {main:?}\n");
        prepare(&target().join("plugins/fusion_nearest"), &(manifest + &sources))
    };
    PREPARED.get_or_init(prepare).clone()
}

/// Writes a crate's manifest beside the workspace's lock file.
pub fn prepare(folder: &Path, manifest: &str) -> PathBuf {
    fs::create_dir_all(folder).expect("the folder can be made");
    let manifest = format!("{manifest}{SAME_FEATURES}");
    // An unchanged file keeps its time, and cargo its build.
    if fs::read_to_string(folder.join("Cargo.toml")).ok().as_ref() != Some(&manifest) {
        fs::write(folder.join("Cargo.toml"), manifest).expect("the manifest can be written");
    }
    fs::copy(root().join("Cargo.lock"), folder.join("Cargo.lock")).expect("the lock file can be copied");
    folder.into()
}

//! Builds the Rust example with the workspace's lock file and target folder, without the network.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

use crate::common::{REALO, root, text};

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
    let _compiling = crate::compiling();
    let profile = Path::new(REALO)
        .parent()
        .expect("the program lies in the profile's folder");
    let mut args = command.to_vec();
    args.push("--quiet");
    if profile.ends_with("release") {
        args.push("--release");
    }
    let target = target().to_string_lossy().into_owned();
    args.extend(["--target-dir", &target]);
    printed(offline(folder).args(args));
}

/// Cargo, without the network and without what a cargo above says of the crate under test: some build scripts look at
/// that, and would run anew.
fn offline(folder: &Path) -> Command {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    let above = std::env::vars_os().map(|(name, _)| name).filter(|name| {
        let name = name.to_string_lossy();
        name.starts_with("CARGO") && name != "CARGO_HOME"
    });
    for name in above {
        cargo.env_remove(name);
    }
    cargo.current_dir(folder).env("CARGO_NET_OFFLINE", "true");
    cargo
}

fn printed(command: &mut Command) -> String {
    let output = command.output().expect("cargo can be started");
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{command:?}: {out}\n{err}");
    out
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

/// Writes a crate's manifest beside the workspace's lock file, with the workspace's features.
///
/// Cargo chooses features anew for each workspace; with others it would compile dora once more. So the manifest asks for
/// those that the workspace gives to the crates that both share.
pub fn prepare(folder: &Path, manifest: &str) -> PathBuf {
    fs::create_dir_all(folder).expect("the folder can be made");
    fs::copy(root().join("Cargo.lock"), folder.join("Cargo.lock")).expect("the lock file can be copied");
    static WORKSPACE: OnceLock<[Features; 2]> = OnceLock::new();
    let theirs = WORKSPACE.get_or_init(|| features(&root(), &["test", "--workspace"]));
    let mut asked = [(); 2].map(|()| Features::new());
    // What is asked for may bring crates that both share, too.
    loop {
        let written = with_features(manifest, &asked);
        // An unchanged file keeps its time, and cargo its build.
        if fs::read_to_string(folder.join("Cargo.toml")).ok().as_ref() != Some(&written) {
            fs::write(folder.join("Cargo.toml"), written).expect("the manifest can be written");
        }
        let before = asked.clone();
        for ((asked, ours), theirs) in asked.iter_mut().zip(features(folder, &["build"])).zip(theirs) {
            let differ = theirs
                .iter()
                .filter(|(name, wanted)| ours.get(*name).is_some_and(|has| has != *wanted));
            asked.extend(differ.map(|(name, wanted)| (name.clone(), wanted.clone())));
        }
        if asked == before {
            return folder.into();
        }
    }
}

/// Features by name and version of a crate.
type Features = BTreeMap<(String, String), Vec<String>>;

/// The features of the crates that a command would build: for the target, and to run while it builds (procedural macros,
/// build scripts), which cargo does not optimise.
fn features(folder: &Path, command: &[&str]) -> [Features; 2] {
    let mut cargo = offline(folder);
    cargo
        .args(command)
        .args(["--release", "--quiet", "--unit-graph", "-Zunstable-options"]);
    // Stable cargo keeps the plan of a build to itself otherwise.
    let plan = printed(cargo.env("RUSTC_BOOTSTRAP", "1"));
    let plan: Value = serde_json::from_str(&plan).expect("a plan is JSON");
    let mut features = [(); 2].map(|()| Features::new());
    for unit in plan["units"].as_array().expect("a plan has units") {
        let is = |path: &str, wanted: &str| unit.pointer(path).is_some_and(|found| found == wanted);
        if !is("/mode", "build") || is("/target/kind/0", "custom-build") {
            continue;
        }
        let package = unit["pkg_id"]
            .as_str()
            .and_then(|id| id.rsplit_once('#')?.1.split_once('@'));
        // The crates of a folder are named otherwise, and are no matter of features.
        let Some((name, version)) = package.filter(|_| is_registry(unit)) else {
            continue;
        };
        let has = unit["features"].as_array().into_iter().flatten();
        let has = has.filter_map(|feature| feature.as_str().map(String::from)).collect();
        let host = usize::from(is("/profile/opt_level", "0"));
        features[host].insert((name.into(), version.into()), has);
    }
    features
}

fn is_registry(unit: &Value) -> bool {
    unit["pkg_id"].as_str().is_some_and(|id| id.starts_with("registry+"))
}

fn with_features(manifest: &str, asked: &[Features; 2]) -> String {
    let all: BTreeSet<&(String, String)> = asked.iter().flat_map(BTreeMap::keys).collect();
    let mut manifest = manifest.to_string();
    for (table, asked) in ["target.\"cfg(all())\".dependencies", "build-dependencies"]
        .iter()
        .zip(asked)
    {
        manifest += &format!("\n[{table}]\n");
        for ((name, version), features) in asked {
            // A crate has one name in a manifest; where two versions are asked for, each has another.
            let versions = all.iter().filter(|(other, _)| other == name).count();
            let key = match versions {
                1 => name.clone(),
                _ => format!("{name}-{}", version.replace(['.', '+'], "-")),
            };
            manifest += &format!(
                "{key} = {{ package = {name:?}, version = \"={version}\", default-features = false, \
                 features = {features:?} }}\n"
            );
        }
    }
    manifest
}

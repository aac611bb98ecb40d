//! Builds the Rust example with the workspace's lock file and target folder, without the network.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

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
    cargo_says(folder, &args);
}

/// What cargo prints, without the network.
fn cargo_says(folder: &Path, args: &[&str]) -> String {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo)
        .args(args)
        .arg("--offline")
        .current_dir(folder)
        .output()
        .expect("cargo can be started");
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{args:?}: {out}\n{err}");
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
    let theirs = WORKSPACE.get_or_init(|| features(&root(), &["--workspace"], "normal,build,dev"));
    let mut asked = [(); 2].map(|()| Features::new());
    // What is asked for may bring crates that both share, too.
    loop {
        let written = with_features(manifest, &asked);
        // An unchanged file keeps its time, and cargo its build.
        if fs::read_to_string(folder.join("Cargo.toml")).ok().as_ref() != Some(&written) {
            fs::write(folder.join("Cargo.toml"), written).expect("the manifest can be written");
        }
        let before = asked.clone();
        for ((asked, ours), theirs) in asked.iter_mut().zip(features(folder, &[], "normal,build")).zip(theirs) {
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
type Features = BTreeMap<(String, String), String>;

/// The features of a workspace's crates: of those that are built for the target, and of those that run while it builds.
fn features(folder: &Path, options: &[&str], edges: &str) -> [Features; 2] {
    let tree = |edges: &str| {
        let format = ["--prefix", "none", "--format", "{p}|{f}", "--edges", edges];
        let said = cargo_says(folder, &[&["tree"][..], options, &format].concat());
        let crates = said.lines().filter_map(|line| {
            let (package, features) = line.trim_end_matches(" (*)").split_once('|')?;
            let (name, rest) = package.split_once(" v")?;
            // A crate of a folder belongs to one of the two only.
            (!rest.contains(" (/")).then(|| {
                let version = rest.split(' ').next().unwrap_or(rest);
                ((name.to_string(), version.to_string()), features.to_string())
            })
        });
        crates.collect::<BTreeSet<_>>()
    };
    let target = tree(&format!(
        "{},no-proc-macro",
        edges.replace("build,", "").replace(",build", "")
    ));
    let mut host: Features = target.iter().cloned().collect();
    host.extend(tree(edges).difference(&target).cloned());
    [target.into_iter().collect(), host]
}

fn with_features(manifest: &str, asked: &[Features; 2]) -> String {
    let mut manifest = manifest.to_string();
    for (table, asked) in ["target.\"cfg(all())\".dependencies", "build-dependencies"]
        .iter()
        .zip(asked)
    {
        manifest += &format!("\n[{table}]\n");
        for (number, ((name, version), features)) in asked.iter().enumerate() {
            let features: Vec<&str> = features.split(',').filter(|feature| !feature.is_empty()).collect();
            manifest += &format!(
                "same-{number} = {{ package = {name:?}, version = \"={version}\", default-features = false, \
                 features = {features:?} }}\n"
            );
        }
    }
    manifest
}

//! Output paths, keys, weights and open ports.

use std::fs;
use std::path::Path;

use crate::common::{self, folder, realo, root, text};
use crate::scene;

/// What a user would miss.
const NOTES: &str = "what I must not forget";

#[test]
fn a_file_that_realo_did_not_write_is_not_replaced() {
    let folder = folder("doors-foreign");
    let log = scene::Scene::default().write("doors-log").display().to_string();
    let at = |name: &str| {
        let path = folder.join(name);
        fs::write(&path, NOTES).expect("the folder can be written");
        path.display().to_string()
    };
    let graph = common::graph("late_fusion");
    let (mcap, svg, csv) = (at("notes.mcap"), at("notes.svg"), at("notes.csv"));
    let recorder = format!("score.recorder.path={mcap}");
    let out = folder.join("out").display().to_string();
    let commands: [&[&str]; 5] = [
        &["merge", &log, &log, "-o", &mcap],
        &["precompute", &log, &graph, "-o", &mcap],
        &["render", &out, "-o", &svg],
        &["latency", "--peer", "tcp/127.0.0.1:9", "--log", &log, "-o", &csv],
        &[
            "run",
            &graph,
            "--log",
            &log,
            "--offline",
            "--recorded-detections",
            "--out",
            &out,
            "--set",
            &recorder,
        ],
    ];
    for command in commands {
        let output = realo(command);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{command:?}: {said}");
        assert!(
            said.contains("refuse to overwrite") && said.contains("notes."),
            "{command:?}: {said}"
        );
    }
    for path in [&mcap, &svg, &csv] {
        assert_eq!(fs::read_to_string(path).ok().as_deref(), Some(NOTES), "{path}");
    }
}

#[test]
fn a_public_key_of_another_program_stays() {
    let folder = folder("doors-keys");
    let public = folder.join("id.pub");
    let ssh = "ssh-ed25519 AAAA me\n";
    fs::write(&public, ssh).expect("the folder can be written");
    let place = folder.display().to_string();
    let new = ["keys", "new", "id", "-o", &place];
    let refused = realo(new);
    let said = text(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{said}");
    assert!(
        said.contains("refuse to overwrite") && said.contains("id.pub"),
        "{said}"
    );
    assert!(!folder.join("id.key").exists(), "a key that nobody knows");
    let forced = realo(new.iter().chain(&["--force"]));
    assert!(forced.status.success(), "{}", text(&forced.stderr));
    let key = folder.join("id.key").display().to_string();
    assert!(realo(["keys", "public", &key]).status.success(), "its own is replaced");
    fs::write(&public, ssh).expect("the folder can be written");
    assert_eq!(realo(["keys", "public", &key]).status.code(), Some(1));
    assert_eq!(fs::read_to_string(&public).ok().as_deref(), Some(ssh));
    assert!(realo(["keys", "public", &key, "--force"]).status.success());
}

#[test]
fn weights_with_a_flipped_bit_are_refused() {
    let folder = folder("doors-weights");
    let models = root().join("models");
    for name in ["lite.toml", "lite.safetensors"] {
        fs::copy(models.join(name), folder.join(name)).expect("the folder can be written");
    }
    let weights = folder.join("lite.safetensors");
    let mut bytes = fs::read(&weights).expect("weights");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 16;
    fs::write(&weights, bytes).expect("the folder can be written");
    let log = scene::Scene::default().write("doors-weights-log");
    let said = said_of_model(&folder.join("lite.toml"), &log);
    assert!(said.contains("lite.safetensors: expected SHA-256"), "{said}");
}

fn said_of_model(model: &Path, log: &Path) -> String {
    let (graph, model, log) = (
        common::graph("late_fusion"),
        model.to_string_lossy(),
        log.to_string_lossy(),
    );
    let out = folder("doors-weights-out").display().to_string();
    let output = realo([
        "run",
        &graph,
        "--offline",
        "--model",
        &model,
        "--log",
        &log,
        "--out",
        &out,
    ]);
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stdout));
    text(&output.stderr)
}

/// A disk without room, where one can be mounted.
#[test]
fn a_key_that_cannot_be_written_leaves_nothing_behind() {
    let script = format!(
        "mount -t tmpfs -o size=4k,nr_inodes=8 tmpfs \"$1\" && head -c 4096 /dev/zero > \"$1/full\"; \"{}\" keys new cav1 -o \"$1\"; \
         code=$?; ls \"$1\"; exit $code",
        common::REALO
    );
    let place = folder("doors-full");
    let output = std::process::Command::new("unshare")
        .args(["-m", "bash", "-c", &script, "bash"])
        .arg(&place)
        .output();
    let Some(output) = output
        .ok()
        .filter(|output| !text(&output.stderr).contains("ermission denied"))
    else {
        return skipped::skip("a mount namespace, as root");
    };
    let said = text(&output.stderr);
    if said.contains("unshare") {
        return skipped::skip("a mount namespace, as root");
    }
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert_eq!(text(&output.stdout).trim(), "full", "{said}");
    assert!(said.contains("cav1.key") && said.contains("make room"), "{said}");
}

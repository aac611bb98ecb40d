//! Whom an agent believes.

use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};

use super::{Peer, arguments, assert_books_add_up, folder, free_port, json, log, quarter, realo, realo_ok, root, text};

/// Keys of agents in a folder, and a list of those that trust each other.
fn keys(dir: &Path, agents: &[&str]) {
    let dir_text = dir.display().to_string();
    let list = dir.join("trust.toml").display().to_string();
    for agent in agents {
        realo_ok(["keys", "new", agent, "-o", &dir_text]);
        let public = dir.join(format!("{agent}.pub")).display().to_string();
        realo_ok(["keys", "trust", &public, "--list", &list]);
    }
}

fn sets(dir: &Path, agent: &str) -> [String; 2] {
    let file = |name: String| dir.join(name).display().to_string();
    [
        format!("v2x.key={}", file(format!("{agent}.key"))),
        format!("v2x.trust={}", file("trust.toml".into())),
    ]
}

/// An agent that plays its part of the log again and again.
fn start(agent: &str, out: &Path, set: &[String]) -> Peer {
    let mut all = arguments("late_fusion.roadside", &log(), out, set);
    all.extend(["--ego", agent, "--set", "player.repeat=20"].map(String::from));
    Peer::spawn(all)
}

/// What was refused in a peer's name.
fn refused(result: &Value, peer: &str) -> Value {
    let peers = result["peers"].as_array().expect("peers").iter();
    let mut found = peers.filter(|known| known["name"] == peer);
    let found = found
        .next()
        .unwrap_or_else(|| panic!("{peer} is in {}", result["peers"]));
    found["refused"].clone()
}

#[test]
fn only_what_trusted_agents_signed_comes_in_and_all_else_is_named() {
    let _share = quarter();
    let (log, port, near) = (log(), free_port(), folder("security_signed"));
    let (ours, theirs) = (folder("security_keys"), folder("security_other_keys"));
    keys(&ours, &["cav1", "rsu1", "cav2"]);
    keys(&theirs, &["cav1", "cav2", "mallory"]);
    let connect = [format!("v2x.connect=tcp/127.0.0.1:{port}")];
    let start = |agent: &str, keys: &[String]| {
        let far = folder(&format!("security_{agent}"));
        start(agent, &far, &[&connect, keys].concat())
    };
    let _peers = [
        start("rsu1", &sets(&ours, "rsu1")),
        start("rsu2", &[]),
        // Somebody who has a key for a name that is trusted, but not its owner's.
        start("cav2", &sets(&theirs, "cav2")),
    ];
    let mut set = sets(&ours, "cav1").to_vec();
    set.extend([format!("v2x.listen=tcp/127.0.0.1:{port}"), "player.repeat=3".into()]);
    let said = realo_ok(arguments("late_fusion.vehicle", &log, &near, &set));
    let result = json(&near.join("result.json"));
    assert_books_add_up(&result);
    let links = result["links"].as_object().expect("links");
    assert_eq!(links.keys().collect::<Vec<_>>(), ["rsu1-cav1"]);
    assert!(links["rsu1-cav1"]["boxes"]["used"].as_u64() > Some(10), "{links:?}");
    assert_eq!(refused(&result, "rsu1"), json!({}));
    assert!(refused(&result, "rsu2")["strangers"].as_u64() > Some(0), "{result}");
    assert!(refused(&result, "cav2")["forged"].as_u64() > Some(0), "{result}");
    assert!(said.contains(" forged") && said.contains(" strangers"), "{said}");
}

#[test]
fn keys_that_cannot_be_are_reported() {
    let (dir, log, near) = (folder("security_wrong"), log(), folder("security_wrong_out"));
    keys(&dir, &["cav1", "rsu1"]);
    let file = |name: &str| dir.join(name).display().to_string();
    let refused = |set: &[String]| {
        let output = realo(arguments("late_fusion.vehicle", &log, &near, set));
        assert!(!output.status.success(), "{set:?}");
        text(&output.stderr)
    };
    let [key, other, trust] = ["cav1.key", "rsu1.key", "trust.toml"].map(file);
    for (set, expected) in [
        (vec![format!("v2x.key={key}")], "setting `trust`: expected a file"),
        (vec![format!("v2x.trust={trust}")], "setting `key`: expected a file"),
        (
            vec![format!("v2x.key={other}"), format!("v2x.trust={trust}")],
            "expected the key of `cav1` (setting `agent`), found that of `rsu1`",
        ),
        (
            vec![format!("v2x.key={trust}"), format!("v2x.trust={trust}")],
            "trust.toml: ",
        ),
        (
            vec![format!("v2x.key={key}"), format!("v2x.trust={key}")],
            "cav1.key: list: expected [agents]",
        ),
        (
            vec![format!("v2x.key={}", file("none.key")), format!("v2x.trust={trust}")],
            "none.key: ",
        ),
        (vec![format!("v2x.zenoh={}", file("none.yml"))], "setting `zenoh`: "),
        (vec![format!("v2x.zenoh={trust}")], "setting `zenoh`: "),
    ] {
        let found = refused(&set);
        assert!(found.contains(expected), "{set:?}: {found}");
    }
    let settings = |text: &str| {
        let path = dir.join("zenoh.yml");
        std::fs::write(&path, text).expect("a file");
        refused(&[format!("v2x.zenoh={}", path.display())])
    };
    let found = settings("mode: client");
    assert!(
        found.contains("`mode`: expected what the radio has no setting for"),
        "{found}"
    );
    let found = settings("transport: { link: { tls: { enable_mtl: true } } }");
    assert!(found.contains("`transport/link/tls/enable_mtl`"), "{found}");
    let again = realo(["keys", "new", "cav1", "-o", &dir.display().to_string()]);
    assert!(
        !again.status.success() && text(&again.stderr).contains("stays"),
        "{}",
        text(&again.stderr)
    );
    let public = dir.join("cav1.pub");
    let before = std::fs::read(&public).expect("the public half");
    std::fs::remove_file(&public).expect("a file");
    realo_ok(["keys", "public", &key]);
    assert_eq!(std::fs::read(&public).expect("it is there again"), before);
    // Where the public half cannot be written there is no private one either.
    std::fs::create_dir(dir.join("cav3.pub")).expect("a folder");
    let made = realo(["keys", "new", "cav3", "-o", &dir.display().to_string()]);
    assert!(text(&made.stderr).contains("cav3.pub"), "{}", text(&made.stderr));
    assert!(!dir.join("cav3.key").exists());
    let more = folder("security_wrong_more");
    keys(&more, &["cav1"]);
    let public = more.join("cav1.pub").display().to_string();
    let joined = realo(["keys", "trust", &public, "--list", &trust]);
    assert!(
        text(&joined.stderr).contains("another key of cav1"),
        "{}",
        text(&joined.stderr)
    );
}

/// An agent's settings of Zenoh in examples/security, with certificates of a folder.
fn settings(kind: &str, certificates: &Path, out: &Path) -> String {
    let example = root().join("examples/security").join(format!("{kind}.zenoh.yml"));
    let text = std::fs::read_to_string(example).expect("the example");
    let text = text.replace("../certificates", &certificates.display().to_string());
    std::fs::write(out, text).expect("a file");
    format!("v2x.zenoh={}", out.display())
}

#[test]
fn the_example_lets_in_who_has_a_certificate_and_only_as_whom_it_names() {
    let _share = quarter();
    let (log, port) = (log(), free_port());
    let [ours, theirs, near] = ["security_ours", "security_theirs", "security_tls"].map(folder);
    for (dir, agents) in [(&ours, "cav1 rsu1"), (&theirs, "rsu1")] {
        let script = root().join("examples/security/certificates.sh");
        let agents = agents.split(' ').map(|agent| format!("{agent}=127.0.0.1"));
        let made = match Command::new("sh").arg(script).arg(dir).args(agents).output() {
            Ok(made) if text(&made.stderr).contains("openssl: not found") => None,
            made => made.ok(),
        };
        let Some(made) = made else {
            return skipped::skip("`openssl`, which makes certificates");
        };
        assert!(made.status.success(), "{}", text(&made.stderr));
    }
    let address = format!("v2x.connect=tls/127.0.0.1:{port}");
    let start = |agent: &str, certificates: &Path, name: &str| {
        let far = folder(name);
        let settings = settings("roadside", certificates, &far.with_extension("yml"));
        self::start(agent, &far, &[address.clone(), settings])
    };
    let _peers = [
        start("rsu1", &ours, "security_tls_rsu1"),
        // With rsu1's certificate as somebody else, and with a certificate of another authority.
        start("rsu2", &ours, "security_tls_rsu2"),
        start("cav2", &theirs, "security_tls_cav2"),
    ];
    let set = [
        format!("v2x.listen=tls/127.0.0.1:{port}"),
        settings("vehicle", &ours, &near.with_extension("yml")),
        "player.repeat=3".into(),
    ];
    realo_ok(arguments("late_fusion.vehicle", &log, &near, &set));
    let result = json(&near.join("result.json"));
    assert_books_add_up(&result);
    let links = result["links"].as_object().expect("links");
    assert_eq!(links.keys().collect::<Vec<_>>(), ["rsu1-cav1"]);
    assert!(links["rsu1-cav1"]["boxes"]["used"].as_u64() > Some(10), "{links:?}");
}

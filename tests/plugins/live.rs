//! A graph that plays no log: `realo run` ends it in order by Ctrl-C, and has its results.

use std::fs;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use crate::common::machine::decided;
use crate::common::{self, folder, json, kill, root, text, until};
use crate::{alone, python};

/// The graph of a program that brings boxes, and results.
fn graph(dir: &Path) -> PathBuf {
    for link in ["types", "bin"] {
        std::os::unix::fs::symlink(root().join("dataflows").join(link), dir.join(link)).expect("links can be made");
    }
    let source = root().join("tests/plugins/live_source.py");
    let text = format!(
        "strict_types: true\nnodes:\n  - id: source\n    path: bin/realo\n    args: program {}\n    outputs: [boxes]\n    \
         output_types: {{ boxes: realo/v1/Boxes }}\n  - id: results\n    path: bin/realo\n    args: node results out=results\n    \
         inputs: {{ boxes: source/boxes }}\n",
        source.display()
    );
    let path = dir.join("live.yml");
    fs::write(&path, text).expect("it can be written");
    path
}

fn live(bin: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(common::REALO);
    command
        .args(args)
        .current_dir(root())
        .env("PYTHONPATH", root().join("python"));
    python::first_on_path(&mut command, bin);
    command
}

/// A run that no failure of a test leaves behind.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        common::end(&mut self.0);
    }
}

#[test]
fn ctrl_c_ends_a_graph_without_a_log_in_order() {
    decided(ended_in_order);
}

fn ended_in_order() {
    let Some(bin) = python::bin() else {
        return;
    };
    let dir = folder("live");
    let (graph, out) = (graph(&dir), dir.join("out"));
    let _alone = alone();
    let args = ["run", &graph.to_string_lossy(), "--out", &out.to_string_lossy()].map(String::from);
    let mut command = live(&bin, &args.each_ref().map(String::as_str));
    let child = command
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .process_group(0)
        .spawn();
    let mut child = Ended(child.expect("it can be started"));
    let log = || fs::read_to_string(out.join("dora.log")).unwrap_or_default();
    until("boxes came", || log().contains("the first message of `boxes` was sent"));
    std::thread::sleep(std::time::Duration::from_millis(1500));
    kill(child.0.id(), "INT");
    let mut status = None;
    until("the run ended", || {
        status = child.0.try_wait().expect("it can be asked");
        status.is_some()
    });
    let [out_text, errors] = [
        std::io::read_to_string(child.0.stdout.take().expect("it is piped")),
        std::io::read_to_string(child.0.stderr.take().expect("it is piped")),
    ];
    let said = format!("{}{}", out_text.expect("text"), errors.expect("text"));
    assert_eq!(status.and_then(|status| status.code()), Some(130), "{said}\n{}", log());
    assert!(
        said.contains("ended by Ctrl-C; these are the results until then"),
        "{said}"
    );
    assert!(log().contains("live-source ended in order after"), "{}", log());
    let result = json(&out.join("result.json"));
    assert_eq!(result["ended_by"], "Ctrl-C");
}

#[test]
fn options_of_logs_are_refused_where_none_is_played() {
    let Some(bin) = python::bin() else {
        return;
    };
    let dir = folder("live_refused");
    let graph = graph(&dir).to_string_lossy().into_owned();
    for (option, words) in [("--offline", &["--offline"][..]), ("--ego", &["--ego", "car"])] {
        let output = live(&bin, &[&["run", &graph], words].concat())
            .output()
            .expect("it can be started");
        let said = text(&output.stderr);
        assert!(
            !output.status.success() && said.contains(&format!("{option}: ")) && said.contains("plays no log"),
            "{said}"
        );
    }
}

//! Follows `docs/guide/your-fusion.md` to the letter: the files that it gives, the commands that it says.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::common::{files_below, root, text};
use crate::{build, python};

fn guide() -> String {
    fs::read_to_string(root().join("docs/guide/your-fusion.md")).expect("the guide can be read")
}

/// The user's folder with the files of sections, beside a link `realo` to the checkout.
pub fn folder(name: &str, sections: &[&str]) -> PathBuf {
    let parent = build::workspace_target().join("plugins").join(name);
    let mine = parent.join("mine");
    let _ = fs::remove_dir_all(&parent);
    fs::create_dir_all(&mine).expect("the folder can be made");
    symlink(root(), parent.join("realo")).expect("links can be made");
    let text: String = sections.iter().map(|section| of(section)).collect();
    for part in text.split("<!-- file: ").skip(1) {
        let (name, rest) = part.split_once(" -->").expect("a file's mark ends");
        let content = rest.split("```").nth(1).and_then(|fenced| fenced.split_once('\n'));
        let (_, content) = content.expect("a file's content follows its mark");
        let path = mine.join(name);
        fs::create_dir_all(path.parent().expect("it lies in a folder")).expect("the folder can be made");
        // Below this repository cargo has to know that the crate is none of its members.
        let content = match name {
            "Cargo.toml" => format!("{content}\n[workspace]\n"),
            _ => content.into(),
        };
        fs::write(path, content).expect("the file can be written");
    }
    mine
}

/// Lets the user's crate share what was compiled for the example.
pub fn share_target(mine: &Path) {
    symlink(build::target(), mine.join("target")).expect("links can be made");
}

/// A section of the guide, to the next of its level.
fn of(section: &str) -> String {
    let guide = guide();
    let (_, text) = guide
        .split_once(&format!("\n## {section}\n"))
        .expect("the guide has the section");
    text.split("\n## ").next().unwrap_or_default().into()
}

/// Runs the shell commands of a section, with Python first on the path where there is one; they must succeed. Gives what
/// they printed.
pub fn shell(mine: &Path, section: &str, bin: Option<&Path>) -> String {
    let section = of(section);
    let blocks = section
        .split("```sh\n")
        .skip(1)
        .filter_map(|block| block.split("```").next());
    let script: Vec<&str> = blocks.collect();
    assert!(!script.is_empty(), "the section says what to do");
    let mut command = Command::new("sh");
    command.args(["-euc", &script.join("\n")]).current_dir(mine);
    for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("CARGO")) {
        if name != "CARGO_HOME" && name != "CARGO_BUILD_JOBS" {
            command.env_remove(name);
        }
    }
    command
        .env("CARGO_NET_OFFLINE", "true")
        .env("CARGO_PROFILE_RELEASE_OPT_LEVEL", build::OPT_LEVEL);
    if let Some(bin) = bin {
        python::first_on_path(&mut command, bin);
    }
    let output = command.output().expect("a shell can be started");
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{out}{err}");
    out + &err
}

/// Whether documentation comments have an example that rustdoc would run.
fn has_example(text: &str) -> bool {
    let comments = text.lines().filter_map(|line| {
        let line = line.trim_start();
        ["///", "//!"].iter().find_map(|mark| line.strip_prefix(mark))
    });
    let fences = comments.filter_map(|comment| comment.trim().strip_prefix("```"));
    // Every other fence ends what one began.
    let mut kinds = fences.step_by(2);
    kinds.any(|kind| {
        kind.is_empty()
            || ["rust", "no_run", "should_panic"]
                .iter()
                .any(|run| kind.starts_with(run))
    })
}

/// Crates without examples spare rustdoc a pass over them; whoever adds the first one has to let it run.
#[test]
fn examples_in_the_documentation_of_crates_are_tested() {
    let mut examples = 0;
    for group in ["", "operators", "nodes", "tools"] {
        let crates = fs::read_dir(root().join(group)).expect("the folder is there").flatten();
        for dir in crates.map(|entry| entry.path()) {
            let Ok(manifest) = fs::read_to_string(dir.join("Cargo.toml")) else {
                continue;
            };
            let texts = files_below(&dir.join("src"))
                .into_iter()
                .filter_map(|path| fs::read_to_string(path).ok());
            let has = texts.filter(|text| has_example(text)).count();
            examples += has;
            let left_out = manifest.contains("doctest = false");
            assert!(
                has == 0 || !left_out,
                "{}: `doctest = false`, though it has examples",
                dir.display()
            );
        }
    }
    assert!(examples > 2, "there are examples");
}

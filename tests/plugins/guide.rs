//! Follows `docs/compose.md` by the letter: the files that it gives, the commands that it says.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::build;
use crate::common::{root, text};

fn text_of_guide() -> String {
    fs::read_to_string(root().join("docs/compose.md")).expect("the guide can be read")
}

/// The user's folder with the guide's files, beside a link `realo` to the checkout.
pub fn folder() -> PathBuf {
    let parent = build::target().join("plugins/guide");
    let mine = parent.join("mine");
    let _ = fs::remove_dir_all(&parent);
    fs::create_dir_all(&mine).expect("the folder can be made");
    symlink(root(), parent.join("realo")).expect("links can be made");
    symlink(build::target(), mine.join("target")).expect("links can be made");
    let guide = text_of_guide();
    let mut manifest = None;
    for part in guide.split("<!-- file: ").skip(1) {
        let (name, rest) = part.split_once(" -->").expect("a file's mark ends");
        let content = rest.split("```").nth(1).and_then(|fenced| fenced.split_once('\n'));
        let (_, content) = content.expect("a file's content follows its mark");
        let path = mine.join(name);
        fs::create_dir_all(path.parent().expect("it lies in a folder")).expect("the folder can be made");
        match name {
            // Below this repository cargo has to be told that the crate is none of its members.
            "Cargo.toml" => manifest = Some(format!("{content}\n[workspace]\n{PROFILE}")),
            _ => fs::write(path, content).expect("the file can be written"),
        }
    }
    build::prepare(&mine, &manifest.expect("the guide has a manifest"))
}

/// As in the workspace, so that both share what is compiled.
const PROFILE: &str = "\n[profile.release]\ndebug = false\nincremental = true\n";

/// Runs the shell commands of a section, those lines that are wanted; they must succeed. Gives what they printed.
pub fn shell(mine: &Path, section: &str, wanted: impl Fn(&str) -> bool) -> String {
    let guide = text_of_guide();
    let (_, section) = guide.split_once(section).expect("the guide has the section");
    let section = section.split("\n## ").next().unwrap_or_default();
    let blocks = section
        .split("```sh\n")
        .skip(1)
        .filter_map(|block| block.split("```").next());
    let script: Vec<&str> = blocks.flat_map(str::lines).filter(|line| wanted(line)).collect();
    assert!(!script.is_empty(), "the section says what to do");
    let output = Command::new("sh")
        .args(["-euc", &script.join("\n")])
        .current_dir(mine)
        .output();
    let output = output.expect("a shell can be started");
    assert!(
        output.status.success(),
        "{}{}",
        text(&output.stdout),
        text(&output.stderr)
    );
    text(&output.stdout)
}

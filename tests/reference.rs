//! The page of all commands is what the programs say, and a command of the workbench is named.

use std::path::Path;
use std::process::Command;

#[test]
fn the_page_of_all_commands_is_what_the_programs_say() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/reference/cli.md");
    let found = std::fs::read_to_string(&page).unwrap_or_default();
    let [car, lab] = [realo::command_line(), realo_lab::command_line()].map(realo_cli::markdown);
    let expected = format!("{}{car}{lab}", realo_cli::HEAD);
    assert!(
        found == expected,
        "{}: written anew by `(realo cli-reference; realo-lab cli-reference) > docs/reference/cli.md`",
        page.display()
    );
}

#[test]
fn a_command_of_the_workbench_is_named() {
    let train = Command::new(env!("CARGO_BIN_EXE_realo"))
        .args(["train", "lite"])
        .output();
    let output = train.expect("realo can be started");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(
        said.contains("`realo train` is `realo-lab train`") && said.contains("cargo build --release -p realo-lab"),
        "{said}"
    );
}

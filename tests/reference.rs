//! The page of all commands is what the programs say, and a command of the workbench is named.

use std::path::Path;
use std::process::Command;

use realo_scoring::{Protocol, SuperClass};

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
fn the_page_of_protocols_has_the_classes_of_shipped_ones() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/reference/protocols.md");
    let found = std::fs::read_to_string(&page).unwrap_or_default();
    let rows = |name: &str| {
        let protocol = Protocol::load(name).expect("it ships");
        let row = |class: &SuperClass| format!("| `{name}` | {} | {} |\n", class.name, class.raw.join(", "));
        protocol.classes.iter().map(row).collect::<String>()
    };
    for name in ["default", "dair"] {
        let expected = rows(name);
        assert!(found.contains(&expected), "{}: expected\n{expected}", page.display());
    }
    for other in ["dair-vehicle", "dair-roadside"] {
        assert_eq!(rows(other), rows("dair").replace("`dair`", &format!("`{other}`")));
    }
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
        said.contains("`train` is a command of `realo-lab`") && said.contains("realo-lab train lite"),
        "{said}"
    );
}

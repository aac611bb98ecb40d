//! `realo-lab measure` and `bench` as a user meets them, in a small tree whose steps are shell commands.

mod common;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use common::{LAB, folder, kill, text, until};

const PAGES: &str = "tools/lab/src/measure/pages";
const HEAD: &str = "title = 'T'\nkind = 'scores'\nabout = 'A'\n";
/// A step that runs until the file `go` is there.
const WAITS: &str = "[[steps]]\nname = 'slow'\nprogram = 'realo'\n\
                     args = ['-c', 'echo $$ > pid; until test -e go; do sleep 0.05; done; echo done > {out}']\n";
const TABLE: &str = "[[tables]]\ntitle = 'T'\nhead = 'h'\ncolumns = ['x']\nrows = [{ label = 'l', run = 'a' }]\n\
                     [columns.x]\ntitle = 'x'\npaths = ['/x']\nformat = '0'\n";

/// A repository with pages, and programs beside each other: the workbench, and a shell in place of `realo`.
struct Tree(PathBuf);

impl Tree {
    fn new(name: &str, pages: &[(&str, String)]) -> Self {
        let tree = Tree(folder(name).canonicalize().expect("it is there"));
        for (page, text) in pages {
            tree.write(&format!("{PAGES}/{page}.toml"), &format!("{HEAD}{text}"));
        }
        for file in [
            "tools/lab/src/measure/columns.toml",
            "tools/lab/src/measure/paper.toml",
            "dataflows/modules/a",
            "dataflows/types/a",
            "models/a",
        ] {
            tree.write(file, "");
        }
        tree.write("bin/realo", "#!/bin/sh\nexec sh \"$@\"\n");
        let realo = tree.at("bin/realo");
        fs::set_permissions(&realo, fs::Permissions::from_mode(0o755)).expect("it can be changed");
        let lab = LAB.expect("a test of the package `realo-lab`");
        fs::hard_link(lab, tree.at("bin/realo-lab")).expect("on one file system");
        for program in ["realo", "realo-lab"] {
            tree.write(
                &format!("bin/{program}.d"),
                &format!("{program}: {}/source.rs\n", tree.0.display()),
            );
        }
        // A source older than both programs.
        tree.write("source.rs", "");
        let source = fs::File::options()
            .write(true)
            .open(tree.at("source.rs"))
            .expect("a file");
        source.set_modified(std::time::UNIX_EPOCH).expect("it can be changed");
        tree
    }

    fn at(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    fn write(&self, name: &str, text: &str) {
        let path = self.at(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("folders can be made");
        fs::write(path, text).expect("the folder can be written");
    }

    fn commit(&self) {
        self.commit_files(&["tools"]);
    }

    fn commit_files(&self, files: &[&str]) {
        for args in [
            &["init", "-q"][..],
            &[&["add"], files].concat(),
            &["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "-m", "a"],
        ] {
            let done = Command::new("git").args(args).current_dir(&self.0).status();
            assert!(done.expect("there is git").success(), "{args:?}");
        }
    }

    fn command(&self, args: &[&str], folder: &Path) -> Command {
        // Whoever starts tests in the background of a script has them ignore Ctrl-C, and all that they start.
        let mut command = Command::new("/usr/bin/env");
        command.arg("--default-signal=INT").arg(self.at("bin/realo-lab"));
        command.args(args).current_dir(folder);
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    }

    fn measure(&self, args: &[&str]) -> Output {
        let args = [&["measure", "--out", "pages"], args].concat();
        self.command(&args, &self.0).output().expect("it can be started")
    }

    /// What a call that must fail says.
    fn refused(&self, args: &[&str]) -> String {
        let output = self.measure(args);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        said
    }

    /// The process of the step that waits.
    fn step(&self) -> u32 {
        let read = || fs::read_to_string(self.at("pid")).ok()?.trim().parse().ok();
        until("the step runs", || read().is_some());
        read().expect("a number")
    }
}

fn is_alive(process: u32) -> bool {
    // What nobody waits for stays as a zombie.
    let state = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    let state = state.rsplit_once(") ").map_or("", |(_, rest)| rest);
    !state.is_empty() && !state.starts_with('Z')
}

#[test]
fn a_page_is_measured_by_one_call_at_a_time_and_other_pages_beside_it() {
    let other = "[[steps]]\nname = 'slow'\nprogram = 'realo'\nargs = ['-c', 'echo other > {out}']\n";
    let tree = Tree::new("measure-lock", &[("one", WAITS.into()), ("two", other.into())]);
    tree.commit();
    let args = ["measure", "--out", "pages", "one"];
    let first = tree.command(&args, &tree.0).spawn().expect("it can be started");
    tree.step();
    let said = tree.refused(&["one"]);
    for part in [
        "target/realo/measured/one: process ",
        &first.id().to_string(),
        "wait until",
    ] {
        assert!(said.contains(part), "{part} is not in {said}");
    }
    let beside = tree.measure(&["two"]);
    assert!(beside.status.success(), "{}", text(&beside.stderr));
    tree.write("go", "");
    let first = first.wait_with_output().expect("it was started");
    assert!(first.status.success(), "{}", text(&first.stderr));
    let result = |page: &str| fs::read_to_string(tree.at(&format!("target/realo/measured/{page}/slow"))).ok();
    assert_eq!(
        [result("one"), result("two")].map(Option::unwrap),
        ["done\n", "other\n"]
    );
    assert!(tree.measure(&["one"]).status.success(), "nobody measures it any more");
}

#[test]
fn a_step_ends_with_the_call_that_started_it() {
    for signal in ["INT", "TERM", "KILL"] {
        let tree = Tree::new(&format!("measure-killed-{signal}"), &[("one", WAITS.into())]);
        tree.commit();
        let args = ["measure", "--out", "pages", "one"];
        let mut call = tree.command(&args, &tree.0).spawn().expect("it can be started");
        let step = tree.step();
        assert!(is_alive(step));
        kill(call.id(), signal);
        assert!(!call.wait().expect("it was started").success());
        until("the step ends", || !is_alive(step));
        // What it left is not taken for a result, and the page is free.
        tree.write("go", "");
        let again = tree.measure(&["one"]);
        let said = text(&again.stderr);
        assert!(again.status.success() && said.contains("1 of 1"), "{said}");
    }
}

#[test]
fn a_damaged_result_and_a_changed_one_say_what_to_do() {
    let step = "[[steps]]\nname = 'a'\nprogram = 'realo'\nargs = ['-c', 'cat figures', '--json']\n";
    let tree = Tree::new("measure-damaged", &[("one", format!("{step}{TABLE}"))]);
    tree.commit();
    tree.write("figures", "{ \"x\": ");
    let said = tree.refused(&["one"]);
    assert!(said.contains(".steps/a.stdout") && said.contains("--fresh"), "{said}");
    tree.write("figures", "{ \"x\": 7 }");
    let said = tree.refused(&["one"]);
    assert!(
        said.contains("--fresh"),
        "nothing that is known to be read changed: {said}"
    );
    let page = || fs::read_to_string(tree.at("pages/one.md")).expect("a page");
    assert!(tree.measure(&["one", "--fresh"]).status.success());
    assert!(page().contains("| l | 7 |"), "{}", page());
    tree.write("target/realo/measured/one/.steps/a.stdout", "{ \"x\": 9 }");
    let output = tree.measure(&["one"]);
    let said = text(&output.stderr);
    assert!(
        output.status.success() && said.contains("changed this result"),
        "{said}"
    );
    assert!(page().contains("| l | 7 |"), "{}", page());
}

#[test]
fn pages_are_listed_without_git_and_programs_of_another_tree_are_named() {
    let tree = Tree::new("measure-list", &[("one", WAITS.into())]);
    let mut list = tree.command(&["measure", "--list"], &tree.at(PAGES));
    let output = list.env("PATH", "/nowhere").output().expect("it can be started");
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert_eq!(text(&output.stdout), "one            scores  T\n");
    let other = Tree::new("measure-list-other", &[("one", WAITS.into())]);
    other.commit();
    let output = tree.command(&["measure", "one"], &other.0).output();
    let output = output.expect("it can be started");
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for part in [&other.0, &tree.0] {
        assert!(said.contains(&*part.to_string_lossy()), "{part:?} is not in {said}");
    }
}

#[test]
fn a_bench_that_runs_graphs_looks_for_the_program_before_it_makes_a_log() {
    let tree = Tree::new("measure-bench", &[]);
    fs::remove_file(tree.at("bin/realo")).expect("it was there");
    for bench in ["framework", "memory", "faults", "view", "report"] {
        let mut command = tree.command(&["bench", bench], &tree.0);
        let output = command.output().expect("it can be started");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains("expected the program `realo` beside this one"), "{said}");
    }
    assert!(!tree.at("target").exists(), "nothing was made");
}

/// A tree whose `realo` writes a file where results go, or fails where a file `fail` is.
fn tree_of_paper(name: &str) -> Tree {
    let tree = Tree::new(name, &[("one", WAITS.into())]);
    for source in [
        "Cargo.lock",
        "Cargo.toml",
        "schemas/a",
        "operators/a",
        "nodes/a",
        "python/a",
    ] {
        tree.write(source, "a");
    }
    let script = "#!/bin/sh\ntest -e fail && { echo no space >&2; exit 1; }\n\
                  while test $# -gt 0; do test \"$1\" = --out && mkdir -p \"$2\" && echo {} > \"$2/result.json\"; shift; done\n";
    tree.write("bin/realo", script);
    tree.commit_files(&["."]);
    tree
}

#[test]
fn the_paper_s_runs_are_shared_out_resumed_and_merged() {
    let tree = tree_of_paper("measure-paper");
    let paper = |args: &[&str]| {
        let args = [&["paper", "--seconds", "1", "--jobs", "1"], args].concat();
        let output = tree.command(&args, &tree.0).output().expect("it can be started");
        (output.status.code(), text(&output.stderr))
    };
    // The last shard has no bench.
    let shard = ["--scenes", "2", "--shard", "55/55", "--out", "shard"];
    tree.write("fail", "");
    let (code, said) = paper(&shard);
    assert_eq!(code, Some(1), "{said}");
    for part in [
        "2 runs in shard 55/55, 0 done already, 2 to run",
        "no space",
        "runs what is missing",
    ] {
        assert!(said.contains(part), "{part} is not in {said}");
    }
    fs::remove_file(tree.at("fail")).expect("it is there");
    let (code, said) = paper(&shard);
    assert!(
        code == Some(0) && said.contains("108 runs of 110 are not here yet"),
        "{said}"
    );
    assert!(
        tree.at("shard/runs/i2i/online/no_fusion/901/run/result.json").exists(),
        "{said}"
    );
    let (_, said) = paper(&shard);
    assert!(said.contains("2 done already, 0 to run"), "{said}");
    let (code, said) = paper(&["--scenes", "2", "--merge", "shard", "--out", "all"]);
    assert!(code == Some(3) && said.contains("shard: 2 of 110 runs taken"), "{said}");
    let (code, said) = paper(&["--scenes", "3", "--merge", "shard", "--out", "other"]);
    assert!(
        code == Some(1) && said.contains("another plan") && said.contains("--scenes"),
        "{said}"
    );
    let (code, said) = paper(&["--scenes", "2", "--cell", "v2v/online/attfuze"]);
    assert!(
        code == Some(2) && said.contains("expected one of v2xvit, attfuse"),
        "{said}"
    );
    // A refused merge leaves nothing.
    assert!(!tree.at("other").exists(), "{said}");
    // A change of what results depend on makes them anew.
    tree.write("operators/a", "b");
    let (code, said) = paper(&[&shard[..], &["--allow-dirty"]].concat());
    assert!(
        code == Some(0) && said.contains("run again, because something has changed"),
        "{said}"
    );
}

/// Calls `paper` in a tree.
fn paper(tree: &Tree, args: &[&str]) -> (Option<i32>, String) {
    let args = [&["paper", "--seconds", "1", "--jobs", "1"], args].concat();
    let output = tree.command(&args, &tree.0).output().expect("it can be started");
    (output.status.code(), text(&output.stderr))
}

#[test]
fn a_cell_of_the_paper_is_made_alone_and_nothing_that_is_there_is_lost() {
    let tree = tree_of_paper("measure-cell");
    let cell = ["--cell", "v2v/offline/late_fusion"];
    let of = |scenes: &'static str| [&["--scenes", scenes, "--out", "out"], &cell[..]].concat();
    let (code, said) = paper(&tree, &of("2"));
    assert_eq!(code, Some(3), "{said}");
    for part in [
        "2 runs of 110 to make, 0 of them made before",
        "108 runs of 110 are not here yet",
        "without --cell makes them",
    ] {
        assert!(said.contains(part), "{part} is not in {said}");
    }
    let runs = || {
        let mut all: Vec<PathBuf> = below(&tree.at("out/runs"), "done.json");
        all.sort();
        all
    };
    let made = runs();
    assert_eq!(made.len(), 2, "{made:?}");
    // Another plan is refused before anything is touched.
    let (code, said) = paper(&tree, &of("3"));
    assert!(code == Some(1) && said.contains("another plan"), "{said}");
    assert_eq!(runs(), made);
    // What fails leaves what was there.
    tree.write("fail", "");
    let before = fs::read_to_string(&made[0]).expect("a record");
    let (code, said) = paper(&tree, &of("2"));
    assert!(code == Some(1) && said.contains("2 of them made before"), "{said}");
    assert_eq!(fs::read_to_string(&made[0]).expect("it is there still"), before);
    assert!(tree.at("out/runs/v2v/offline/late_fusion/900/run/result.json").exists());
    fs::remove_file(tree.at("fail")).expect("it is there");
    // Another cell leaves this one, and this one made again takes the place of what was there.
    let (code, said) = paper(
        &tree,
        &["--scenes", "2", "--out", "out", "--cell", "v2v/offline/no_fusion"],
    );
    assert!(code == Some(3) && said.contains("106 runs of 110"), "{said}");
    tree.write("out/runs/v2v/offline/late_fusion/900/old", "");
    let (code, said) = paper(&tree, &of("2"));
    assert!(code == Some(3) && runs().len() == 4, "{said}");
    assert!(!tree.at("out/runs/v2v/offline/late_fusion/900/old").exists());
    assert!(!tree.at("out/anew").exists());
    let (code, said) = paper(&tree, &[&of("2")[..], &["--shard", "1/2"]].concat());
    assert!(code == Some(1) && said.contains("drop --shard"), "{said}");
}

/// All files of one name below a folder.
fn below(folder: &Path, name: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let of = |entry: fs::DirEntry| match entry.path() {
        path if path.is_dir() => below(&path, name),
        path if path.ends_with(name) => vec![path],
        _ => Vec::new(),
    };
    entries.flat_map(of).collect()
}

#[test]
fn a_signal_ends_the_paper_s_run_that_is_under_way() {
    let tree = tree_of_paper("measure-signal");
    tree.write("bin/realo", "#!/bin/sh\necho $$ > pid; sleep 3000\n");
    tree.commit_files(&["."]);
    let args = [
        "paper",
        "--seconds",
        "1",
        "--jobs",
        "1",
        "--scenes",
        "2",
        "--out",
        "out",
    ];
    let args = [&args[..], &["--cell", "i2i/offline/no_fusion"]].concat();
    let mut paper = tree.command(&args, &tree.0).spawn().expect("it can be started");
    let run = tree.step();
    kill(paper.id(), "TERM");
    until("the command ends", || paper.try_wait().expect("a child").is_some());
    let output = paper.wait_with_output().expect("it ended");
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(143), "{said}");
    assert!(said.contains("ended by SIGTERM; left: 2 runs"), "{said}");
    until("the run is gone", || !is_alive(run));
}

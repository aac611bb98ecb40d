use super::*;
use crate::measure::page::Page;

const PAGE: &str = "title = 'T'\nkind = 'scores'\nabout = 'A'\nparameters = { seeds = 2, seconds = 3 }\n";
const STEPS: &str = r#"
[[steps]]
name = "logs"
program = "realo-lab"
args = ["-c", "test ! -e broken && echo log {seed} {seconds} > {out}.log && echo {seed} >> count"]
output = "{out}.log"
each = { variable = "seed", from = 900, count = "seeds" }

[[steps]]
name = "run"
program = "realo"
args = ["-c", "mkdir -p {out} && cat $0 $1 > {out}/all && echo run >> count", "{logs}"]
"#;

/// A page whose programs are shells, in a tree of its own.
struct Tried {
    folder: tempfile::TempDir,
    programs: Programs,
}

impl Tried {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for name in READ {
            fs::create_dir_all(folder.path().join(name)).unwrap();
            fs::write(folder.path().join(name).join("file"), name).unwrap();
        }
        let programs = Programs::alone(Path::new("/bin/sh"));
        Tried { folder, programs }
    }

    /// Runs the steps, and says which commands ran.
    fn run(&self, steps: &str, fresh: bool) -> Result<Vec<String>> {
        let count = self.folder.path().join("count");
        let _ = fs::remove_file(&count);
        let page: Page = toml::from_str(&format!("{PAGE}{steps}"))?;
        page.check(&BTreeMap::new())?;
        let runner = Runner {
            plan: &Plan::new("p", &page)?,
            programs: &self.programs,
            root: self.folder.path(),
        };
        runner.run(Kind::Scores, fresh)?;
        let ran = fs::read_to_string(count).unwrap_or_default();
        Ok(ran.lines().map(str::to_string).collect())
    }
}

#[test]
fn a_step_runs_for_each_value_and_the_next_reads_all_files() {
    let tried = Tried::new();
    assert_eq!(tried.run(STEPS, false).unwrap(), ["900", "901", "run"]);
    let all = tried.folder.path().join("target/realo/measured/p/run/all");
    assert_eq!(fs::read_to_string(all).unwrap(), "log 900 3\nlog 901 3\n");
}

#[test]
fn nothing_outside_the_folder_of_the_page_is_an_output() {
    let tried = Tried::new();
    let victim = tried.folder.path().join("mine");
    fs::write(&victim, "mine").unwrap();
    let absolute = victim.display().to_string();
    for output in [absolute.as_str(), "mine", "{out}/../../../../../mine"] {
        let steps = STEPS.replace("output = \"{out}.log\"", &format!("output = \"{output}\""));
        let error = tried.run(&steps, true).unwrap_err().to_string();
        assert!(
            error.contains("step `logs`: `output`") && error.contains(output),
            "{error}"
        );
    }
    assert_eq!(fs::read_to_string(&victim).unwrap(), "mine");
}

#[test]
fn steps_are_reused_until_something_that_they_read_changes() {
    let tried = Tried::new();
    let root = tried.folder.path();
    tried.run(STEPS, false).unwrap();
    assert!(tried.run(STEPS, false).unwrap().is_empty());
    // The logs come out the same, so the run that reads them need not run again.
    let other = STEPS.replace("test ! -e broken", "true");
    assert_eq!(tried.run(&other, false).unwrap(), ["900", "901"]);
    let other = other.replace("echo log", "echo other");
    assert_eq!(tried.run(&other, false).unwrap(), ["900", "901", "run"]);
    fs::write(root.join("models/page.md"), "for readers").unwrap();
    assert!(tried.run(&other, false).unwrap().is_empty());
    fs::write(root.join("models/file"), "other weights").unwrap();
    assert_eq!(tried.run(&other, false).unwrap().len(), 3);
    fs::remove_dir_all(root.join("target/realo/measured/p/run")).unwrap();
    assert_eq!(tried.run(&other, false).unwrap(), ["run"]);
    assert_eq!(tried.run(&other, true).unwrap().len(), 3);
}

#[test]
fn a_file_that_a_step_names_is_read() {
    let tried = Tried::new();
    let steps =
        "[[steps]]\nname = 'a'\nprogram = 'realo'\nargs = ['-c', 'cp $0 {out}; echo a >> count', 'graph.yml']\n";
    for (text, ran) in [("one", 1), ("one", 0), ("two", 1)] {
        fs::write(tried.folder.path().join("graph.yml"), text).unwrap();
        assert_eq!(tried.run(steps, false).unwrap().len(), ran, "{text}");
    }
}

#[test]
fn what_a_step_that_failed_left_is_not_reused() {
    let tried = Tried::new();
    tried.run(STEPS, false).unwrap();
    fs::write(tried.folder.path().join("broken"), "").unwrap();
    let error = tried.run(STEPS, true).unwrap_err().to_string();
    assert!(
        error.contains("echo log 900 3") && error.contains("exit status: 1"),
        "{error}"
    );
    fs::remove_file(tried.folder.path().join("broken")).unwrap();
    assert_eq!(tried.run(STEPS, false).unwrap(), ["900"]);
}

#[test]
fn a_step_that_writes_nothing_is_an_error() {
    let silent = "[[steps]]\nname = 'a'\nprogram = 'realo'\nargs = ['-c', 'true']\n";
    let error = Tried::new().run(silent, false).unwrap_err().to_string();
    assert!(
        error.contains("step `a` did not write target/realo/measured/p/a"),
        "{error}"
    );
}

#[test]
fn a_result_that_somebody_changed_is_measured_anew() {
    let tried = Tried::new();
    tried.run(STEPS, false).unwrap();
    let at = |name: &str| tried.folder.path().join("target/realo/measured/p").join(name);
    fs::write(at("run/all"), "better figures").unwrap();
    assert_eq!(tried.run(STEPS, false).unwrap(), ["run"]);
    assert_eq!(fs::read_to_string(at("run/all")).unwrap(), "log 900 3\nlog 901 3\n");
    fs::write(at("run/more"), "").unwrap();
    assert_eq!(tried.run(STEPS, false).unwrap(), ["run"]);
    fs::write(at("logs/901.log"), "another log").unwrap();
    assert_eq!(tried.run(STEPS, false).unwrap(), ["901"], "and it came out the same");
    assert!(tried.run(STEPS, false).unwrap().is_empty());
    let printing = "[[steps]]\nname = 'a'\nprogram = 'realo'\nargs = ['-c', 'echo 1; echo a >> count', '--json']\n";
    for (changes, ran) in [(false, 1), (false, 0), (true, 1), (false, 0)] {
        if changes {
            fs::write(at(".steps/a.stdout"), "2").unwrap();
        }
        assert_eq!(tried.run(printing, false).unwrap().len(), ran);
    }
}

//! For tests that cannot run everywhere. A test that is left out says so at once, past the capture of test output, and
//! once more at the end of `cargo test`, where the last test target lists them all.
//!
//! ```ignore
//! let Some(folder) = skipped::shared("conformance") else { return };
//! ```

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// The folder of shared test data that `REALO_SHARED` names, or one below it; without it the running test is left out.
pub fn shared(below: &str) -> Option<PathBuf> {
    match std::env::var_os("REALO_SHARED") {
        Some(folder) => Some(PathBuf::from(folder).join(below)),
        None => {
            skip(&format!("set REALO_SHARED to the folder that holds `{below}`"));
            None
        }
    }
}

/// Says that the running test is left out, and what it needs.
pub fn skip(needs: &str) {
    say(needs);
}

/// Says that the running test could not be decided on this machine, and why.
pub fn undecided(why: &str) {
    say(&format!("not decided here: {why}"));
}

fn say(words: &str) {
    let program = program();
    let thread = std::thread::current();
    let test = thread.name().filter(|name| *name != "main").unwrap_or("a test");
    let line = format!("{program}: {test}: {words}");
    // `eprintln!` would be captured.
    let _ = writeln!(io::stderr(), "SKIPPED {line}");
    if let Err(error) = record(&list(), &line) {
        let _ = writeln!(
            io::stderr(),
            "SKIPPED tests cannot be listed: {}: {error}",
            list().display()
        );
    }
}

/// The name of the test program without the hash that cargo adds.
fn program() -> String {
    let path = std::env::current_exe().unwrap_or_default();
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    match name.rsplit_once('-') {
        Some((name, hash)) if hash.len() == 16 => name.into(),
        _ => name,
    }
}

/// Where the tests that one `cargo test` has left out are listed.
pub fn list() -> PathBuf {
    let program = std::env::current_exe().unwrap_or_default();
    let build = program
        .ancestors()
        .find(|folder| folder.file_name().is_some_and(|name| name == "deps"));
    let folder = build
        .and_then(Path::parent)
        .map_or_else(std::env::temp_dir, Path::to_path_buf);
    folder.join("skipped-tests").join(format!("{}.txt", run()))
}

/// All test programs of one `cargo test` have the same parent.
#[cfg(unix)]
fn run() -> u32 {
    std::os::unix::process::parent_id()
}

#[cfg(not(unix))]
fn run() -> u32 {
    0
}

fn record(list: &Path, line: &str) -> io::Result<()> {
    if let Some(folder) = list.parent() {
        fs::create_dir_all(folder)?;
    }
    let mut file = OpenOptions::new().create(true).append(true).open(list)?;
    file.write_all(format!("{line}\n").as_bytes())
}

/// Takes the lines of a list, which is gone then, and drops lists that nobody took for a day.
pub fn take(list: &Path) -> Vec<String> {
    let mut lines: Vec<String> = fs::read_to_string(list)
        .unwrap_or_default()
        .lines()
        .map(str::to_string)
        .collect();
    lines.sort();
    lines.dedup();
    let _ = fs::remove_file(list);
    let others = list.parent().and_then(|folder| fs::read_dir(folder).ok());
    for other in others.into_iter().flatten().flatten() {
        let age = File::open(other.path())
            .and_then(|file| file.metadata()?.modified())
            .map(|time| time.elapsed());
        if matches!(age, Ok(Ok(age)) if age.as_secs() > 24 * 3600) {
            let _ = fs::remove_file(other.path());
        }
    }
    lines
}

/// What is printed at the end.
pub fn summary(lines: &[String]) -> String {
    if lines.is_empty() {
        return "no test was skipped\n".into();
    }
    let plural = if lines.len() == 1 { "TEST WAS" } else { "TESTS WERE" };
    let head = format!("######## {} {plural} SKIPPED ########", lines.len());
    let mut text = format!("\n{head}\n");
    lines.iter().for_each(|line| text.push_str(&format!("  {line}\n")));
    text.push_str(&format!("{head}\n"));
    text
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    #[test]
    fn lines_of_a_list_are_taken_once_each() {
        let list = std::env::temp_dir()
            .join(format!("skipped-{}", std::process::id()))
            .join("7.txt");
        record(&list, "b: second").unwrap();
        record(&list, "a: first").unwrap();
        record(&list, "b: second").unwrap();
        assert_eq!(take(&list), ["a: first", "b: second"]);
        assert!(take(&list).is_empty());
        fs::remove_dir_all(list.parent().unwrap()).unwrap();
    }

    #[test]
    fn the_summary_counts_and_names() {
        assert_eq!(summary(&[]), "no test was skipped\n");
        let text = summary(&["a: b: set C".into(), "d: e: set F".into()]);
        assert!(
            text.contains("2 TESTS WERE SKIPPED") && text.contains("\n  a: b: set C\n"),
            "{text}"
        );
        assert!(summary(&["a".into()]).contains("1 TEST WAS SKIPPED"));
    }

    #[test]
    fn a_test_that_is_left_out_says_so_past_the_capture_and_in_the_list() {
        let (name, inner) = (
            "tests::a_test_that_is_left_out_says_so_past_the_capture_and_in_the_list",
            "SKIPPED_INNER",
        );
        // Run by itself as a program of its own, it is the test that is left out.
        if std::env::var_os(inner).is_some() {
            assert!(shared("nowhere").is_none());
            return;
        }
        let mut command = Command::new(std::env::current_exe().unwrap());
        let command = command
            .args(["--exact", name])
            .env_remove("REALO_SHARED")
            .env(inner, "1");
        let output = command.output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}");
        let line = format!("skipped: {name}: set REALO_SHARED to the folder that holds `nowhere`");
        assert!(said.contains(&format!("SKIPPED {line}")), "{said}");
        // Its parent is this program.
        let list = list().with_file_name(format!("{}.txt", std::process::id()));
        assert_eq!(take(&list), [line]);
    }
}

//! Files and folders that a command is writing: a signal that ends the command takes away what there is of them.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, Once, PoisonError};

use crate::program;
use crate::signals::{self, Ending};

/// How names of unfinished files end: of a log, and of packets on their way to one.
const UNFINISHED: [&str; 2] = [".partial", ".packets"];
/// What the files are to become.
static TARGETS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// From now on what [`realo_logs`] writes for this target is known as unfinished. What processes that were killed left of it
/// is taken away.
pub fn note(target: &Path) {
    remove_where(target, is_left);
    let mut targets = TARGETS.lock().unwrap_or_else(PoisonError::into_inner);
    if !targets.iter().any(|known| known == target) {
        targets.push(target.into());
    }
}

/// What was written for this target is complete.
pub fn done(target: &Path) {
    let mut targets = TARGETS.lock().unwrap_or_else(PoisonError::into_inner);
    targets.retain(|known| known != target);
}

/// As [`note`]; SIGINT, SIGTERM and SIGHUP end this process with an exit code of their own, and without such files.
///
/// Where signals cannot be caught, they end the process as they always do.
pub fn end_with_signals(target: &Path) {
    static CAUGHT: Once = Once::new();
    note(target);
    CAUGHT.call_once(|| {
        let Ok(mut signals) = signals::wanted() else { return };
        let wait = move || {
            let Some(signal) = signals.forever().next() else {
                return;
            };
            eprintln!(
                "{}: ended by {}{}",
                program::name(),
                Ending::of(signal),
                left_of(&remove())
            );
            std::process::exit(128 + signal);
        };
        let _ = std::thread::Builder::new().spawn(wait);
    });
}

/// What becomes of unfinished files, as the end of a sentence; empty without any.
fn left_of(targets: &[PathBuf]) -> String {
    let named: Vec<String> = targets.iter().map(|target| target.display().to_string()).collect();
    let named = named.join(", ");
    match targets.len() {
        0 => String::new(),
        1 => format!(" before {named} was complete; nothing of it was left"),
        _ => format!(" before {named} were complete; nothing of them was left"),
    }
}

/// Takes the unfinished files of this process away; gives what they were to become.
pub fn remove() -> Vec<PathBuf> {
    let targets = TARGETS.lock().unwrap_or_else(PoisonError::into_inner).clone();
    targets.iter().for_each(|target| remove_of(target));
    targets
}

fn remove_of(target: &Path) {
    remove_where(target, |process, _| process == std::process::id());
}

/// Whether a process that has ended left an unfinished file.
fn is_left(process: u32, file: &Path) -> bool {
    let has_ended = Path::new("/proc/self").exists() && !Path::new(&format!("/proc/{process}")).exists();
    // Processes of another machine or container may write there too.
    has_ended && File::open(file).is_ok_and(|file| file.try_lock().is_ok())
}

/// Takes the unfinished files of a target away that some processes wrote.
fn remove_where(target: &Path, is_wanted: impl Fn(u32, &Path) -> bool) {
    let Some(name) = target.file_name() else { return };
    let begin = format!("{}.", name.to_string_lossy());
    let folder = match target.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let rest = name.strip_prefix(&begin);
        let process = rest.and_then(|rest| UNFINISHED.iter().find_map(|kind| rest.strip_suffix(kind)));
        let process = process.and_then(|process| process.parse().ok());
        if process.is_some_and(|process| is_wanted(process, &entry.path())) {
            // Whoever cannot remove it could not have written it.
            let path = entry.path();
            let _ = match path.is_dir() {
                true => fs::remove_dir_all(path),
                false => fs::remove_file(path),
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_are_complete_are_not_said_to_be_lost() {
        assert_eq!(left_of(&[]), "");
        assert_eq!(
            left_of(&["a.mcap".into()]),
            " before a.mcap was complete; nothing of it was left"
        );
        assert_eq!(
            left_of(&["a.mcap".into(), "b.mcap".into()]),
            " before a.mcap, b.mcap were complete; nothing of them was left"
        );
        let [known, other] = ["known.mcap", "other.mcap"].map(Path::new);
        note(known);
        note(other);
        done(known);
        let targets = TARGETS.lock().unwrap();
        assert!(!targets.iter().any(|target| target == known) && targets.iter().any(|target| target == other));
    }

    #[test]
    fn what_a_killed_process_left_is_taken_away_when_the_file_is_written_again() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let (dead, living) = (u32::MAX, std::process::id());
        let files = [dead, living].map(|process| at(&format!("log.mcap.{process}.partial")));
        let other = at(&format!("other.mcap.{dead}.partial"));
        fs::create_dir_all(at(&format!("log.mcap.{}.partial/in", dead - 1))).unwrap();
        for file in files.iter().chain([&other]) {
            fs::write(file, "").unwrap();
        }
        let written = File::open(&files[0]).unwrap();
        written.lock().unwrap();
        remove_where(&at("log.mcap"), is_left);
        assert!(files[0].exists(), "somebody writes there");
        assert!(
            !at(&format!("log.mcap.{}.partial", dead - 1)).exists(),
            "nobody writes there"
        );
        drop(written);
        remove_where(&at("log.mcap"), is_left);
        assert!(!files[0].exists() && files[1].exists() && other.exists());
    }

    #[test]
    fn only_the_unfinished_files_of_this_process_are_taken_away() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let own = format!("log.mcap.{}.partial", std::process::id());
        let others = ["log.mcap", "log.mcap.1.partial", "more.mcap.1.partial"];
        for name in others.iter().chain([&own.as_str()]) {
            fs::write(at(name), "").unwrap();
        }
        remove_of(&at("log.mcap"));
        assert!(!at(&own).exists());
        assert!(others.iter().all(|name| at(name).exists()));
    }
}

//! Files that a command is writing: a signal that ends the command takes away what there is of them.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, Once, PoisonError};

use crate::run::{Ending, wanted_signals};

/// How names of unfinished files end: of a log, and of packets on their way to one.
const UNFINISHED: [&str; 2] = [".partial", ".packets"];
/// What the files are to become.
static TARGETS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// From now on what [`realo_logs`] writes for this target is known as unfinished.
pub fn note(target: &Path) {
    let mut targets = TARGETS.lock().unwrap_or_else(PoisonError::into_inner);
    if !targets.iter().any(|known| known == target) {
        targets.push(target.into());
    }
}

/// As [`note`]; SIGINT, SIGTERM and SIGHUP end this process with an exit code of their own, and without such files.
///
/// Where signals cannot be caught, they end the process as they always do.
pub fn end_with_signals(target: &Path) {
    static CAUGHT: Once = Once::new();
    note(target);
    CAUGHT.call_once(|| {
        let Ok(mut signals) = wanted_signals() else { return };
        let wait = move || {
            let Some(signal) = signals.forever().next() else {
                return;
            };
            let targets = remove();
            let named: Vec<String> = targets.iter().map(|target| target.display().to_string()).collect();
            let ending = Ending::of(signal);
            eprintln!(
                "realo: ended by {ending} before {} was complete; nothing of it was left",
                named.join(", ")
            );
            std::process::exit(128 + signal);
        };
        let _ = std::thread::Builder::new().spawn(wait);
    });
}

/// Takes the unfinished files of this process away; gives what they were to become.
pub fn remove() -> Vec<PathBuf> {
    let targets = TARGETS.lock().unwrap_or_else(PoisonError::into_inner).clone();
    targets.iter().for_each(|target| remove_of(target));
    targets
}

fn remove_of(target: &Path) {
    let Some(name) = target.file_name() else { return };
    let begin = format!("{}.{}.", name.to_string_lossy(), std::process::id());
    let folder = match target.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with(&begin) && UNFINISHED.iter().any(|kind| name.ends_with(kind)) {
            // Whoever cannot remove it could not have written it.
            let _ = fs::remove_file(entry.path());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

//! The folders of runs.

use std::collections::BTreeSet;
use std::fs::{self, File, Metadata, TryLockError};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use eyre::{Report, Result, WrapErr, bail, eyre};
use realo_logs::Owner;
use realo_results::RESULT_FILE;
use rustix::fs::OFlags;
use rustix::io::{FdFlags, fcntl_setfd};

use super::compute;
use super::prepare::SETTINGS_FILE;

/// What a run records, in its folder.
const RECORDING: &str = "recording.mcap";
/// What recordings end in.
const RECORDED: &str = "mcap";
/// What the recordings of a run that failed end in, where those of an earlier one stand.
const FAILED: &str = "failed.mcap";
/// Where an earlier run's files lie while another one runs.
const ASIDE: &str = ".earlier";
/// Marks [`ASIDE`] as made by a run.
const OWNED: &str = ".of-a-run";
/// Where an earlier run's files stay if it came to its end and the one after it did not.
const COMPLETE: &str = "complete-run-before";
/// Key that every `run.json` of a run has.
const FINGERPRINT: &str = "\"fingerprint\"";
/// Is locked while a run writes to the folder.
const LOCK: &str = ".running";
/// Processes of a run that was killed may still end, and hold its lock so long.
const ENDING: Duration = Duration::from_secs(3);

/// The folders of some runs. An earlier run's files are put aside, so that no result stands there which is not of these
/// runs; unless [`Folders::keep_new`] is said, they are put back, and folders that hold nothing are taken away again: a run
/// that fails leaves what was there before.
#[derive(Default)]
pub(super) struct Folders {
    /// Outer ones before those in them.
    made: Vec<PathBuf>,
    claimed: Vec<PathBuf>,
    locks: Vec<(PathBuf, File)>,
}

/// Takes a lock, or reports that somebody has it and keeps it.
fn is_held(file: &File) -> bool {
    let begun = Instant::now();
    // A file system without locks keeps nobody away.
    while let Err(TryLockError::WouldBlock) = file.try_lock() {
        if begun.elapsed() > ENDING {
            return true;
        }
        sleep(Duration::from_millis(20));
    }
    false
}

impl Folders {
    /// Claims the folder of a graph, in which those of its runs lie; nobody else can until this is dropped.
    ///
    /// # Errors
    /// A run that writes there already; as [`Folders::claim`].
    pub fn lock(&mut self, folder: &Path) -> Result<()> {
        self.make(folder)?;
        let path = folder.join(LOCK);
        let file = loop {
            let file = open_lock(&path)?;
            if is_held(&file) {
                return Err(is_written(folder));
            }
            // Whoever had it before may have removed it meanwhile.
            if fs::metadata(&path).is_ok_and(|there| file.metadata().is_ok_and(|own| own.ino() == there.ino())) {
                break file;
            }
        };
        // Processes that write there hold the lock as well, for as long as they live.
        fcntl_setfd(&file, FdFlags::empty())?;
        self.locks.push((path, file));
        self.claim(folder, &[])
    }

    /// Refuses a folder in which, or around which, another run writes.
    fn refuse_running(&self, folder: &Path) -> Result<()> {
        let is_own = |found: &Metadata| {
            let mut own = self.locks.iter().filter_map(|(_, file)| file.metadata().ok());
            own.any(|own| (own.dev(), own.ino()) == (found.dev(), found.ino()))
        };
        for around in folder.canonicalize()?.ancestors() {
            let Ok(file) = File::open(around.join(LOCK)) else {
                continue;
            };
            if !file.metadata().is_ok_and(|found| is_own(&found)) && is_held(&file) {
                return Err(is_written(around));
            }
        }
        Ok(())
    }

    /// Claims the compute profile that a run in realtime leaves in the folder of its graph.
    ///
    /// # Errors
    /// A file of that name that no run of realo wrote.
    pub fn claim_profile(&mut self, folder: &Path) -> Result<()> {
        let file = folder.join(compute::FILE);
        match fs::read(&file) {
            Ok(text) if compute::is_of_run(&text) => put_aside(folder, [file]),
            Ok(text) if !text.is_empty() => Err(not_of_a_run(&file)),
            _ => Ok(()),
        }
    }

    /// Makes a run's folder and puts an earlier run's files aside; `recordings` are the files in it that the run records into.
    ///
    /// # Errors
    /// Files of those names that no run of realo wrote; a folder that cannot be written to.
    pub fn claim(&mut self, folder: &Path, recordings: &[PathBuf]) -> Result<()> {
        // What is put aside goes when the run succeeds.
        recordings
            .iter()
            .try_for_each(|file| realo_logs::refuse_foreign(file))?;
        let mut files: BTreeSet<PathBuf> = recordings.iter().cloned().collect();
        if !self.claimed.iter().any(|claimed| claimed == folder) {
            self.make(folder)?;
            self.refuse_running(folder)?;
            refuse_foreign_files(folder)?;
            // Of a run that was killed.
            put_back(folder);
            files.extend([RECORDING, SETTINGS_FILE].map(|name| folder.join(name)));
            files.extend(realo_results::earlier(folder)?);
            self.claimed.push(folder.into());
        }
        files.retain(|file| file.is_file());
        put_aside(folder, files)
    }

    /// The runs have ended: what those that succeeded wrote stays. What was there before goes, unless it is of a run that came to
    /// its end and a signal ended the one after it: that is kept in a folder of its own.
    pub fn keep_new(&mut self) {
        let succeeded = |folder: &mut PathBuf| folder.join(RESULT_FILE).exists();
        let new: Vec<PathBuf> = self.claimed.extract_if(.., succeeded).collect();
        settle(&new);
    }

    fn make(&mut self, folder: &Path) -> Result<()> {
        let there = folder.ancestors().find(|above| above.exists());
        if let Some(file) = there.filter(|there| !there.is_dir()) {
            bail!(
                "{}: results need a folder there, and it is a file; choose another folder (--out)",
                file.display()
            );
        }
        let missing = folder
            .ancestors()
            .take_while(|folder| !folder.as_os_str().is_empty() && !folder.exists());
        let missing: Vec<PathBuf> = missing.map(Path::to_path_buf).collect();
        self.made.extend(missing.into_iter().rev());
        fs::create_dir_all(folder).wrap_err_with(|| not_writable(folder))
    }
}

/// Opens the file that is locked, of which nothing else is used; what somebody else has there stays as it is.
fn open_lock(path: &Path) -> Result<File> {
    let mut options = File::options();
    options.read(true).write(true).create(true).truncate(false);
    // Neither to where a link leads, nor waiting for a pipe.
    options.custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32);
    let is_link = fs::symlink_metadata(path).is_ok_and(|found| found.is_symlink());
    if is_link {
        return Err(not_of_a_run(path));
    }
    let file = options.open(path).wrap_err_with(|| not_writable(path))?;
    let is_ours = file.metadata().is_ok_and(|found| found.is_file() && found.len() == 0);
    if is_ours { Ok(file) } else { Err(not_of_a_run(path)) }
}

/// Refuses a folder that has something of somebody else where a run puts its own.
fn refuse_foreign_files(folder: &Path) -> Result<()> {
    let [aside, reported, recording] = [ASIDE, SETTINGS_FILE, RECORDING].map(|name| folder.join(name));
    if fs::symlink_metadata(&aside).is_ok() && !is_of_a_run(&aside) {
        return Err(not_of_a_run(&aside));
    }
    // A link to nowhere is none of a run either.
    if fs::symlink_metadata(&reported).is_ok() && !is_reported_of_run(&reported) {
        return Err(not_of_a_run(&reported));
    }
    // Sensors cannot be played again for what they gave.
    match Owner::of(&recording) {
        Ok(Owner::Log | Owner::OtherLog) => Err(not_of_a_run(&recording)),
        _ => Ok(()),
    }
}

/// Whether a run wrote a `run.json`; one that could not write it leaves it empty.
fn is_reported_of_run(path: &Path) -> bool {
    let is_reported = |text: String| text.is_empty() || text.contains(FINGERPRINT);
    path.is_file() && fs::read_to_string(path).is_ok_and(is_reported)
}

/// Whether a run put aside what lies there; a run that was killed may have come no further than to make the folder.
fn is_of_a_run(aside: &Path) -> bool {
    let is_empty = || fs::read_dir(aside).is_ok_and(|mut entries| entries.next().is_none());
    fs::symlink_metadata(aside).is_ok_and(|found| found.is_dir())
        && (aside.join(OWNED).is_file() || is_reported_of_run(&aside.join(SETTINGS_FILE)) || is_empty())
}

fn not_of_a_run(path: &Path) -> Report {
    eyre!(
        "{} is not of a run of realo and is not overwritten; move it, or choose another folder (--out)",
        path.display()
    )
}

fn put_aside(folder: &Path, files: impl IntoIterator<Item = PathBuf>) -> Result<()> {
    let aside = folder.join(ASIDE);
    for file in files {
        let place = aside.join(file.strip_prefix(folder)?);
        let above = place.parent().unwrap_or(folder);
        fs::create_dir_all(&aside).wrap_err_with(|| not_writable(&aside))?;
        fs::write(aside.join(OWNED), "").wrap_err_with(|| not_writable(&aside))?;
        fs::create_dir_all(above).wrap_err_with(|| not_writable(above))?;
        fs::rename(&file, &place).wrap_err_with(|| format!("{}", file.display()))?;
    }
    Ok(())
}

fn is_written(folder: &Path) -> Report {
    eyre!(
        "{}: another run writes there now; wait for its end, or choose another folder (--out)",
        folder.display()
    )
}

fn not_writable(path: &Path) -> String {
    format!(
        "{}: results cannot be written there; choose another folder (--out)",
        path.display()
    )
}

/// Puts back what a run that was killed put aside in a folder.
pub(super) fn recover(folder: &Path) {
    put_back(folder);
}

/// Puts an earlier run's files back, unless a run has come to its end there since; whether it did.
fn put_back(folder: &Path) -> bool {
    let aside = folder.join(ASIDE);
    if !is_of_a_run(&aside) {
        return false;
    }
    if folder.join(RESULT_FILE).exists() {
        let _ = fs::remove_dir_all(&aside);
        return false;
    }
    let _ = fs::remove_file(aside.join(OWNED));
    restore(&aside, folder);
    true
}

/// Moves all that lies in a folder to another one, and takes the first away. What cannot be moved stays, for the next run to try.
fn restore(from: &Path, to: &Path) {
    for entry in fs::read_dir(from).into_iter().flatten().flatten() {
        let (path, place) = (entry.path(), to.join(entry.file_name()));
        if path.is_dir() {
            let _ = fs::create_dir_all(&place);
            restore(&path, &place);
            continue;
        }
        if place.extension().is_some_and(|kind| kind == RECORDED) && place.exists() {
            let _ = fs::rename(&place, place.with_extension(FAILED));
        }
        let _ = fs::rename(&path, &place);
    }
    let _ = fs::remove_dir(from);
}

/// Ends what was put aside in folders that have a new result, or are around one, and says where complete results are kept.
fn settle<P: AsRef<Path>>(folders: &[P]) {
    let kept: Vec<PathBuf> = folders.iter().filter_map(|folder| replace(folder.as_ref())).collect();
    folders.iter().for_each(|folder| remove_failed(folder.as_ref()));
    if let Some(first) = kept.first() {
        eprintln!(
            "realo: the results of the run before, which came to its end, are kept in {}",
            first.display()
        );
    }
}

/// What a failed run recorded goes with the next one that comes to its end.
fn remove_failed(folder: &Path) {
    if is_complete(folder) != Some(true) {
        return;
    }
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        let is_failed = entry.file_name().to_string_lossy().ends_with(&format!(".{FAILED}"));
        if is_failed && realo_logs::refuse_foreign(&path).is_ok() {
            let _ = fs::remove_file(path);
        }
    }
}

/// Ends what was put aside in a folder; gives where it is kept.
fn replace(folder: &Path) -> Option<PathBuf> {
    let (aside, kept) = (folder.join(ASIDE), folder.join(COMPLETE));
    if !is_of_a_run(&aside) {
        return None;
    }
    let (was, is) = (is_complete(&aside), is_complete(folder));
    // A complete run takes the place of all before it.
    let gone = match (was, is) {
        (Some(true), Some(false)) | (_, Some(true)) => kept.join(RESULT_FILE).exists().then_some(&kept),
        _ => None,
    };
    let _ = gone.map(fs::remove_dir_all);
    match (was, is) {
        (Some(true), Some(false)) if fs::rename(&aside, &kept).is_ok() => {
            let _ = fs::remove_file(kept.join(OWNED));
            Some(kept)
        }
        _ => {
            let _ = fs::remove_dir_all(aside);
            None
        }
    }
}

/// Whether the run whose result a folder has came to the end of its log; `None` without a result that can be read.
fn is_complete(folder: &Path) -> Option<bool> {
    let text = fs::read(folder.join(RESULT_FILE)).ok()?;
    let result: serde_json::Value = serde_json::from_slice(&text).ok()?;
    Some(result.get("ended_by").is_none())
}

impl Drop for Folders {
    fn drop(&mut self) {
        // Outer folders hold the sum of those in them, the old sum none of a new run.
        let has_new = |folder: &PathBuf| {
            let mut within = self.claimed.iter().filter(|other| other.starts_with(folder));
            within.any(|other| other.join(RESULT_FILE).exists())
        };
        let (new, old): (Vec<_>, Vec<_>) = self.claimed.iter().partition(|folder| has_new(folder));
        settle(&new);
        // Whoever failed again without an earlier run has nothing back.
        let had_one = |folder: &Path| folder.join(ASIDE).join(RESULT_FILE).exists();
        let put_back: Vec<_> = old
            .into_iter()
            .filter(|folder| {
                let had_one = had_one(folder);
                put_back(folder) && had_one
            })
            .collect();
        if let Some(folder) = put_back.first() {
            eprintln!("realo: {} has the files of the run before again", folder.display());
        }
        for (path, file) in self.locks.drain(..) {
            drop(file);
            // It stays where a process of the run is left.
            if File::open(&path).is_ok_and(|file| !is_held(&file)) {
                let _ = fs::remove_file(path);
            }
        }
        for folder in self.made.iter().rev() {
            let Ok(entries) = fs::read_dir(folder) else { continue };
            let names: Vec<_> = entries.flatten().map(|entry| entry.file_name()).collect();
            // What was to be reported of a run that reported nothing.
            if names.iter().all(|name| name == SETTINGS_FILE) {
                let _ = fs::remove_file(folder.join(SETTINGS_FILE));
                let _ = fs::remove_dir(folder);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::report::Phase;

    use super::*;

    #[test]
    fn what_was_made_and_holds_nothing_is_taken_away() {
        let root = tempfile::tempdir().unwrap();
        let at = |path: &str| root.path().join(path);
        fs::create_dir(at("there")).unwrap();
        {
            let mut folders = Folders::default();
            folders.lock(&at("there/out")).unwrap();
            for folder in ["there", "there/out/a", "there/out/b", "made/c/d", "made/e"] {
                folders.claim(&at(folder), &[]).unwrap();
            }
            fs::write(at("made/c/d").join(SETTINGS_FILE), "{}").unwrap();
            fs::write(at("there/out/b/dora.log"), "it failed").unwrap();
        }
        assert!(at("there/out/b/dora.log").exists());
        for gone in ["there/out/a", "there/out/.running", "made"] {
            assert!(!at(gone).exists(), "{gone}");
        }
        Folders::default().claim(&at("there"), &[]).unwrap();
        assert!(at("there").exists(), "it was there before");
    }

    fn write_earlier(folder: &Path) {
        let result = r#"{"schema": "realo/result", "version": 2}"#;
        let reported = format!("{{{FINGERPRINT}: 1}} earlier");
        for (name, text) in [("result.json", result), (SETTINGS_FILE, &reported)] {
            fs::write(folder.join(name), text).unwrap();
        }
        for name in [RECORDING, LOG] {
            fs::write(folder.join(name), recorded("earlier")).unwrap();
        }
        fs::create_dir_all(folder.join("channels")).unwrap();
        fs::write(folder.join(TRACE), trace("earlier")).unwrap();
    }

    /// What the sensors of an agent gave, which runs of its graph record.
    const LOG: &str = "cav1.mcap";
    const TRACE: &str = "channels/rsu1.csv";

    /// What begins as a recording does.
    fn recorded(text: &str) -> Vec<u8> {
        let name = realo_logs::RECORDING_RECORD.as_bytes();
        let mut bytes = b"\x89MCAP0\r\n\x0c".to_vec();
        bytes.extend((4 + name.len() as u64).to_le_bytes());
        bytes.extend((name.len() as u32).to_le_bytes());
        bytes.extend(name);
        bytes.extend(text.as_bytes());
        bytes
    }

    fn trace(rows: &str) -> String {
        format!("{}\n{rows}", Phase::COLUMNS)
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<_> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_run_that_fails_leaves_what_was_there_before() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path();
        write_earlier(folder);
        let before = names(folder);
        // It fails at once; after it began to record; is killed.
        for (begun, killed) in [(false, false), (true, false), (false, true)] {
            let mut folders = Folders::default();
            folders.lock(folder).unwrap();
            folders.claim(folder, &[folder.join(LOG)]).unwrap();
            for name in ["result.json", LOG, TRACE] {
                assert!(!folder.join(name).exists(), "{name} does not stand for this run");
            }
            if begun {
                for name in [RECORDING, LOG, SETTINGS_FILE] {
                    fs::write(folder.join(name), "failed").unwrap();
                }
                fs::write(folder.join(TRACE), trace("failed")).unwrap();
            }
            match killed {
                true => {
                    std::mem::take(&mut folders.claimed);
                    drop(folders);
                    assert!(folder.join(ASIDE).exists() && !folder.join(SETTINGS_FILE).exists());
                    drop(Folders::default().claim(folder, &[]));
                }
                false => drop(folders),
            }
            for file in [RECORDING, LOG, SETTINGS_FILE] {
                assert!(fs::read(folder.join(file)).unwrap().ends_with(b"earlier"), "{file}");
            }
            assert_eq!(fs::read_to_string(folder.join(TRACE)).unwrap(), trace("earlier"));
            for failed in ["recording.failed.mcap", "cav1.failed.mcap"].map(|name| folder.join(name)) {
                assert_eq!(failed.exists(), begun);
                let _ = fs::remove_file(failed);
            }
            assert_eq!(names(folder), before);
        }
    }

    #[test]
    fn a_run_that_succeeds_replaces_what_was_there_before() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path();
        write_earlier(folder);
        let mut folders = Folders::default();
        folders.claim(folder, &[folder.join(LOG)]).unwrap();
        fs::write(folder.join("result.json"), "{}").unwrap();
        folders.keep_new();
        drop(folders);
        assert_eq!(names(folder), ["channels", "result.json"]);
        assert!(names(&folder.join("channels")).is_empty());
    }

    #[test]
    fn a_complete_run_is_kept_beside_one_that_a_signal_ended_until_another_is_complete() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path();
        write_earlier(folder);
        let kept = folder.join(COMPLETE);
        let ended = r#"{"schema": "realo/result", "version": 2, "ended_by": "Ctrl-C"}"#;
        let run = |result: &str| {
            let mut folders = Folders::default();
            folders.claim(folder, &[folder.join(LOG)]).unwrap();
            fs::write(folder.join(RECORDING), recorded("new")).unwrap();
            fs::write(folder.join(RESULT_FILE), result).unwrap();
            folders.keep_new();
        };
        // A second one that is ended takes the place of the first, not of the complete one.
        for _ in 0..2 {
            run(ended);
            assert_eq!(fs::read_to_string(folder.join(RESULT_FILE)).unwrap(), ended);
            assert_eq!(names(&kept), [LOG, "channels", RECORDING, "result.json", SETTINGS_FILE]);
            assert_eq!(fs::read(kept.join(RECORDING)).unwrap(), recorded("earlier"));
        }
        run("{}");
        assert_eq!(names(folder), ["channels", RECORDING, "result.json"]);
    }

    #[test]
    fn of_several_runs_each_keeps_what_it_came_to_but_not_their_old_sum() {
        let root = tempfile::tempdir().unwrap();
        let plans = ["a", "b"].map(|plan| root.path().join(plan));
        let mut folders = Folders::default();
        write_earlier(root.path());
        folders.lock(root.path()).unwrap();
        for plan in &plans {
            fs::create_dir(plan).unwrap();
            write_earlier(plan);
            folders.claim(plan, &[plan.join(LOG)]).unwrap();
        }
        fs::write(plans[0].join("result.json"), "new").unwrap();
        drop(folders);
        assert_eq!(names(root.path()), ["a", "b", LOG, "channels"]);
        assert_eq!(names(&plans[0]), ["channels", "result.json"]);
        assert_eq!(
            names(&plans[1]),
            [LOG, "channels", RECORDING, "result.json", SETTINGS_FILE]
        );
    }

    #[test]
    fn two_runs_do_not_write_to_one_folder() {
        let root = tempfile::tempdir().unwrap();
        let mut first = Folders::default();
        first.lock(root.path()).unwrap();
        let error = Folders::default().lock(root.path()).unwrap_err().to_string();
        assert!(error.contains("another run writes there"), "{error}");
        drop(first);
        Folders::default().lock(root.path()).unwrap();
    }

    #[test]
    fn two_runs_do_not_write_into_each_others_folders() {
        let root = tempfile::tempdir().unwrap();
        let at = |path: &str| root.path().join(path);
        let refuses = |runs: &[&str]| {
            let mut second = Folders::default();
            let locked = second.lock(&at(runs[0]));
            let claimed = locked.and_then(|()| runs[1..].iter().try_for_each(|run| second.claim(&at(run), &[])));
            claimed.is_err_and(|error| error.to_string().contains("another run writes there"))
        };
        let mut first = Folders::default();
        first.lock(&at("out")).unwrap();
        first.claim(&at("out/log/car"), &[]).unwrap();
        assert!(refuses(&["out/log/car"]), "inside");
        assert!(!refuses(&["other", "other/log/car"]), "beside");
        drop(first);
        let mut first = Folders::default();
        first.lock(&at("out/log/car")).unwrap();
        assert!(refuses(&["out", "out/log/car"]), "around");
        assert!(!refuses(&["out", "out/log/van"]), "around, but not there");
        drop(first);
        assert!(!refuses(&["out", "out/log/car"]));
    }

    #[test]
    fn the_compute_profile_of_a_run_is_kept_with_its_other_files() {
        let root = tempfile::tempdir().unwrap();
        let (folder, profile) = (root.path(), root.path().join(compute::FILE));
        let written = |text: &str| format!("{}{text}", compute::HEAD);
        write_earlier(folder);
        fs::write(&profile, written("earlier = 1")).unwrap();
        let claim = || {
            let mut folders = Folders::default();
            folders.lock(folder).unwrap();
            folders.claim_profile(folder).map(|()| folders)
        };
        drop(claim().unwrap());
        assert_eq!(fs::read_to_string(&profile).unwrap(), written("earlier = 1"));
        let mut folders = claim().unwrap();
        assert!(!profile.exists());
        fs::write(&profile, written("ended = 1")).unwrap();
        let ended = r#"{"schema": "realo/result", "version": 2, "ended_by": "Ctrl-C"}"#;
        fs::write(folder.join(RESULT_FILE), ended).unwrap();
        folders.keep_new();
        drop(folders);
        let kept = folder.join(COMPLETE).join(compute::FILE);
        assert_eq!(fs::read_to_string(kept).unwrap(), written("earlier = 1"));
        fs::write(&profile, "mine = 1").unwrap();
        let error = claim().err().expect("it is the user's").to_string();
        assert!(error.contains("is not of a run of realo"), "{error}");
        assert_eq!(fs::read_to_string(&profile).unwrap(), "mine = 1");
    }

    #[test]
    fn recordings_of_failed_runs_go_with_a_complete_one() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path();
        for name in ["recording.failed.mcap", "cav1.failed.mcap"] {
            fs::write(folder.join(name), recorded("failed")).unwrap();
        }
        fs::write(folder.join("mine.failed.mcap"), "mine").unwrap();
        let mut folders = Folders::default();
        folders.claim(folder, &[]).unwrap();
        fs::write(folder.join(RESULT_FILE), "{}").unwrap();
        folders.keep_new();
        assert_eq!(names(folder), ["mine.failed.mcap", "result.json"]);
    }

    #[test]
    fn a_file_in_the_place_of_a_folder_is_named() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("notes");
        fs::write(&file, "mine").unwrap();
        for folder in [file.clone(), file.join("out")] {
            let error = Folders::default().lock(&folder).unwrap_err().to_string();
            assert!(
                error.contains("notes: results need a folder there, and it is a file"),
                "{error}"
            );
        }
    }

    #[test]
    fn files_of_somebody_else_stay() {
        let root = tempfile::tempdir().unwrap();
        let mine = root.path().join("mine");
        fs::create_dir(&mine).unwrap();
        fs::write(mine.join("notes"), "mine").unwrap();
        let log = {
            let name = "realo".as_bytes();
            let mut bytes = b"\x89MCAP0\r\n\x0c".to_vec();
            bytes.extend((4 + name.len() as u64).to_le_bytes());
            bytes.extend((name.len() as u32).to_le_bytes());
            [&bytes, name].concat()
        };
        let cases = [
            (RESULT_FILE, &b"mine"[..]),
            (SETTINGS_FILE, b"{\"mine\": 1}"),
            (LOCK, b"mine"),
            (RECORDING, &log),
        ];
        let written = |(name, bytes): (&'static str, &[u8])| {
            let folder = tempfile::tempdir().unwrap();
            fs::write(folder.path().join(name), bytes).unwrap();
            (name, folder)
        };
        let mut folders: Vec<_> = cases.into_iter().map(written).collect();
        for (name, to) in [(LOCK, mine.join("notes")), (ASIDE, mine.clone())] {
            let folder = tempfile::tempdir().unwrap();
            std::os::unix::fs::symlink(to, folder.path().join(name)).unwrap();
            folders.push((name, folder));
        }
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join(ASIDE)).unwrap();
        fs::write(folder.path().join(ASIDE).join("notes"), "mine").unwrap();
        folders.push((ASIDE, folder));
        for (name, folder) in folders {
            let before = fs::read(folder.path().join(name)).ok();
            let error = Folders::default().lock(folder.path()).unwrap_err().to_string();
            assert!(error.contains(name) && error.contains("is not of"), "{error}");
            assert_eq!(names(folder.path()), [name]);
            assert_eq!(fs::read(folder.path().join(name)).ok(), before);
        }
        assert_eq!(fs::read_to_string(mine.join("notes")).unwrap(), "mine");
    }
}

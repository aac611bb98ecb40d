//! Wall clocks of the machines' own, which can be set.

use std::fs::File;
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Moves the wall clock that a program reads (`wall_clock.rs`); empty where it could not be built.
const LIBRARY: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/wall_clock.so"));
const LIBRARY_FILE: &str = "wall_clock.so";
/// Names the file that reports by how much.
const VARIABLE: &str = "LINKEMU_WALL_CLOCK";
/// Name the libraries that programs load before their own: of a program, and of a system.
const PRELOAD: &str = "LD_PRELOAD";
const PRELOAD_FILE: &str = "ld.so.preload";
/// Where systems have that file.
const ETC: &str = "/etc";

/// The wall clock of one machine. Programs that are started with it read it where they call `clock_gettime` of the C library, as
/// Rust's do; what they hold for the steady clock goes on as ever.
pub(crate) struct WallClock {
    folder: PathBuf,
    ahead: File,
}

impl WallClock {
    /// A clock that is right.
    pub fn new() -> io::Result<WallClock> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let (id, number) = (std::process::id(), COUNT.fetch_add(1, Relaxed));
        let folder = std::env::temp_dir().join(format!("linkemu{id}clock{number}"));
        std::fs::create_dir(&folder)?;
        let made = || {
            let mut library = File::create(folder.join(LIBRARY_FILE))?;
            library.write_all(LIBRARY)?;
            let etc = folder.join("etc");
            std::fs::create_dir(&etc)?;
            let others = std::fs::read_to_string(Path::new(ETC).join(PRELOAD_FILE)).unwrap_or_default();
            let libraries = format!("{}\n{others}", folder.join(LIBRARY_FILE).display());
            std::fs::write(etc.join(PRELOAD_FILE), libraries)?;
            let ahead = File::create(folder.join("ahead"))?;
            ahead.write_all_at(&0_i64.to_ne_bytes(), 0)?;
            Ok(ahead)
        };
        match made() {
            Ok(ahead) => Ok(WallClock { folder, ahead }),
            Err(error) => {
                let _ = std::fs::remove_dir_all(&folder);
                Err(error)
            }
        }
    }

    /// Has a program read it.
    pub fn give(&self, command: &mut Command) {
        if LIBRARY.is_empty() {
            return;
        }
        let mut libraries = self.library().into_os_string();
        if let Some(others) = std::env::var_os(PRELOAD) {
            libraries.push(":");
            libraries.push(others);
        }
        command.env(PRELOAD, libraries).env(VARIABLE, self.folder.join("ahead"));
    }

    /// A command of a shell that has a program, its `$0`, and what that starts read it: some start others without the variable by
    /// which libraries are loaded. It changes `/etc` of the mount namespace in which it runs.
    pub fn within(&self) -> String {
        if LIBRARY.is_empty() {
            return r#"exec "$0" "$@""#.into();
        }
        let etc = self.folder.join(ETC.trim_start_matches('/'));
        let mount = format!("mount -t overlay linkemu -o lowerdir='{}':{ETC} {ETC}", etc.display());
        // Where that is not allowed, who sets the clock learns that it is not read.
        format!(r#"{mount} 2>/dev/null; exec "$0" "$@""#)
    }

    /// Sets it so many milliseconds ahead of the true one.
    pub fn set(&self, ms: f64) -> io::Result<()> {
        self.ahead.write_all_at(&((ms * 1e6) as i64).to_ne_bytes(), 0)
    }

    /// Whether a process reads it.
    pub fn is_read_by(&self, process: &str) -> bool {
        let maps = std::fs::read_to_string(Path::new("/proc").join(process).join("maps"));
        let library = self.library();
        maps.is_ok_and(|maps| maps.contains(&*library.to_string_lossy()))
    }

    fn library(&self) -> PathBuf {
        self.folder.join(LIBRARY_FILE)
    }
}

impl Drop for WallClock {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader};
    use std::process::Stdio;
    use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

    use super::*;

    const TELLS: &str = "LINKEMU_TELLS_THE_TIME";
    const THIS_TEST: &str = "clock::tests::a_program_reads_a_clock_that_is_set_while_it_runs";
    /// What reports the times may be held up by.
    const HELD_UP: f64 = 10.0;

    fn now() -> Duration {
        SystemTime::now().duration_since(UNIX_EPOCH).unwrap()
    }

    /// Writes the wall clock and the steady one, s, for each line that it reads.
    fn tell_the_time() {
        let begun = Instant::now();
        for _ in io::stdin().lock().lines() {
            eprintln!("{} {}", now().as_secs_f64(), begun.elapsed().as_secs_f64());
        }
    }

    /// Starts itself as the program that reads the clock.
    #[test]
    fn a_program_reads_a_clock_that_is_set_while_it_runs() {
        if std::env::var_os(TELLS).is_some() {
            return tell_the_time();
        }
        if LIBRARY.is_empty() {
            return skipped::skip("a 64-bit Linux with glibc, for which the library of clocks is built");
        }
        let clock = WallClock::new().unwrap();
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", THIS_TEST, "--nocapture"]);
        clock.give(&mut command);
        command.env(TELLS, "").stdin(Stdio::piped()).stdout(Stdio::null());
        let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
        let mut ask = child.stdin.take().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        // A day ahead, right, an hour and some behind.
        let mut steady = 0.0;
        for ahead in [0.0, 86_400.0, 0.0, -3_600.25] {
            clock.set(ahead * 1e3).unwrap();
            let before = now().as_secs_f64();
            writeln!(ask, "now").unwrap();
            let line = lines.next().unwrap().unwrap();
            let mut numbers = line.split(' ').map(|number| number.parse::<f64>().unwrap());
            let (wall, at) = (numbers.next().unwrap(), numbers.next().unwrap());
            let off = wall - before - ahead;
            assert!((-1e-3..HELD_UP).contains(&off), "{ahead}: {off}");
            assert!((steady..steady + HELD_UP).contains(&at), "{ahead}: {at}");
            steady = at;
        }
        assert!(clock.is_read_by(&child.id().to_string()));
        assert!(!clock.is_read_by(&std::process::id().to_string()));
        drop(ask);
        assert!(child.wait().unwrap().success());
        let folder = clock.folder.clone();
        drop(clock);
        assert!(!folder.exists());
    }
}

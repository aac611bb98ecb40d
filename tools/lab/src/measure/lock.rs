//! Keeps other calls out of what a call writes.

use std::fs::{self, File, TryLockError};
use std::io::Write;
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

use eyre::{Result, WrapErr, bail};
use rustix::io::{FdFlags, fcntl_setfd};

/// Steps of a call that was killed may still end, and hold its lock so long.
const ENDING: Duration = Duration::from_secs(3);

/// A file that is locked as long as this value, or a step that was started under it, lives.
pub struct Lock(File);

impl Lock {
    /// Locks the folder of a page by the file `path` in it.
    ///
    /// # Errors
    /// Another call that measures the page, by the number of its process.
    pub fn of_page(folder: &Path, path: &Path) -> Result<Self> {
        let mut lock = Lock(open(path)?);
        let begun = Instant::now();
        loop {
            match lock.0.try_lock() {
                Ok(()) => break,
                Err(TryLockError::Error(error)) => return Err(error).wrap_err_with(|| path.display().to_string()),
                Err(TryLockError::WouldBlock) if begun.elapsed() < ENDING => sleep(Duration::from_millis(20)),
                Err(TryLockError::WouldBlock) => {
                    let holder = fs::read_to_string(path).unwrap_or_default();
                    bail!(
                        "{}: process {} measures this page, or a step that it started still runs: wait until it has ended, then \
                         measure again",
                        folder.display(),
                        holder.trim()
                    );
                }
            }
        }
        lock.0
            .set_len(0)
            .and_then(|()| lock.0.write_all(std::process::id().to_string().as_bytes()))
            .wrap_err_with(|| path.display().to_string())?;
        // A step that outlives a killed call keeps the next one waiting.
        fcntl_setfd(&lock.0, FdFlags::empty())?;
        Ok(lock)
    }

    /// Waits until no other call writes a file that several pages share.
    ///
    /// # Errors
    /// A file that cannot be locked.
    pub fn wait(path: &Path) -> Result<Self> {
        let file = open(path)?;
        file.lock().wrap_err_with(|| path.display().to_string())?;
        Ok(Lock(file))
    }
}

impl Drop for Lock {
    /// Closing the file would not do where another process has it too.
    fn drop(&mut self) {
        let _ = self.0.unlock();
    }
}

fn open(path: &Path) -> Result<File> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).wrap_err_with(|| folder.display().to_string())?;
    }
    let file = File::options().create(true).append(true).open(path);
    file.wrap_err_with(|| path.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_is_measured_by_one_call_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(".steps/lock");
        let lock = || Lock::of_page(folder.path(), &path);
        let first = lock().unwrap();
        let Err(error) = lock() else {
            panic!("two calls have the lock")
        };
        let said = error.to_string();
        for part in [&folder.path().display().to_string(), &std::process::id().to_string()] {
            assert!(said.contains(part), "{part} is not in {said}");
        }
        drop(first);
        lock().unwrap();
    }
}

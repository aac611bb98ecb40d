//! The logs of the scenes, each made when the first run asks for it.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use eyre::{Result, WrapErr};

use super::plan::{FIRST_SEED, MOST_SCENES};
use crate::measure::{Program, Programs, run};

/// Every so many scenes are dense.
const DENSE: u64 = 3;

/// Logs in a folder.
pub struct Worlds<'a> {
    folder: PathBuf,
    seconds: u64,
    programs: &'a Programs,
    root: &'a Path,
    /// Held while a log is made: runs of other threads may want the same.
    making: Vec<Mutex<()>>,
}

impl<'a> Worlds<'a> {
    /// Logs of so many seconds below a folder.
    pub fn new(out: &Path, seconds: u64, programs: &'a Programs, root: &'a Path) -> Self {
        Worlds {
            folder: std::path::absolute(out).unwrap_or_else(|_| out.into()).join("logs"),
            seconds,
            programs,
            root,
            making: (0..MOST_SCENES).map(|_| Mutex::default()).collect(),
        }
    }

    /// The log of a scene.
    ///
    /// # Errors
    /// A simulator that failed, a disk that is full.
    pub fn log(&self, scene: u64) -> Result<PathBuf> {
        let _making = self.making[scene as usize]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let seed = FIRST_SEED + scene;
        let log = self.folder.join(format!("{seed}.mcap"));
        if log.exists() {
            return Ok(log);
        }
        std::fs::create_dir_all(&self.folder).wrap_err_with(|| self.folder.display().to_string())?;
        let mut args: Vec<String> = ["simulate", "--scenario", "mixed", "--seed"].map(String::from).into();
        args.extend([seed.to_string(), "--seconds".into(), self.seconds.to_string()]);
        args.extend((scene % DENSE == DENSE - 1).then(|| "--dense".to_string()));
        // What a kill leaves of a log has another name.
        let partial = self.folder.join(format!("{seed}.partial.mcap"));
        args.extend(["--force".into(), "-o".into(), partial.display().to_string()]);
        run(
            self.programs.path(Program::Lab),
            &args,
            self.root,
            &self.folder.join(seed.to_string()),
        )?;
        std::fs::rename(&partial, &log).wrap_err_with(|| log.display().to_string())?;
        Ok(log)
    }
}

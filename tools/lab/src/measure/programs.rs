//! The programs that steps start, and whether they are of this tree.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use eyre::{Result, WrapErr, bail, ensure};

use super::page::Program;
use super::provenance::sha256;

/// `realo` and `realo-lab`, and a digest of each.
pub struct Programs {
    realo: (PathBuf, String),
    lab: (PathBuf, String),
}

impl Programs {
    /// The programs beside this one, or `given` for both.
    ///
    /// # Errors
    /// One that is missing, or older than a source that it was built from.
    pub fn find(given: Option<&Path>, root: &Path) -> Result<Self> {
        if let Some(path) = given {
            let path = path.canonicalize().wrap_err_with(|| path.display().to_string())?;
            let program = (path.clone(), sha256(&path)?);
            return Ok(Programs {
                realo: program.clone(),
                lab: program,
            });
        }
        let own = std::env::current_exe()?;
        let realo = own.with_file_name("realo");
        ensure!(
            realo.is_file(),
            "{} is not there; build it: cargo build --release",
            realo.display()
        );
        for program in [&realo, &own] {
            refuse_stale(program, root)?;
        }
        Ok(Programs {
            realo: (realo.clone(), sha256(&realo)?),
            lab: (own.clone(), sha256(&own)?),
        })
    }

    /// Where a program is.
    pub fn path(&self, program: Program) -> &Path {
        &self.of(program).0
    }

    /// The sha256 of a program.
    pub fn digest(&self, program: Program) -> &str {
        &self.of(program).1
    }

    fn of(&self, program: Program) -> &(PathBuf, String) {
        match program {
            Program::Realo => &self.realo,
            Program::Lab => &self.lab,
        }
    }
}

/// Refuses a program that is older than one of its sources, by the list that cargo leaves beside it.
fn refuse_stale(program: &Path, root: &Path) -> Result<()> {
    let list = program.with_extension("d");
    let text = fs::read_to_string(&list).wrap_err_with(|| {
        let list = list.display();
        format!("{list}: without this list of cargo nobody knows whether the program is of this tree; build it here")
    })?;
    let built = fs::metadata(program)?.modified()?;
    if let Some(source) = newer(&text, built, root) {
        bail!(
            "{} is older than {}: build it again, or a page would name the wrong commit",
            program.display(),
            source.display()
        );
    }
    Ok(())
}

/// The first source of a list in Makefile's form that changed after `built`.
fn newer(list: &str, built: SystemTime, root: &Path) -> Option<PathBuf> {
    // A space inside a path has a backslash before it.
    let list = list.replace("\\ ", "\0");
    let sources = list.split_whitespace().filter(|word| !word.ends_with(':'));
    let paths = sources.map(|source| root.join(source.replace('\0', " ")));
    let mut changed = paths.filter(|path| {
        let modified = fs::metadata(path).and_then(|found| found.modified());
        modified.is_ok_and(|modified| modified > built)
    });
    changed.next()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_program_older_than_its_source_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let [program, source] = ["realo", "with space.rs"].map(|name| folder.path().join(name));
        fs::write(&program, "").unwrap();
        fs::write(&source, "").unwrap();
        let error = refuse_stale(&program, folder.path()).unwrap_err();
        assert!(error.to_string().contains("realo.d"), "{error}");
        let list = source.display().to_string().replace(' ', "\\ ");
        fs::write(
            folder.path().join("realo.d"),
            format!("{}: {list}\n", program.display()),
        )
        .unwrap();
        let built = fs::metadata(&program).unwrap().modified().unwrap();
        let change = |time| {
            fs::File::options()
                .write(true)
                .open(&source)
                .unwrap()
                .set_modified(time)
        };
        change(built - Duration::from_secs(1)).unwrap();
        refuse_stale(&program, folder.path()).unwrap();
        change(built + Duration::from_secs(1)).unwrap();
        let error = refuse_stale(&program, folder.path()).unwrap_err();
        assert!(error.to_string().contains("is older than"), "{error}");
    }
}

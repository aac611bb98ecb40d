//! The programs that steps start, and whether they are of this tree.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use eyre::{Result, WrapErr, bail};
use realo_cli::program::beside;

use super::page::Program;
use super::provenance::sha256;
use super::recipes;

/// `realo` and `realo-lab`, and a digest of each.
pub struct Programs {
    realo: (PathBuf, String),
    lab: (PathBuf, String),
}

impl Programs {
    /// The programs beside this one, and this one.
    ///
    /// # Errors
    /// One that is missing, that was built from another tree than `root`, or is older than a source of it.
    pub fn find(root: &Path) -> Result<Self> {
        let own = std::env::current_exe()?;
        let realo = beside("realo")?;
        for program in [&realo, &own] {
            refuse_stale(program, root)?;
        }
        Ok(Programs {
            realo: (realo.clone(), sha256(&realo)?),
            lab: (own.clone(), sha256(&own)?),
        })
    }

    /// One program in place of both.
    #[cfg(test)]
    pub fn alone(program: &Path) -> Self {
        let program = (program.to_path_buf(), sha256(program).unwrap());
        Programs {
            realo: program.clone(),
            lab: program,
        }
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

/// Refuses a program of another tree, or one that is older than one of its sources, by the list that cargo leaves beside it.
fn refuse_stale(program: &Path, root: &Path) -> Result<()> {
    let list = program.with_extension("d");
    let text = fs::read_to_string(&list).wrap_err_with(|| {
        let list = list.display();
        format!("{list}: without this list of cargo nobody knows whether the program is of this tree; build it here")
    })?;
    let (sources, program_shown) = (sources(&text, root), program.display());
    let tree = |source: &PathBuf| recipes::root(source.parent()?).ok();
    if !sources.iter().any(|source| tree(source).as_deref() == Some(root)) {
        let first = sources.first().unwrap_or(&list);
        bail!(
            "{program_shown}: expected a program that was built from {}, whose commit the page would name, found one that was \
             built from {}: run the `realo-lab` that is built here",
            root.display(),
            tree(first).as_ref().unwrap_or(first).display()
        );
    }
    let built = fs::metadata(program)?.modified()?;
    if let Some(source) = newer(&sources, built) {
        bail!(
            "{program_shown} is older than {}: build it again, or a page would name the wrong commit",
            source.display()
        );
    }
    Ok(())
}

/// The sources in a list in Makefile's form.
fn sources(list: &str, root: &Path) -> Vec<PathBuf> {
    // A space inside a path has a backslash before it.
    let list = list.replace("\\ ", "\0");
    let sources = list.split_whitespace().filter(|word| !word.ends_with(':'));
    sources.map(|source| root.join(source.replace('\0', " "))).collect()
}

/// The first source that changed after `built`.
fn newer(sources: &[PathBuf], built: SystemTime) -> Option<&PathBuf> {
    sources.iter().find(|path| {
        let modified = fs::metadata(path).and_then(|found| found.modified());
        modified.is_ok_and(|modified| modified > built)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_program_older_than_its_source_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        // As the tree is found.
        let root = folder.path().canonicalize().unwrap();
        fs::create_dir_all(root.join("tools/lab/src/measure/pages")).unwrap();
        let [program, source] = ["realo", "with space.rs"].map(|name| root.join(name));
        fs::write(&program, "").unwrap();
        fs::write(&source, "").unwrap();
        let error = refuse_stale(&program, &root).unwrap_err();
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
        refuse_stale(&program, &root).unwrap();
        change(built + Duration::from_secs(1)).unwrap();
        let error = refuse_stale(&program, &root).unwrap_err();
        assert!(error.to_string().contains("is older than"), "{error}");
        // The program of one tree, called in another one.
        let other = tempfile::tempdir().unwrap();
        let error = refuse_stale(&program, &other.path().canonicalize().unwrap())
            .unwrap_err()
            .to_string();
        for part in [other.path(), &root] {
            assert!(error.contains(&part.display().to_string()), "{error}");
        }
    }
}

//! The kinds of data sets: one trait, one registry, and which kind a folder is.

mod bag;
mod cooperscene;
mod dair;
mod family;
mod folders;
mod job;
mod kitti;
mod numpy;
mod opv2v;
mod seen;
mod tumtraf;
mod urbaning;
mod v2v4real;
mod v2x_real;
mod v2x_seq;

use std::path::Path;

pub use self::folders::FolderMemory;
pub use self::job::{Imported, Job};
pub use self::seen::{Seen, look_at};
use crate::{ImportError, Options};

/// What a kind of data set is, and what its import takes.
pub struct Kind {
    /// As `realo-lab import` calls it.
    pub name: &'static str,
    /// The data sets of this kind.
    pub title: &'static str,
    /// The files that it needs.
    pub needs: &'static str,
    /// What is counted while it is imported.
    pub unit: &'static str,
    /// What is given to the import, if that is not one folder.
    pub paths: Option<&'static str>,
    /// Whether it is known by what is in its root alone; else scenes are looked for below a folder.
    pub is_exact: bool,
    /// Options that it takes, each with its default, empty where there is none.
    pub options: &'static [(&'static str, &'static str)],
}

impl Kind {
    /// The options as they are by default.
    pub fn defaults(&self) -> Options {
        let mut options = Options::default();
        for (name, default) in self.options.iter().filter(|(_, default)| !default.is_empty()) {
            options
                .set(name, default)
                .expect("defaults can be set, as a test shows");
        }
        options
    }

    /// Sets an option from its text.
    ///
    /// # Errors
    /// An option that this kind does not take; a value that is not one.
    pub fn set(&self, options: &mut Options, name: &str, text: &str) -> Result<(), ImportError> {
        let names: Vec<String> = self.options.iter().map(|(name, _)| format!("--{name}")).collect();
        match self.options.iter().any(|(known, _)| *known == name) {
            true => options.set(name, text).map_err(ImportError::Option),
            false => Err(ImportError::Option(format!(
                "--{name}: `{}` does not take it; it takes {}",
                self.name,
                names.join(", ")
            ))),
        }
    }
}

/// Brings a kind of data set into logs.
pub trait Importer: Sync {
    /// What it is.
    fn kind(&self) -> &'static Kind;

    /// Why a folder, or a file, is of this kind.
    ///
    /// # Errors
    /// Why it is not.
    fn recognise(&self, dir: &Path) -> Result<String, String>;

    /// Why a folder that `recognise` does not know may be of this kind nevertheless: nothing in it tells this kind from another.
    fn undecided(&self, _: &Path) -> Option<String> {
        None
    }

    /// Finds out what there is to do in a folder that may be of this kind, as [`Importer::job`].
    ///
    /// # Errors
    /// Scenes, agents or frames that do not exist.
    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError>;

    /// Finds out what there is to do, and does nothing yet. `output`: a log, or a folder for a log of each scene.
    ///
    /// # Errors
    /// A folder of another kind, with its name; scenes, agents or frames that do not exist.
    fn job(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        let _memory = FolderMemory::new(|_| {});
        let Err(why_not) = self.recognise(dir) else {
            return self.prepare(dir, output, options);
        };
        if let Some(line) = self.undecided(dir) {
            let line = format!("{line}: taken as `{}`, as it was named", self.kind().name);
            return Ok(self.prepare(dir, output, options)?.assuming(line));
        }
        let hint = seen::refuse_others(self.kind(), dir, &why_not)?;
        let job = self.prepare(dir, output, options);
        match hint {
            None => job,
            Some(hint) => Ok(job.map_err(|error| error.with_hint(hint.clone()))?.hinting(hint)),
        }
    }
}

/// All kinds.
pub static KINDS: &[&dyn Importer] = &[
    &dair::Dair,
    &opv2v::OPV2V,
    &v2x_real::V2X_REAL,
    &v2v4real::V2V4REAL,
    &cooperscene::CooperScene,
    &v2x_seq::V2xSeq,
    &tumtraf::TumTraf,
    &urbaning::Urbaning,
    &kitti::Kitti,
    &numpy::Numpy,
    &bag::RosBag,
];

/// A kind by its name.
///
/// # Errors
/// The names that there are.
pub fn importer(name: &str) -> Result<&'static dyn Importer, ImportError> {
    let found = KINDS.iter().find(|importer| importer.kind().name == name);
    let names: Vec<&str> = KINDS.iter().map(|importer| importer.kind().name).collect();
    found.copied().ok_or_else(|| {
        let name = crate::shown(name);
        ImportError::Option(format!("there is no kind `{name}`; there are {}", names.join(", ")))
    })
}

/// The kinds with what each needs, for `import --list`.
pub fn list() -> String {
    let line = |importer: &&dyn Importer| {
        let Kind { name, title, needs, .. } = importer.kind();
        format!("{name:<11} {title}\n{:<11} needs {needs}", "")
    };
    KINDS.iter().map(line).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::options::option_info;

    #[test]
    fn options_of_kinds_exist_and_take_their_defaults() {
        for importer in KINDS {
            let kind = importer.kind();
            for (name, default) in kind.options {
                assert!(option_info(name).is_some(), "{}: --{name}", kind.name);
                if !default.is_empty() {
                    kind.set(&mut Options::default(), name, default).unwrap();
                }
            }
            kind.defaults();
            assert!(std::ptr::eq(super::importer(kind.name).unwrap().kind(), kind));
            assert!(list().contains(kind.name));
        }
        let error = KINDS[0]
            .kind()
            .set(&mut Options::default(), "handed", "left")
            .unwrap_err();
        assert!(
            error
                .to_string()
                .contains("`dair` does not take it; it takes --roadside-stamp"),
            "{error}"
        );
        assert!(
            importer("rosbags")
                .err()
                .unwrap()
                .to_string()
                .contains("there are dair, opv2v")
        );
    }
}

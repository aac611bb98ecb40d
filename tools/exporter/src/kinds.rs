//! The layouts: one trait, one registry, and the export of a log in one of them.

mod cpm;
mod kitti;
mod opv2v;
mod rosbag2;

use std::path::Path;

use realo_logs::{Log, McapFile, shell};

use crate::{ExportError, Exported, Folder, Options};

/// What a layout is, and what its export takes.
pub struct Kind {
    /// As `realo-lab export` calls it.
    pub name: &'static str,
    /// What it is.
    pub title: &'static str,
    /// What of it is written.
    pub writes: &'static str,
    /// What its progress counts.
    pub unit: &'static str,
    /// Options that it takes, each with its default, empty where there is none.
    pub options: &'static [(&'static str, &'static str)],
}

impl Kind {
    /// Sets an option from its text.
    ///
    /// # Errors
    /// An option that this kind does not take; a value that is not one.
    pub fn set(&self, options: &mut Options, name: &str, text: &str) -> Result<(), ExportError> {
        let names: Vec<String> = self.options.iter().map(|(name, _)| format!("--{name}")).collect();
        match self.options.iter().any(|(known, _)| *known == name) {
            true => options.set(name, text).map_err(ExportError::Option),
            false => Err(ExportError::Option(format!(
                "--{name}: `{}` does not take it; it takes {}",
                self.name,
                names.join(", ")
            ))),
        }
    }
}

/// Is called with sweeps that are done, and all sweeps.
pub type Report<'a> = &'a mut dyn FnMut(u64, u64);

/// Writes logs in one layout.
pub trait Exporter: Sync {
    /// What it is.
    fn kind(&self) -> &'static Kind;

    /// Writes a log into a folder. [`Exported::path`] and [`Exported::bytes`] are filled in by [`export`].
    ///
    /// # Errors
    /// A log that does not have what the layout needs; why writing failed.
    fn write(&self, log: &Log, folder: &mut Folder, options: &Options, report: Report)
    -> Result<Exported, ExportError>;

    /// The same of the recording of a run, where it has what the layout needs.
    ///
    /// # Errors
    /// As [`Exporter::write`]; a layout of logs.
    fn write_recording(
        &self,
        file: &McapFile,
        _: &mut Folder,
        _: &Options,
        _: Report,
    ) -> Result<Exported, ExportError> {
        let kind = self.kind().name;
        let reason = format!(
            "`{kind}`: expected a log with clouds, found the recording of a run, which has none; export the log that was played"
        );
        Err(ExportError::unfit(file.path(), reason))
    }
}

/// All kinds.
pub static KINDS: &[&dyn Exporter] = &[&opv2v::Opv2v, &kitti::Kitti, &rosbag2::Rosbag2, &cpm::Cpm];

/// A kind by its name.
///
/// # Errors
/// The names that there are.
pub fn exporter(name: &str) -> Result<&'static dyn Exporter, ExportError> {
    let found = KINDS.iter().find(|exporter| exporter.kind().name == name);
    let names: Vec<&str> = KINDS.iter().map(|exporter| exporter.kind().name).collect();
    found.copied().ok_or_else(|| {
        let name: String = name.chars().take(40).collect::<String>().escape_debug().collect();
        ExportError::Option(format!("there is no kind `{name}`; there are {}", names.join(", ")))
    })
}

/// The kinds with what each writes, for `export --list`.
pub fn list() -> String {
    let line = |exporter: &&dyn Exporter| {
        let Kind {
            name, title, writes, ..
        } = exporter.kind();
        format!("{name:<10} {title}\n{:<10} writes {writes}", "")
    };
    KINDS.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// Writes a log to a folder, which appears when it is complete. `replace`: an earlier export there is replaced.
///
/// # Errors
/// An output of somebody else; a log that does not have what the layout needs; why writing failed.
pub fn export(
    exporter: &dyn Exporter,
    log: &Log,
    output: &Path,
    options: &Options,
    replace: bool,
    report: Report,
) -> Result<Exported, ExportError> {
    written(exporter, log.path(), output, replace, |folder| {
        exporter.write(log, folder, options, report)
    })
}

/// Writes what the recording of a run has to a folder, as [`export`].
///
/// # Errors
/// As [`export`]; a layout of logs.
pub fn export_recording(
    exporter: &dyn Exporter,
    file: &McapFile,
    output: &Path,
    options: &Options,
    replace: bool,
    report: Report,
) -> Result<Exported, ExportError> {
    written(exporter, file.path(), output, replace, |folder| {
        exporter.write_recording(file, folder, options, report)
    })
}

fn written(
    exporter: &dyn Exporter,
    from: &Path,
    output: &Path,
    replace: bool,
    write: impl FnOnce(&mut Folder) -> Result<Exported, ExportError>,
) -> Result<Exported, ExportError> {
    let mut folder = Folder::create(output, replace)?;
    let mut exported = write(&mut folder)?;
    exported.kind = exporter.kind().name;
    exported.path = output.into();
    exported.bytes = folder.written();
    exported.read_back = exported.read_back.replace("PATH", &shell::word(output));
    folder.finish(exported.kind, from, replace)?;
    Ok(exported)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::option_info;

    #[test]
    fn options_of_kinds_exist_and_take_their_defaults() {
        for exporter in KINDS {
            let kind = exporter.kind();
            for (name, default) in kind.options {
                assert!(option_info(name).is_some(), "{}: --{name}", kind.name);
                if !default.is_empty() {
                    let mut options = Options::default();
                    kind.set(&mut options, name, default).unwrap();
                    assert_eq!(options, Options::default(), "{}: --{name}", kind.name);
                }
            }
            assert!(std::ptr::eq(super::exporter(kind.name).unwrap().kind(), kind));
            assert!(list().contains(kind.name));
        }
        let error = KINDS[0]
            .kind()
            .set(&mut Options::default(), "agent", "cav1")
            .unwrap_err();
        assert!(
            error
                .to_string()
                .contains("`opv2v` does not take it; it takes --agents"),
            "{error}"
        );
        let error = exporter("bag").err().unwrap().to_string();
        assert!(error.contains("there are opv2v, kitti, rosbag2"), "{error}");
    }
}

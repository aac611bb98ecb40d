//! Output files of commands: what is there already is replaced only where it is realo's.

use std::fs;
use std::io::Read;
use std::path::Path;

use eyre::{Result, WrapErr, bail, eyre};
use realo_logs::refuse_foreign;
use realo_schemas::report::Phase;

/// Whether a command may replace any file.
#[derive(clap::Args, Clone, Copy, Default)]
pub struct Force {
    /// Replace the output file even if another program wrote it
    #[arg(long)]
    force: bool,
}

/// What a command writes.
#[derive(Clone, Copy, Debug)]
pub enum Output {
    /// A log, or a log with packets: known by its records.
    Log,
    /// A file that is known by how it begins.
    Known {
        /// What it is, in words.
        name: &'static str,
        /// Whether its first 4096 bytes are those of such a file.
        begins: fn(&[u8]) -> bool,
    },
}

impl Output {
    /// A picture.
    pub const SVG: Output = Output::Known {
        name: "an SVG picture",
        begins: |head| head.starts_with(b"<svg") || head.starts_with(b"<?xml"),
    };
    /// A picture.
    pub const PNG: Output = Output::Known {
        name: "a PNG picture",
        begins: |head| head.starts_with(b"\x89PNG\r\n"),
    };
    /// A page for a browser, of ours: others write pages too.
    pub const HTML: Output = Output::Known {
        name: "a report of realo",
        begins: |head| head.starts_with(b"<!doctype html>\n<!-- realo report -->"),
    };
    /// A trace of a link.
    pub const TRACE: Output = Output::Known {
        name: "a trace of a link",
        begins: |head| head.starts_with(Phase::COLUMNS.as_bytes()),
    };
}

/// Refuses a file whose name ends otherwise; the first ending is the one that is named.
///
/// # Errors
/// The ending that was expected, and the one that was found.
pub fn expect_ending(path: &Path, endings: &[&str]) -> Result<()> {
    let found = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    if found.as_deref().is_some_and(|found| endings.contains(&found)) {
        return Ok(());
    }
    bail!(
        "{}: expected a file name that ends in .{}, found {}",
        path.display(),
        endings.first().copied().unwrap_or_default(),
        found.map_or("no ending".into(), |ending| format!(".{ending}"))
    )
}

/// Writes a file at once or not at all.
///
/// # Errors
/// Where the system refuses, with its reason.
pub fn write_whole(path: &Path, content: impl AsRef<[u8]>) -> Result<()> {
    let partial = path.with_added_extension("partial");
    let written = fs::write(&partial, content).and_then(|()| fs::rename(&partial, path));
    written.map_err(|reason| {
        // It may not be there at all.
        let _ = fs::remove_file(&partial);
        eyre!(
            "{}: cannot be written: {reason}; choose another place with -o",
            path.display()
        )
    })
}

impl Force {
    /// Refuses to replace a file that is not of the kind that the command writes; to be called before anything is computed.
    ///
    /// # Errors
    /// Such a file; one that cannot be read; a folder.
    pub fn check(self, path: &Path, output: Output) -> Result<()> {
        if self.force || !path.is_file() {
            return Ok(());
        }
        let Output::Known { name, begins } = output else {
            return refuse_foreign(path).map_err(|error| eyre!("{error}; --force replaces it"));
        };
        let mut head = Vec::new();
        let file = fs::File::open(path).wrap_err_with(|| format!("{}", path.display()))?;
        file.take(4096).read_to_end(&mut head)?;
        if !head.is_empty() && !begins(&head) {
            bail!(
                "refuse to overwrite {}: expected {}, or no file, found something else; choose another path, or --force to replace it",
                path.display(),
                name
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_another_kind_is_replaced_by_force_alone() {
        let folder = tempfile::tempdir().unwrap();
        let notes = folder.path().join("notes");
        fs::write(&notes, "what I must not forget").unwrap();
        for output in [Output::Log, Output::SVG, Output::PNG, Output::HTML, Output::TRACE] {
            let said = format!("{:#}", Force::default().check(&notes, output).unwrap_err());
            assert!(
                said.starts_with("refuse to overwrite") && said.contains("notes") && said.contains("--force"),
                "{said}"
            );
            Force { force: true }.check(&notes, output).unwrap();
            Force::default().check(&folder.path().join("none"), output).unwrap();
        }
    }

    #[test]
    fn files_of_the_same_kind_are_replaced() {
        let folder = tempfile::tempdir().unwrap();
        for (output, bytes) in [
            (Output::SVG, &b"<svg xmlns=\"http://www.w3.org/2000/svg\">"[..]),
            (Output::PNG, b"\x89PNG\r\n\x1a\n"),
            (Output::PNG, b""),
        ] {
            let path = folder.path().join("file");
            fs::write(&path, bytes).unwrap();
            Force::default().check(&path, output).unwrap();
        }
    }
}

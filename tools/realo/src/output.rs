//! Output files of commands: what is there already is replaced only where it is realo's.

use std::fs;
use std::io::Read;
use std::path::Path;

use eyre::{Result, WrapErr, bail, eyre};
use realo_logs::refuse_foreign;
use realo_radio::keys::Trusted;
use realo_schemas::report::Phase;

/// Whether a command may replace any file.
#[derive(clap::Args, Clone, Copy, Default)]
pub struct Force {
    /// Replace the output file even if another program wrote it
    #[arg(long)]
    force: bool,
}

/// What a command writes, and how its files begin.
#[derive(Clone, Copy, Debug)]
pub enum Output {
    /// A log, or a log with packets.
    Log,
    /// A picture.
    Svg,
    /// A picture.
    Png,
    /// A trace of a link.
    Trace,
    /// The public key of an agent.
    PublicKey,
}

impl Output {
    fn name(self) -> &'static str {
        match self {
            Output::Log => "a log",
            Output::Svg => "an SVG picture",
            Output::Png => "a PNG picture",
            Output::Trace => "a trace of a link",
            Output::PublicKey => "the public key of one agent",
        }
    }

    fn begins(self, head: &[u8]) -> bool {
        match self {
            Output::Log => unreachable!("logs are known by their records"),
            Output::Svg => head.starts_with(b"<svg") || head.starts_with(b"<?xml"),
            Output::Png => head.starts_with(b"\x89PNG\r\n"),
            Output::Trace => head.starts_with(Phase::COLUMNS.as_bytes()),
            Output::PublicKey => str::from_utf8(head)
                .is_ok_and(|text| Trusted::parse(text, Path::new("")).is_ok_and(|known| known.0.len() == 1)),
        }
    }
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
        if matches!(output, Output::Log) {
            return refuse_foreign(path).map_err(|error| eyre!("{error}; --force replaces it"));
        }
        let mut head = Vec::new();
        let file = fs::File::open(path).wrap_err_with(|| format!("{}", path.display()))?;
        file.take(4096).read_to_end(&mut head)?;
        if !head.is_empty() && !output.begins(&head) {
            bail!(
                "refuse to overwrite {}: expected {}, or no file, found something else; choose another path, or --force to replace it",
                path.display(),
                output.name()
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
        for output in [Output::Log, Output::Svg, Output::Png, Output::Trace, Output::PublicKey] {
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
            (Output::Svg, &b"<svg xmlns=\"http://www.w3.org/2000/svg\">"[..]),
            (Output::Png, b"\x89PNG\r\n\x1a\n"),
            (Output::Png, b""),
        ] {
            let path = folder.path().join("file");
            fs::write(&path, bytes).unwrap();
            Force::default().check(&path, output).unwrap();
        }
    }
}

//! Runs the command of a step.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use eyre::{Result, WrapErr, bail};
use realo_cli::signals;
use realo_host::Guard;

/// Lines of a command that failed, which its error repeats.
const LAST_LINES: usize = 12;
/// How often is looked whether a command or this process is to end.
const LOOK: Duration = Duration::from_millis(20);

/// Runs a command in a folder; what it prints goes into the files `NAME.stdout` and `NAME.stderr`. It ends, with all that it
/// started, when this process does, however that ends, and at once when a signal is caught.
///
/// # Errors
/// A command that cannot start, or that ends with another code than 0: the command and its last lines. A signal.
pub fn run(program: &Path, args: &[String], folder: &Path, name: &Path) -> Result<()> {
    let [stdout, stderr] = ["stdout", "stderr"].map(|end| name.with_added_extension(end));
    let file = |path: &Path| File::create(path).wrap_err_with(|| path.display().to_string());
    let guard = Guard::start().wrap_err("sh, which ends a step together with this program")?;
    let mut command = Command::new(program);
    command
        .args(args)
        .current_dir(folder)
        .stdin(Stdio::null())
        .stdout(file(&stdout)?)
        .stderr(file(&stderr)?);
    guard.lead(&mut command);
    let mut child = command
        .spawn()
        .wrap_err_with(|| format!("{} did not start", program.display()))?;
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if let Some(ending) = signals::first() {
            guard.kill();
            child.wait()?;
            bail!("ended by {ending}");
        }
        std::thread::sleep(LOOK);
    };
    if !status.success() {
        let command = shlex::try_join(args.iter().map(String::as_str)).unwrap_or_else(|_| args.join(" "));
        let printed: String = [stdout, stderr].iter().map(last_lines).collect();
        bail!("{} {command}: {status}\n{}", program.display(), printed.trim_end());
    }
    Ok(())
}

fn last_lines(path: &std::path::PathBuf) -> String {
    let bytes = fs::read(path).unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let lines: Vec<&str> = text.lines().collect();
    let last = &lines[lines.len().saturating_sub(LAST_LINES)..];
    last.iter().map(|line| format!("  {line}\n")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(script: &str, folder: &Path) -> Result<()> {
        run(
            Path::new("/bin/sh"),
            &["-c".into(), script.into()],
            folder,
            &folder.join("step"),
        )
    }

    #[test]
    fn a_command_that_fails_ends_with_its_last_lines() {
        let folder = tempfile::tempdir().unwrap();
        let error = shell("seq 30; echo no log >&2; exit 3", folder.path())
            .unwrap_err()
            .to_string();
        for expected in ["/bin/sh -c", "exit status: 3", "  30\n", "  no log"] {
            assert!(error.contains(expected), "{expected}: {error}");
        }
        assert!(!error.contains("  18\n"), "{error}");
    }

    #[test]
    fn what_a_command_prints_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        shell("echo '{}'", folder.path()).unwrap();
        assert_eq!(fs::read_to_string(folder.path().join("step.stdout")).unwrap(), "{}\n");
    }
}

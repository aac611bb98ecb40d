//! Finding the dora CLI, or installing the released one under `target/`.

use std::path::{Path, PathBuf};
use std::process::Command;

use eyre::{Result, WrapErr, bail, eyre};

/// The release that the nodes are built for.
const VERSION: &str = "1.1.0";
/// What `dora --version` begins with for a release that fits.
const SERIES: &str = "dora-cli 1.1.";

/// A dora CLI of the right series: `REALO_DORA`, then one installed under `target/`, then PATH; else installs one.
///
/// # Errors
/// A `REALO_DORA` that does not fit; an installation that failed, with what to do by hand.
pub fn find() -> Result<PathBuf> {
    if let Some(named) = std::env::var_os("REALO_DORA") {
        let named = PathBuf::from(named);
        return match version(&named) {
            Some(text) if text.starts_with(SERIES) => Ok(named),
            Some(text) => bail!("REALO_DORA={}: expected {SERIES}x, found `{text}`", named.display()),
            None => bail!("REALO_DORA={}: {}", named.display(), why_silent(&named)),
        };
    }
    let installed = home()?.join("bin/dora");
    for candidate in [installed.clone(), PathBuf::from("dora")] {
        if version(&candidate).is_some_and(|text| text.starts_with(SERIES)) {
            return Ok(candidate);
        }
    }
    install(&home()?)?;
    Ok(installed)
}

/// Where dora is, and its version; installs nothing.
///
/// # Errors
/// What a realtime run would do about it.
pub fn on_this_machine() -> Result<String, String> {
    let named = std::env::var_os("REALO_DORA").map(PathBuf::from);
    let installed = home().map(|home| home.join("bin/dora")).ok();
    let known = named.clone().map_or_else(
        || installed.into_iter().chain([PathBuf::from("dora")]).collect(),
        |named| vec![named],
    );
    let found = known.iter().find_map(|dora| Some((dora, version(dora)?)));
    match found {
        Some((dora, text)) if text.starts_with(SERIES) => Ok(format!("{text}, {}", dora.display())),
        Some((dora, text)) => Err(format!("{}: expected {SERIES}x, found `{text}`", dora.display())),
        None if named.is_some() => Err("REALO_DORA does not answer `--version`".into()),
        None => Ok(format!(
            "not installed; the first realtime run installs dora-rs-cli {VERSION} by pip"
        )),
    }
}

fn version(dora: &Path) -> Option<String> {
    let output = Command::new(dora).arg("--version").output().ok()?;
    output
        .status
        .success()
        .then(|| String::from_utf8_lossy(&output.stdout).trim().to_string())
}

/// Why a dora says no version, and what helps.
fn why_silent(dora: &Path) -> String {
    let reason = match Command::new(dora).arg("--version").output() {
        Ok(output) => format!(
            "it does not answer `--version`: {}",
            String::from_utf8_lossy(&output.stderr).trim()
        ),
        Err(error) => format!("it cannot be started: {error}"),
    };
    format!(
        "{reason}; {}, or run with --mode virtual, which needs no dora",
        by_hand()
    )
}

fn by_hand() -> String {
    format!(
        "install it by hand (`pip install --no-deps dora-rs-cli=={VERSION}`) and put `dora` on PATH or name it in REALO_DORA"
    )
}

/// `target/dora-cli`, beside the profile's folder that this program runs from.
fn home() -> Result<PathBuf> {
    let program = std::env::current_exe()?;
    let target = program
        .ancestors()
        .find(|folder| folder.file_name().is_some_and(|name| name == "target"));
    Ok(target
        .map_or_else(|| PathBuf::from("target"), Path::to_path_buf)
        .join("dora-cli"))
}

fn install(home: &Path) -> Result<()> {
    eprintln!("realo: installing dora-rs-cli {VERSION} into {} (once)", home.display());
    if let Some(folder) = home.parent() {
        std::fs::create_dir_all(folder).wrap_err_with(|| format!("{}: {}", folder.display(), by_hand()))?;
    }
    let lock_path = home.with_extension("lock");
    let lock = std::fs::File::create(&lock_path).wrap_err_with(|| format!("{}: {}", lock_path.display(), by_hand()))?;
    lock.lock()?;
    if version(&home.join("bin/dora")).is_some() {
        return Ok(());
    }
    // What is there may be half of one, or of another folder.
    step(Command::new("python3").args(["-m", "venv", "--clear"]).arg(home)).wrap_err_with(by_hand)?;
    let package = format!("dora-rs-cli=={VERSION}");
    let mut pip = Command::new(home.join("bin/python"));
    step(pip.args(["-m", "pip", "install", "--quiet", "--no-deps", &package])).wrap_err_with(by_hand)
}

fn step(command: &mut Command) -> Result<()> {
    let output = command.output().map_err(|error| eyre!("{command:?}: {error}"))?;
    if !output.status.success() {
        bail!("{command:?} failed: {}", String::from_utf8_lossy(&output.stderr).trim());
    }
    Ok(())
}

//! Writes pages and the table of README.md, and leaves alone what did not change.

use std::fs;
use std::path::Path;

use eyre::{Result, WrapErr, ensure};

/// What the line begins with that names the commit.
pub const COMMIT: &str = "| commit |";
/// Ends a block of a page that is written by `measure`.
const END: &str = "<!-- /measured -->";

/// Writes a page. If only its commit is new, the page stays: it names the commit that its figures were first measured at.
///
/// # Errors
/// A file that cannot be written.
pub fn write_page(path: &Path, text: &str) -> Result<()> {
    let old = fs::read_to_string(path).unwrap_or_default();
    if same_figures(&old, text) {
        eprintln!("realo-lab: {} stays: its figures are the same", path.display());
        return Ok(());
    }
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).wrap_err_with(|| folder.display().to_string())?;
    }
    write(path, text)?;
    eprintln!("realo-lab: wrote {}", path.display());
    Ok(())
}

/// Copies a drawing beside its page.
///
/// # Errors
/// A file that cannot be read or written.
pub fn copy(from: &Path, to: &Path) -> Result<()> {
    let text = fs::read_to_string(from).wrap_err_with(|| from.display().to_string())?;
    if let Some(folder) = to.parent() {
        fs::create_dir_all(folder).wrap_err_with(|| folder.display().to_string())?;
    }
    write(to, &text)
}

/// Whether two pages differ in the commit at most.
fn same_figures(old: &str, new: &str) -> bool {
    let figures = |text: &str| -> Vec<String> {
        let lines = text.split('\n').filter(|line| !line.starts_with(COMMIT));
        lines.map(str::to_string).collect()
    };
    figures(old) == figures(new)
}

/// Writes a file beside its place and renames it, so that no half of it is ever there.
fn write(path: &Path, text: &str) -> Result<()> {
    let beside = path.with_added_extension("new");
    fs::write(&beside, text)
        .and_then(|()| fs::rename(&beside, path))
        .wrap_err_with(|| path.display().to_string())
}

/// Refuses a file without the markers of a block, before anything is measured for it.
///
/// # Errors
/// The markers that are missing.
pub fn check_markers(path: &Path, name: &str) -> Result<()> {
    let text = fs::read_to_string(path).wrap_err_with(|| path.display().to_string())?;
    with_block(&text, name, "")
        .map(drop)
        .wrap_err_with(|| path.display().to_string())
}

/// Writes the block `name` of a file.
///
/// # Errors
/// As [`check_markers`]; a file that cannot be written.
pub fn write_block(path: &Path, name: &str, block: &str) -> Result<()> {
    let old = fs::read_to_string(path).wrap_err_with(|| path.display().to_string())?;
    let new = with_block(&old, name, block).wrap_err_with(|| path.display().to_string())?;
    if new != old { write(path, &new) } else { Ok(()) }
}

/// The text with another block between its markers.
fn with_block(text: &str, name: &str, block: &str) -> Result<String> {
    let begin = format!("<!-- measured: {name} -->");
    ensure!(
        text.matches(&begin).count() == 1,
        "expected one line `{begin}`, and `{END}` below it"
    );
    let (before, rest) = text.split_once(&begin).unwrap_or_default();
    let after = rest.split_once(END).map(|(_, after)| after);
    ensure!(after.is_some(), "expected `{END}` below `{begin}`");
    let after = after.unwrap_or_default();
    Ok(format!("{before}{begin}\n\n{}\n\n{END}{after}", block.trim()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_with_the_same_figures_keeps_its_commit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("docs/small.md");
        let page =
            |commit: &str, ap: &str| format!("# T\n\n| | |\n|---|---|\n| commit | `{commit}` |\n\n| mAP | {ap} |\n");
        for (commit, ap, kept) in [("one", "0.9", "one"), ("two", "0.9", "one"), ("two", "0.8", "two")] {
            write_page(&path, &page(commit, ap)).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), page(kept, ap));
        }
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn only_the_text_between_the_markers_changes() {
        let text =
            "a\n<!-- measured: demo -->\nold\n<!-- /measured -->\nb\n<!-- measured: other -->\nc\n<!-- /measured -->\n";
        let new = with_block(text, "demo", "| new |\n").unwrap();
        let expected = text.replacen("\nold\n", "\n\n| new |\n\n", 1);
        assert_eq!(new, expected);
        assert_eq!(with_block(&new, "demo", "| new |").unwrap(), new);
    }

    #[test]
    fn missing_and_double_markers_are_refused() {
        let [begin, end] = ["<!-- measured: demo -->", "<!-- /measured -->"];
        for (text, expected) in [
            ("", "expected one line"),
            (&format!("{begin}{end}{begin}{end}")[..], "expected one line"),
            (&format!("{end}{begin}"), "below"),
        ] {
            assert!(
                with_block(text, "demo", "").unwrap_err().to_string().contains(expected),
                "{text}"
            );
        }
    }
}

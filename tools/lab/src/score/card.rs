//! The table of scores in the card beside a model file.

use std::fs;
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, eyre};
use realo_cli::write_whole;
use realo_methods::Model;
use realo_nn::layers::Layers;

use super::{HEAD, about};
use crate::measure::sha256;

/// Where the card of a model file is.
fn beside(file: &Path) -> PathBuf {
    file.with_extension("md")
}

fn stem(file: &Path) -> String {
    file.file_stem().unwrap_or_default().to_string_lossy().into()
}

/// The table of scores in the card beside a model file.
///
/// # Errors
/// No card, or none with a table, and the command that writes it.
pub fn table_of(file: &Path) -> Result<String> {
    let card = beside(file);
    let remedy = format!("`realo-lab score {} --card` writes it", file.display());
    if !card.exists() {
        return Err(eyre!(
            "{}: expected the card of `{}` there, found no file; {remedy}",
            card.display(),
            stem(file)
        ));
    }
    let text = fs::read_to_string(&card).wrap_err_with(|| card.display().to_string())?;
    let lines = find(&text).ok_or_else(|| {
        eyre!(
            "{}: expected a table of scores, which begins with `{}`, found none; {remedy}",
            card.display(),
            HEAD.trim()
        )
    })?;
    Ok(text[lines].to_string())
}

/// Where the table is in a card.
fn find(text: &str) -> Option<std::ops::Range<usize>> {
    let begin = match text.starts_with(HEAD) {
        true => 0,
        false => text.find(&format!("\n{HEAD}"))? + 1,
    };
    let lines = text[begin..].split_inclusive('\n');
    let length: usize = lines.take_while(|line| line.starts_with('|')).map(str::len).sum();
    Some(begin..begin + length)
}

/// Whether the table of the card beside a model file is this one; names the cells that differ.
///
/// # Errors
/// As [`table_of`].
pub fn agrees(file: &Path, found: &str) -> Result<bool> {
    let card = beside(file);
    let differ = differences(&table_of(file)?, found);
    match differ.is_empty() {
        true => println!("{}: the same digits", card.display()),
        false => println!(
            "{}: expected the table of its card, found other digits:\n  {}",
            card.display(),
            differ.join("\n  ")
        ),
    }
    Ok(differ.is_empty())
}

/// Where two tables differ: rows and columns by their names, with what is expected and found there.
fn differences(expected: &str, found: &str) -> Vec<String> {
    let rows = |table: &str| -> Vec<Vec<String>> {
        let cells = |line: &str| {
            line.trim()
                .trim_matches('|')
                .split('|')
                .map(|cell| cell.trim().into())
                .collect()
        };
        table.lines().map(cells).collect()
    };
    let (expected, found) = (rows(expected), rows(found));
    let empty = Vec::new();
    let mut differ = Vec::new();
    for at in 0..expected.len().max(found.len()) {
        let [was, is] = [&expected, &found].map(|table| table.get(at).unwrap_or(&empty));
        for column in 0..was.len().max(is.len()) {
            let shown = |row: &Vec<String>| match row.get(column).filter(|cell| !cell.is_empty()) {
                Some(cell) => format!("`{cell}`"),
                None => "nothing".to_string(),
            };
            if was.get(column) != is.get(column) {
                let of = |row: &Vec<String>, column: usize| row.get(column).cloned().unwrap_or_default();
                let row = if was.is_empty() { of(is, 0) } else { of(was, 0) };
                let head = expected.first().map_or(String::new(), |head| of(head, column));
                differ.push(format!("{row}, {head}: expected {}, found {}", shown(was), shown(is)));
            }
        }
    }
    differ
}

/// Puts a table into the card beside a model file, which is begun where there is none.
///
/// # Errors
/// Files that cannot be read or written.
pub fn write(file: &Path, table: &str) -> Result<PathBuf> {
    let card = beside(file);
    let model = Model::read(file)?;
    let text = match card.exists() {
        true => fs::read_to_string(&card).wrap_err_with(|| card.display().to_string())?,
        false => begun(file, &model)?,
    };
    let text = match find(&text) {
        Some(lines) => format!("{}{table}{}", &text[..lines.start], &text[lines.end..]),
        None => format!(
            "{}\n\n## Scores\n\n{}\n\n{table}",
            text.trim_end(),
            about(&stem(file), &model)
        ),
    };
    write_whole(&card, text)?;
    Ok(card)
}

/// A card without scores: what the model file says of itself, and its weights.
fn begun(file: &Path, model: &Model) -> Result<String> {
    let stem = stem(file);
    let text = fs::read_to_string(file).wrap_err_with(|| file.display().to_string())?;
    let comment = text.lines().map_while(|line| line.strip_prefix('#'));
    let comment: Vec<&str> = comment.map(str::trim).collect();
    let mut card = format!(
        "<!-- Begun by `realo-lab score {stem} --card`, which later replaces the table of scores only. -->\n# `{stem}`\n\n"
    );
    if !comment.is_empty() {
        card += &format!("{}\n\n", comment.join("\n"));
    }
    let numbers: usize = Layers::of(model).tensors().map(|spec| spec.count()).sum();
    card += &format!(
        "| | |\n|---|---|\n| model | [{stem}.toml]({stem}.toml), {numbers} numbers, {} |\n",
        model.precision
    );
    let mut weights = Vec::new();
    for path in model.weights_beside(file) {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        weights.push(format!("`{name}`, sha256 `{}`", sha256(&path)?));
    }
    card += &format!("| weights | {} |\n", weights.join("; "));
    Ok(card)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: &str = "| AP | IoU | alone | merged |\n|---|---:|---:|---:|\n| vehicle | 0.5 | 0.8364 | 0.9073 |\n";

    #[test]
    fn a_digit_that_differs_is_named_by_class_and_way() {
        assert_eq!(differences(TABLE, TABLE), Vec::<String>::new());
        assert_eq!(
            differences(TABLE, &TABLE.replace("0.9073", "0.9074")),
            ["vehicle, merged: expected `0.9073`, found `0.9074`"]
        );
        let more = format!("{TABLE}| truck | 0.5 | 0.7 | 0.8 |\n");
        assert_eq!(
            differences(TABLE, &more)[0],
            "truck, AP: expected nothing, found `truck`"
        );
    }

    #[test]
    fn a_card_that_has_no_table_is_told_apart_from_none() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mine.toml");
        let said = || table_of(&file).unwrap_err().to_string();
        assert!(
            said().contains("mine.md") && said().contains("found no file"),
            "{}",
            said()
        );
        assert!(said().contains("mine.toml --card"), "{}", said());
        fs::write(beside(&file), "# mine\n\n| a | b |\n").unwrap();
        assert!(said().contains("expected a table of scores"), "{}", said());
        fs::write(beside(&file), format!("# mine\n\n{TABLE}\nWords.\n")).unwrap();
        assert_eq!(table_of(&file).unwrap(), TABLE);
        let other = TABLE.replace("0.9073", "0.9");
        assert!(agrees(&file, TABLE).unwrap() && !agrees(&file, &other).unwrap());
    }

    #[test]
    fn a_table_takes_the_place_of_the_one_before_and_a_card_is_begun() {
        let folder = tempfile::tempdir().unwrap();
        let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
        for name in ["lite.toml", "lite.safetensors"] {
            fs::copy(models.join(name), folder.path().join(name)).unwrap();
        }
        let file = folder.path().join("lite.toml");
        let card = write(&file, TABLE).unwrap();
        let begun = fs::read_to_string(&card).unwrap();
        for part in [
            "# `lite`\n\nPointPillars",
            "`lite.safetensors`, sha256 `215dce35",
            "f32 on avx2",
            TABLE,
        ] {
            assert!(begun.contains(part), "{part}: {begun}");
        }
        fs::write(&card, begun.replace("PointPillars", "Mine") + "\n## Limits\n").unwrap();
        let other = TABLE.replace("0.9073", "0.9");
        write(&file, &other).unwrap();
        let again = fs::read_to_string(&card).unwrap();
        assert!(
            again.contains("Mine") && again.contains(&other) && !again.contains(TABLE),
            "{again}"
        );
        assert!(
            again.ends_with("\n\n## Limits\n") || again.ends_with("|\n\n## Limits\n"),
            "{again}"
        );
    }
}

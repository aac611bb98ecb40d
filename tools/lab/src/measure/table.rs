//! Tables of results, in Markdown.

use std::collections::BTreeMap;

use eyre::{Result, WrapErr, bail, eyre};
use serde_json::Value;

use super::cell::{NONE, cell};
use super::json::find;
use super::page::{Column, Table};

/// A row whose results are at hand.
struct Filled {
    label: String,
    results: BTreeMap<String, Value>,
}

/// A table in Markdown; `result` finds a result by its name.
///
/// # Errors
/// A result or a path that is not there, with the row and the column.
pub fn markdown(table: &Table, columns: &[&Column], result: impl Fn(&str) -> Result<Value>) -> Result<String> {
    let titles: Vec<&str> = columns.iter().map(|column| column.title.as_str()).collect();
    let mut text = format!("| {} | {} |\n", table.head, titles.join(" | "));
    text += &format!("|---|{}\n", "---:|".repeat(columns.len()));
    for row in rows(table, result)? {
        let cells: Result<Vec<String>> = columns.iter().map(|column| written(&row, column)).collect();
        let cells = cells.wrap_err_with(|| format!("table `{}`, row `{}`", table.title, row.label))?;
        text += &format!("| {} | {} |\n", row.label, cells.join(" | "));
    }
    Ok(text)
}

fn rows(table: &Table, result: impl Fn(&str) -> Result<Value>) -> Result<Vec<Filled>> {
    let Some(list) = &table.list else {
        let rows = table.rows.iter().map(|row| {
            let results = row.results.iter().map(|(name, of)| Ok((name.clone(), result(of)?)));
            Ok(Filled {
                label: row.label.clone(),
                results: results.collect::<Result<_>>()?,
            })
        });
        return rows.collect();
    };
    let whole = result(&list.of)?;
    let Value::Array(elements) = find(&whole, &list.path)? else {
        bail!("table `{}`: `{}` is not a list", table.title, list.path);
    };
    let rows = elements.iter().map(|element| {
        let words = list.label.iter().map(|path| match find(element, path)? {
            Value::String(word) => Ok(word.clone()),
            Value::Null => Ok(NONE.into()),
            other => Ok(other.to_string()),
        });
        Ok(Filled {
            label: words.collect::<Result<Vec<_>>>()?.join(" "),
            results: BTreeMap::from([("run".into(), element.clone())]),
        })
    });
    rows.collect()
}

/// A cell; a row without the result that the column reads has none.
fn written(row: &Filled, column: &Column) -> Result<String> {
    let Some(result) = row.results.get(&column.of) else {
        return Ok(NONE.into());
    };
    let values: Result<Vec<&Value>> = column.paths.iter().map(|path| find(result, path)).collect();
    let values = values.wrap_err_with(|| format!("column `{}`", column.title))?;
    cell(&values, column.format, column.scale).map_err(|error| eyre!("column `{}`: {error}", column.title))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn column(title: &str, of: &str, paths: &[&str]) -> Column {
        let paths = paths.iter().map(|path| path.to_string()).collect();
        let (title, of, format) = (title.into(), of.into(), crate::measure::cell::Format::Three);
        Column {
            title,
            about: None,
            of,
            paths,
            format,
            scale: 1.0,
        }
    }

    fn results(name: &str) -> Result<Value> {
        match name {
            "offline/late" => Ok(json!({ "mAP": { "0.3": 0.9, "0.5": 0.8 } })),
            "paper:late" => Ok(json!([0.3])),
            "bench" => {
                Ok(json!({ "steps": [{ "name": "a", "agents": 2, "ms": 1 }, { "name": "b", "agents": 4, "ms": 2.5 }] }))
            }
            _ => Err(eyre!("there is no `{name}`")),
        }
    }

    #[test]
    fn rows_read_several_results() {
        let table: Table = toml::from_str(
            "title = 'T'\nhead = 'strategy'\ncolumns = []\nrows = [\n\
             { label = 'late', run = 'offline/late', paper = 'paper:late' }, { label = 'mine', run = 'offline/late' }]",
        )
        .unwrap();
        let columns = [
            column("mAP", "run", &["/mAP/0.3", "/mAP/0.5"]),
            column("paper", "paper", &["/0"]),
        ];
        let text = markdown(&table, &columns.iter().collect::<Vec<_>>(), results).unwrap();
        let expected = "| strategy | mAP | paper |\n|---|---:|---:|\n\
                        | late | 0.900 / 0.800 | 0.300 |\n| mine | 0.900 / 0.800 | – |\n";
        assert_eq!(text, expected);
        let wrong = column("mAP", "run", &["/mAP/0.7"]);
        let error = format!("{:#}", markdown(&table, &[&wrong], results).unwrap_err());
        assert!(
            error.contains("table `T`, row `late`: column `mAP`: `/mAP/0.7`: there is no `0.7`"),
            "{error}"
        );
    }

    #[test]
    fn a_list_has_a_row_for_each_element() {
        let table: Table = toml::from_str(
            "title = 'T'\nhead = 'step'\ncolumns = []\nlist = { of = 'bench', path = '/steps', label = ['/name', '/agents'] }",
        )
        .unwrap();
        let text = markdown(&table, &[&column("ms", "run", &["/ms"])], results).unwrap();
        assert_eq!(text, "| step | ms |\n|---|---:|\n| a 2 | 1.000 |\n| b 4 | 2.500 |\n");
    }
}

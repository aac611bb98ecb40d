//! What a page can get wrong, found without running anything.

use std::collections::{BTreeMap, BTreeSet};

use eyre::{Result, WrapErr, ensure, eyre};

use super::page::{Column, Page, Step};
use super::template;

impl Page {
    /// Checks that a page names only what there is; `shared` are the columns that all pages know.
    ///
    /// # Errors
    /// Two steps of one name; a placeholder, a column or a step that does not exist.
    pub fn check(&self, shared: &BTreeMap<String, Column>) -> Result<()> {
        let mut known: BTreeSet<&str> = self.parameters.keys().map(String::as_str).collect();
        for step in &self.steps {
            self.check_step(step, &known)?;
            ensure!(known.insert(&step.name), "`{}` names two things", step.name);
        }
        for curves in &self.curves {
            let (title, step) = (&curves.title, &curves.step);
            ensure!(self.step(step).is_some(), "curves `{title}`: there is no step `{step}`");
        }
        for table in &self.tables {
            ensure!(
                table.rows.is_empty() == table.list.is_some(),
                "table `{}`: it takes rows or a list",
                table.title
            );
            for name in &table.columns {
                let found = self.columns.get(name).or_else(|| shared.get(name));
                found.ok_or_else(|| eyre!("table `{}`: there is no column `{name}`", table.title))?;
            }
            let rows = table.rows.iter().flat_map(|row| row.results.values());
            for result in rows.chain(table.list.iter().map(|list| &list.of)) {
                let step = result.split(['/', ':']).next().unwrap_or_default();
                let is_known = step == "paper" || self.step(step).is_some();
                ensure!(is_known, "table `{}`: there is no step `{step}`", table.title);
            }
        }
        Ok(())
    }

    fn check_step(&self, step: &Step, known: &BTreeSet<&str>) -> Result<()> {
        check_name(&step.name).wrap_err_with(|| format!("step `{}`", step.name))?;
        self.check_output(step)?;
        let each = step.each.as_ref();
        if let Some(each) = each {
            ensure!(
                self.parameters.contains_key(&each.count),
                "step `{}`: there is no parameter `{}`",
                step.name,
                each.count
            );
        }
        for name in step.args.iter().flat_map(|arg| template::names(arg)) {
            let is_known = name == "out"
                || known.contains(name)
                || each.is_some_and(|each| each.variable == name)
                || template::variable(name).is_some();
            ensure!(is_known, "step `{}`: nothing before it is named `{name}`", step.name);
        }
        Ok(())
    }

    /// Refuses an output that is not the step's own: what is there is removed before the command writes it anew. With names
    /// that have no dot, the outputs of two steps are never the same.
    fn check_output(&self, step: &Step) -> Result<()> {
        let rest = step.output.strip_prefix("{out}");
        let is_own = rest.is_some_and(|rest| {
            let inside = rest.is_empty() || rest.starts_with(['.', '/']);
            let is_known = |name: &&str| self.parameters.contains_key(*name);
            inside && !rest.contains("..") && template::names(rest).iter().all(is_known)
        });
        ensure!(
            is_own,
            "step `{}`: `output`: expected `{{out}}`, and behind it nothing, an ending or a file below it; found `{}`",
            step.name,
            step.output
        );
        Ok(())
    }
}

/// Refuses the name of a page or a step that would not be one folder or file of its own.
///
/// # Errors
/// Other signs than letters, digits, `-` and `_`.
pub fn check_name(name: &str) -> Result<()> {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "-_".contains(letter);
    ensure!(
        !name.is_empty() && name.chars().all(is_plain),
        "expected a name of letters, digits, `-` and `_`, found `{name}`"
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(text: &str) -> Result<()> {
        let page: Page = toml::from_str(&format!("title = 'T'\nkind = 'scores'\nabout = 'A'\n{text}"))?;
        page.check(&BTreeMap::new())
    }

    #[test]
    fn a_page_names_only_what_there_is() {
        let step = "[[steps]]\nname = 'a'\nprogram = 'realo'\n";
        let table = "[[tables]]\ntitle = 'T'\nhead = 'h'\n";
        for (text, expected) in [
            (
                format!("{step}args = ['{{b}}']"),
                "step `a`: nothing before it is named `b`",
            ),
            (format!("{step}args = []\n{step}args = []"), "`a` names two things"),
            (
                format!("{step}args = []\neach = {{ variable = 's', from = 1, count = 'n' }}"),
                "there is no parameter `n`",
            ),
            (
                format!("{table}columns = ['x']\nrows = [{{ label = 'l' }}]"),
                "there is no column `x`",
            ),
            (format!("{table}columns = []"), "it takes rows or a list"),
            (
                format!("{table}columns = []\nrows = [{{ label = 'l', run = 'b/c' }}]"),
                "there is no step `b`",
            ),
            ("other = 1".into(), "unknown field `other`"),
            (format!("{step}args = []").replace("'a'", "'../a'"), "found `../a`"),
            (format!("{step}args = []").replace("'a'", "''"), "found ``"),
            (format!("{step}args = []").replace("'a'", "'a.b'"), "found `a.b`"),
        ] {
            let error = format!("{:#}", checked(&text).unwrap_err());
            assert!(error.contains(expected), "{text}\n{error}");
        }
        checked(&format!("{step}args = ['{{out}}', '{{env:HOME}}']")).unwrap();
    }

    #[test]
    fn nothing_but_a_place_of_the_step_is_its_output() {
        let with = |output: &str| {
            let step = format!("[[steps]]\nname = 'a'\nprogram = 'realo'\nargs = []\noutput = '{output}'");
            checked(&format!("parameters = {{ n = 1 }}\n{step}"))
        };
        for output in ["{out}", "{out}.mcap", "{out}/{n}.json"] {
            with(output).unwrap();
        }
        for output in [
            "/tmp/mine",
            "mine",
            "",
            "{out}mine",
            "{out}/../mine",
            "{out}/{env:HOME}",
            "{out}/{a}",
            "x{out}",
        ] {
            let error = with(output).unwrap_err().to_string();
            assert!(
                error.contains("step `a`: `output`") && error.contains(output),
                "{error}"
            );
        }
    }
}

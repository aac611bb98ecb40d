//! What a page can get wrong, found without running anything.

use std::collections::{BTreeMap, BTreeSet};

use eyre::{Result, ensure, eyre};

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
        ] {
            let error = checked(&text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}\n{error}");
        }
        checked(&format!("{step}args = ['{{out}}', '{{env:HOME}}']")).unwrap();
    }
}

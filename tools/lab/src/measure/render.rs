//! A page in Markdown.

use std::collections::BTreeMap;
use std::path::PathBuf;

use eyre::Result;

use super::output::COMMIT;
use super::page::{Column, Curves, Kind, Page, Step, Table};
use super::plan::Plan;
use super::provenance::Provenance;
use super::source::Results;
use super::{table, template};

/// All that a page is made of.
pub struct Sheet<'a> {
    /// What it holds.
    pub page: &'a Page,
    /// What was run.
    pub plan: &'a Plan,
    /// What came out.
    pub results: &'a Results<'a>,
    /// The columns that all pages know.
    pub columns: &'a BTreeMap<String, Column>,
}

impl Sheet<'_> {
    /// The page.
    ///
    /// # Errors
    /// A result or a path that is not there.
    pub fn markdown(&self, provenance: &Provenance) -> Result<String> {
        let mut text = format!(
            "<!-- Written by `{}`: what is edited here is lost. -->\n# {}\n\n{}\n\n",
            provenance.command,
            self.filled(&self.page.title)?,
            self.filled(self.page.about.trim())?
        );
        text += &self.head(provenance)?;
        for table in &self.page.tables {
            text += &format!("\n## {}\n\n", self.filled(&table.title)?);
            if let Some(about) = &table.about {
                text += &format!("{}\n\n", self.filled(about.trim())?);
            }
            text += &self.table(table)?;
        }
        for curves in &self.page.curves {
            text += &self.curves(curves)?;
        }
        text += &words(self.page.tables.iter().flat_map(|table| self.used(table)));
        text += &self.commands()?;
        Ok(text)
    }

    /// The drawings of the page: their names beside it, and where they are.
    ///
    /// # Errors
    /// As [`Sheet::markdown`].
    pub fn drawings(&self) -> Result<Vec<(String, PathBuf)>> {
        let drawing = |curves: &Curves| {
            let file = self.results.drawing(&curves.step, &curves.setting)?;
            Ok((self.drawing(curves), file))
        };
        self.page.curves.iter().map(drawing).collect()
    }

    fn drawing(&self, curves: &Curves) -> String {
        format!("{}-{}.svg", self.plan.name, curves.step)
    }

    fn curves(&self, curves: &Curves) -> Result<String> {
        let title = self.filled(&curves.title)?;
        let about = curves
            .about
            .as_deref()
            .map_or(Ok(String::new()), |about| self.filled(about.trim()))?;
        let table = self.results.curves(&curves.step, &curves.setting)?;
        let parts = [
            format!("\n## {title}"),
            about,
            format!("![{title}]({})", self.drawing(curves)),
            table,
        ];
        let parts: Vec<String> = parts.into_iter().filter(|part| !part.is_empty()).collect();
        Ok(parts.join("\n\n"))
    }

    /// The table that README.md has of the page, if any.
    ///
    /// # Errors
    /// As [`Sheet::markdown`].
    pub fn readme_table(&self) -> Result<Option<String>> {
        let table = self.page.tables.iter().find(|table| table.readme);
        table.map(|table| self.table(table)).transpose()
    }

    fn filled(&self, text: &str) -> Result<String> {
        template::fill(text, |name| Some(self.page.parameters.get(name)?.to_string()))
    }

    fn used(&self, table: &Table) -> Vec<&Column> {
        let own = |name: &String| self.page.columns.get(name).or_else(|| self.columns.get(name));
        table.columns.iter().filter_map(own).collect()
    }

    fn table(&self, table: &Table) -> Result<String> {
        table::markdown(table, &self.used(table), |name| self.results.find(name))
    }

    fn head(&self, provenance: &Provenance) -> Result<String> {
        let figures = match self.page.kind {
            Kind::Scores => "scores and bytes; every run in the same instructions gives the same digits",
            Kind::Times => "times of this machine; compare ratios, not milliseconds",
        };
        let mut text = format!("| | |\n|---|---|\n| figures | {figures} |\n");
        text += &format!(
            "{COMMIT} {} |\n| written by | `{}` |\n",
            provenance.commit, provenance.command
        );
        if let Some(machine) = &provenance.machine {
            text += &format!("| CPU | {}, {} threads |\n", machine.cpu, machine.threads);
            text += &format!("| instructions of the CPU | {} |\n", machine.instructions);
        }
        let rows = self.page.tables.iter().flat_map(|table| &table.rows);
        let names = rows.flat_map(|row| row.results.values().cloned());
        let networks = self.results.instructions(names)?;
        if !networks.is_empty() {
            text += &format!("| networks computed in | {} |\n", networks.join(", "));
        }
        for (file, digest) in &provenance.weights {
            text += &format!("| sha256 of `{file}` | `{digest}` |\n");
        }
        Ok(text)
    }

    /// The commands, as one would type them.
    fn commands(&self) -> Result<String> {
        let lines: Result<Vec<String>> = self.page.steps.iter().map(|step| self.command(step)).collect();
        Ok(format!("\n## Commands\n\n```sh\n{}\n```\n", lines?.join("\n")))
    }

    fn command(&self, step: &Step) -> Result<String> {
        let mut jobs = self.plan.jobs.iter().filter(|job| job.step == step.name);
        let Some(job) = jobs.next() else {
            return Ok(format!("# {}: nothing to run", step.name));
        };
        let many = |name: &str| self.page.step(name).is_some_and(|step| step.each.is_some());
        let mut words = vec![step.program.name().to_string()];
        for arg in &step.args {
            let names = template::names(arg);
            match names.iter().find(|name| many(name)) {
                Some(name) => words.push(format!(
                    "$(printf -- '{} ' {})",
                    arg.replace(&format!("{{{name}}}"), "%s"),
                    self.all(name)
                )),
                None => words.push(self.word(arg, step, job.value)?),
            }
        }
        let command = words.join(" ");
        Ok(match (&step.each, job.value) {
            (Some(each), Some(first)) => {
                let last = first + self.page.parameters[&each.count] - 1;
                format!("for {} in $(seq {first} {last}); do {command}; done", each.variable)
            }
            _ => command,
        })
    }

    /// An argument as a shell takes it: variables stay variables.
    fn word(&self, arg: &str, step: &Step, value: Option<u64>) -> Result<String> {
        let variable = step.each.as_ref().map(|each| each.variable.as_str());
        let out = |name: &str| {
            let job = self.plan.jobs.iter().find(|job| job.step == name)?;
            Some(job.output.clone())
        };
        let folder = self.plan.place(&step.name);
        let filled = template::fill(arg, |name| match name {
            "out" if value.is_some() => Some(format!("{folder}/${{{}}}", variable?)),
            "out" => Some(folder.clone()),
            _ if variable == Some(name) => Some(format!("${{{name}}}")),
            _ => match template::variable(name) {
                Some(variable) => Some(format!("${{{variable}}}")),
                None => self.page.parameters.get(name).map(u64::to_string).or_else(|| out(name)),
            },
        })?;
        // A dollar must stay one, so what needs quotes otherwise gets double ones.
        let plain = |letter: char| letter.is_alphanumeric() || "-_=./,:+%{}$".contains(letter);
        Ok(if filled.chars().all(plain) {
            filled
        } else {
            format!("\"{filled}\"")
        })
    }

    /// A pattern for all files of a step with several commands.
    fn all(&self, name: &str) -> String {
        let output = self.page.step(name).map_or("", |step| step.output.as_str());
        let variable = self.page.step(name).and_then(|step| step.each.as_ref());
        let variable = variable.map_or(String::new(), |each| format!("{{{}}}", each.variable));
        let place = format!("{}/*", self.plan.place(name));
        output.replace("{out}", &place).replace(&variable, "*")
    }
}

/// What the headers of columns mean.
pub fn words<'a>(columns: impl Iterator<Item = &'a Column>) -> String {
    let mut meanings: Vec<(&str, &str)> = Vec::new();
    for column in columns {
        let meaning = column.about.as_deref().map(|about| (column.title.as_str(), about));
        meanings.extend(meaning.filter(|meaning| !meanings.contains(meaning)));
    }
    if meanings.is_empty() {
        return String::new();
    }
    let lines: String = meanings
        .iter()
        .map(|(word, about)| format!("- {word}: {about}\n"))
        .collect();
    format!("\n## Columns\n\n{lines}")
}

#[cfg(test)]
mod tests;

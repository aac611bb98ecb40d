//! The commands of a page, in their order, and where they write.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use eyre::Result;

use super::page::{Page, Program, Step};
use super::template;

/// Where steps write, below the root.
const FOLDER: &str = "target/realo/measured";
/// Where what steps print is kept, and a key of what they were made from.
const KEPT: &str = ".steps";

/// A command of a page.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// The step's name.
    pub step: String,
    /// Which of several commands of the step: the value of its variable.
    pub value: Option<u64>,
    /// The program.
    pub program: Program,
    /// The arguments; a variable of the environment is still a placeholder.
    pub args: Vec<String>,
    /// What it writes, relative to the root.
    pub output: String,
    /// Names of the steps whose outputs it reads.
    pub reads: Vec<String>,
}

/// The commands of a page.
pub struct Plan {
    /// The page.
    pub name: String,
    /// In the order in which they run.
    pub jobs: Vec<Job>,
}

impl Plan {
    /// The commands of the page `name`.
    ///
    /// # Errors
    /// A placeholder without a value.
    pub fn new(name: &str, page: &Page) -> Result<Self> {
        let mut plan = Plan {
            name: name.into(),
            jobs: Vec::new(),
        };
        for step in &page.steps {
            let values = match &step.each {
                None => vec![None],
                Some(each) => (each.from..each.from + page.parameters[&each.count])
                    .map(Some)
                    .collect(),
            };
            for value in values {
                let job = plan.job(step, value, &page.parameters)?;
                plan.jobs.push(job);
            }
        }
        Ok(plan)
    }

    fn job(&self, step: &Step, value: Option<u64>, parameters: &BTreeMap<String, u64>) -> Result<Job> {
        let mut out = self.place(&step.name);
        if let Some(value) = value {
            out += &format!("/{value}");
        }
        let plain = |name: &str| match &step.each {
            _ if name == "out" => Some(out.clone()),
            Some(each) if each.variable == name => value.map(|value| value.to_string()),
            _ if template::variable(name).is_some() => Some(format!("{{{name}}}")),
            _ => parameters.get(name).map(u64::to_string),
        };
        let (mut args, mut reads) = (Vec::new(), Vec::new());
        for arg in &step.args {
            let read = template::names(arg)
                .into_iter()
                .find(|name| self.outputs(name).next().is_some());
            match read {
                Some(read) => {
                    reads.push(read.to_string());
                    for output in self.outputs(read) {
                        args.push(template::fill(arg, |name| {
                            if name == read {
                                Some(output.clone())
                            } else {
                                plain(name)
                            }
                        })?);
                    }
                }
                None => args.push(template::fill(arg, plain)?),
            }
        }
        Ok(Job {
            step: step.name.clone(),
            value,
            program: step.program,
            args,
            output: template::fill(&step.output, plain)?,
            reads,
        })
    }

    /// The folder of the page.
    pub fn folder(&self, root: &Path) -> PathBuf {
        root.join(FOLDER).join(&self.name)
    }

    /// What is locked while the page is measured.
    pub fn lock(&self, root: &Path) -> PathBuf {
        self.folder(root).join(KEPT).join("lock")
    }

    /// Where a step writes, relative to the root.
    pub fn place(&self, step: &str) -> String {
        format!("{FOLDER}/{}/{step}", self.name)
    }

    /// What a step writes: a file or folder for each of its commands.
    fn outputs<'a>(&'a self, step: &'a str) -> impl Iterator<Item = &'a String> {
        let jobs = self.jobs.iter().filter(move |job| job.step == step);
        jobs.map(|job| &job.output)
    }

    /// Where what a command prints is kept, without the ending.
    pub fn kept(&self, job: &Job, root: &Path) -> PathBuf {
        let value = job.value.map_or(String::new(), |value| format!(".{value}"));
        self.folder(root).join(KEPT).join(format!("{}{value}", job.step))
    }

    /// What the only command of a step printed.
    pub fn printed(&self, job: &Job, root: &Path) -> PathBuf {
        self.kept(job, root).with_added_extension("stdout")
    }
}

/// What is locked while README.md is written.
pub fn readme_lock(root: &Path) -> PathBuf {
    root.join(FOLDER).join(".readme-lock")
}

/// Whether what counts of a command is what it prints.
pub fn captures(job: &Job) -> bool {
    job.args.iter().any(|arg| arg == "--json")
}

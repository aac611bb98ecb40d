//! The commands of a page: in which order, where they write, and whether what they wrote is still good.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, eyre};
use sha2::{Digest, Sha256};

use super::page::{Kind, Page, Program, Step};
use super::programs::Programs;
use super::provenance::{hex, machine, sha256};
use super::{process, template};

/// Where steps write, below the root.
const FOLDER: &str = "target/realo/measured";
/// Where what steps print is kept, and a key of what they were made from.
const KEPT: &str = ".steps";
/// Folders whose files any step may read.
const READ: [&str; 2] = ["dataflows", "models"];

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
    reads: Vec<String>,
}

/// The commands of a page.
pub struct Plan {
    /// In the order in which they run.
    pub jobs: Vec<Job>,
    /// Folder of the page, relative to the root.
    folder: String,
}

impl Plan {
    /// The commands of the page `name`.
    ///
    /// # Errors
    /// A placeholder without a value.
    pub fn new(name: &str, page: &Page) -> Result<Self> {
        let folder = format!("{FOLDER}/{name}");
        let mut plan = Plan {
            jobs: Vec::new(),
            folder,
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

    /// Where a step writes, relative to the root.
    pub fn place(&self, step: &str) -> String {
        format!("{}/{step}", self.folder)
    }

    /// What a step writes: a file or folder for each of its commands.
    fn outputs<'a>(&'a self, step: &'a str) -> impl Iterator<Item = &'a String> {
        let jobs = self.jobs.iter().filter(move |job| job.step == step);
        jobs.map(|job| &job.output)
    }

    /// Runs the commands whose outputs are not there, or were made from something else.
    ///
    /// # Errors
    /// A command that failed.
    pub fn run(&self, page: &Page, programs: &Programs, root: &Path, fresh: bool) -> Result<()> {
        let mut shared = read_by_all(root)?;
        if page.kind == Kind::Times {
            shared += &machine().cpu;
        }
        let mut made: BTreeMap<&str, Vec<String>> = BTreeMap::new();
        for (at, job) in self.jobs.iter().enumerate() {
            let args: Vec<String> = job
                .args
                .iter()
                .map(|arg| with_environment(arg))
                .collect::<Result<_>>()?;
            let read = job
                .reads
                .iter()
                .flat_map(|step| made.get(step.as_str()).into_iter().flatten());
            let parts = [&shared, programs.digest(job.program)].map(str::to_string).into_iter();
            let key = key(parts.chain(args.iter().cloned()).chain(read.cloned()));
            if fresh || !self.is_made(job, root, &key) {
                let progress = format!("{} of {}", at + 1, self.jobs.len());
                eprintln!("realo-lab: {progress}: {} {}", job.program.name(), shortened(&args));
                self.make(job, programs, root, &args, &key)?;
            }
            let output = root.join(&job.output);
            let digest = if output.is_file() { sha256(&output)? } else { key };
            made.entry(&job.step).or_default().push(digest);
        }
        Ok(())
    }

    fn is_made(&self, job: &Job, root: &Path, key: &str) -> bool {
        let kept = self.kept(job, root).with_added_extension("key");
        let is_there = captures(job) || root.join(&job.output).exists();
        is_there && fs::read_to_string(kept).is_ok_and(|kept| kept == key)
    }

    fn make(&self, job: &Job, programs: &Programs, root: &Path, args: &[String], key: &str) -> Result<()> {
        let (output, kept) = (root.join(&job.output), self.kept(job, root));
        let kept_key = kept.with_added_extension("key");
        for folder in [output.parent(), kept.parent()].into_iter().flatten() {
            fs::create_dir_all(folder).wrap_err_with(|| folder.display().to_string())?;
        }
        // What an earlier version of the step made must not pass for this one's.
        let _ = fs::remove_file(&kept_key);
        let removed = if output.is_dir() {
            fs::remove_dir_all(&output)
        } else {
            fs::remove_file(&output)
        };
        if let Err(error) = removed.or_else(|error| if output.exists() { Err(error) } else { Ok(()) }) {
            return Err(error).wrap_err_with(|| output.display().to_string());
        }
        process::run(programs.path(job.program), args, root, &kept)?;
        if !captures(job) && !output.exists() {
            return Err(eyre!("step `{}` did not write {}", job.step, job.output));
        }
        fs::write(&kept_key, key).wrap_err_with(|| kept_key.display().to_string())
    }

    /// Where what a command prints is kept, without the ending.
    fn kept(&self, job: &Job, root: &Path) -> PathBuf {
        let value = job.value.map_or(String::new(), |value| format!(".{value}"));
        root.join(&self.folder).join(KEPT).join(format!("{}{value}", job.step))
    }

    /// What the only command of a step printed.
    pub fn printed(&self, job: &Job, root: &Path) -> PathBuf {
        self.kept(job, root).with_added_extension("stdout")
    }
}

/// Whether what counts of a command is what it prints.
pub fn captures(job: &Job) -> bool {
    job.args.iter().any(|arg| arg == "--json")
}

/// An argument with the values of variables of the environment.
fn with_environment(arg: &str) -> Result<String> {
    template::fill(arg, |name| std::env::var(template::variable(name)?).ok())
}

/// A command for a progress line, which many logs would fill.
fn shortened(args: &[String]) -> String {
    const LONGEST: usize = 100;
    let text = args.join(" ");
    match text.char_indices().nth(LONGEST) {
        Some((at, _)) => format!("{} …", &text[..at]),
        None => text,
    }
}

/// A digest of the files that any step may read.
fn read_by_all(root: &Path) -> Result<String> {
    let mut files = Vec::new();
    for folder in READ {
        add_files(&root.join(folder), &mut files)?;
    }
    files.sort();
    let digests: Result<Vec<String>> = files.iter().map(|file| sha256(file)).collect();
    let names = files.iter().map(|file| file.display().to_string());
    Ok(key(names.chain(digests?)))
}

/// The files below a folder; links to programs and results of runs are not among them.
fn add_files(folder: &Path, files: &mut Vec<PathBuf>) -> Result<()> {
    let entries = fs::read_dir(folder).wrap_err_with(|| folder.display().to_string())?;
    for entry in entries {
        let entry = entry?;
        let kind = entry.file_type()?;
        if kind.is_dir() && entry.file_name() != "out" {
            add_files(&entry.path(), files)?;
        } else if kind.is_file() {
            files.push(entry.path());
        }
    }
    Ok(())
}

/// One digest of texts in a row.
fn key(texts: impl Iterator<Item = String>) -> String {
    let mut hash = Sha256::new();
    for text in texts {
        hash.update((text.len() as u64).to_le_bytes());
        hash.update(text);
    }
    hex(&hash.finalize())
}

#[cfg(test)]
mod tests;

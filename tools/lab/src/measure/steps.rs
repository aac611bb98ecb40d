//! Runs the commands of a page, unless what they wrote is still good.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, ensure};
use sha2::{Digest, Sha256};

use super::page::Kind;
use super::plan::{Job, Plan, captures};
use super::programs::Programs;
use super::provenance::{hex, machine, sha256};
use super::{process, template};

/// Folders whose files any step may read, beside the files that it names.
const READ: [&str; 3] = ["dataflows/modules", "dataflows/types", "models"];

/// The commands of a page, and what they need to run.
pub struct Runner<'a> {
    /// The commands.
    pub plan: &'a Plan,
    /// What they start.
    pub programs: &'a Programs,
    /// The folder that they run in.
    pub root: &'a Path,
}

impl Runner<'_> {
    /// Runs the commands whose outputs are not there, or were made from something else.
    ///
    /// # Errors
    /// A command that failed.
    pub fn run(&self, kind: Kind, fresh: bool) -> Result<()> {
        let mut shared = read_by_all(self.root)?;
        if kind == Kind::Times {
            shared += &machine().cpu;
        }
        let mut made: BTreeMap<&str, Vec<String>> = BTreeMap::new();
        for (at, job) in self.plan.jobs.iter().enumerate() {
            let args: Result<Vec<String>> = job.args.iter().map(|arg| with_environment(arg)).collect();
            let args = args?;
            let mut texts = vec![
                shared.clone(),
                self.programs.digest(job.program).into(),
                job.output.clone(),
            ];
            texts.extend(args.iter().cloned());
            let named = args.iter().map(|arg| self.root.join(arg)).filter(|path| path.is_file());
            let own = |path: &PathBuf| !path.starts_with(self.root.join("target"));
            for file in named.filter(own) {
                texts.push(sha256(&file)?);
            }
            texts.extend(job.reads.iter().flat_map(|step| made[step.as_str()].iter().cloned()));
            let key = key(&texts);
            if fresh || !self.is_made(job, &key) {
                let (at, all) = (at + 1, self.plan.jobs.len());
                eprintln!("realo-lab: {at} of {all}: {} {}", job.program.name(), shortened(&args));
                self.make(job, &args, &key)?;
            }
            // A file that came out the same changes nothing for those who read it.
            let output = self.root.join(&job.output);
            let digest = if output.is_file() { sha256(&output)? } else { key };
            made.entry(&job.step).or_default().push(digest);
        }
        Ok(())
    }

    fn is_made(&self, job: &Job, key: &str) -> bool {
        let kept = self.plan.kept(job, self.root).with_added_extension("key");
        self.written(job).exists() && fs::read_to_string(kept).is_ok_and(|kept| kept == key)
    }

    /// What a command wrote, or printed.
    fn written(&self, job: &Job) -> PathBuf {
        match captures(job) {
            true => self.plan.printed(job, self.root),
            false => self.root.join(&job.output),
        }
    }

    fn make(&self, job: &Job, args: &[String], key: &str) -> Result<()> {
        let (output, kept) = (self.root.join(&job.output), self.plan.kept(job, self.root));
        let kept_key = kept.with_added_extension("key");
        for folder in [output.parent(), kept.parent()].into_iter().flatten() {
            fs::create_dir_all(folder).wrap_err_with(|| folder.display().to_string())?;
        }
        // What an earlier version of the step made must not pass for this one's.
        for path in [&kept_key, &output] {
            remove(path).wrap_err_with(|| path.display().to_string())?;
        }
        process::run(self.programs.path(job.program), args, self.root, &kept)?;
        ensure!(
            self.written(job).exists(),
            "step `{}` did not write {}",
            job.step,
            job.output
        );
        fs::write(&kept_key, key).wrap_err_with(|| kept_key.display().to_string())
    }
}

/// Removes a file or folder, if it is there.
fn remove(path: &Path) -> std::io::Result<()> {
    match path.is_dir() {
        true => fs::remove_dir_all(path),
        false if path.exists() => fs::remove_file(path),
        false => Ok(()),
    }
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
    let names = files.iter().map(|file| file.strip_prefix(root).unwrap_or(file));
    let mut texts: Vec<String> = names.map(|name| name.display().to_string()).collect();
    texts.extend(digests?);
    Ok(key(&texts))
}

/// The files below a folder; what is written for readers is not among them.
fn add_files(folder: &Path, files: &mut Vec<PathBuf>) -> Result<()> {
    let entries = fs::read_dir(folder).wrap_err_with(|| folder.display().to_string())?;
    for entry in entries {
        let path = entry?.path();
        if path.is_dir() {
            add_files(&path, files)?;
        } else if path.extension().is_none_or(|extension| extension != "md") {
            files.push(path);
        }
    }
    Ok(())
}

/// One digest of texts in a row.
fn key(texts: &[String]) -> String {
    let mut hash = Sha256::new();
    for text in texts {
        hash.update((text.len() as u64).to_le_bytes());
        hash.update(text);
    }
    hex(&hash.finalize())
}

#[cfg(test)]
mod tests;

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
            let known = if fresh { None } else { self.made(job, &key) };
            let digest = match known {
                Some(digest) => digest,
                None => {
                    let (at, all) = (at + 1, self.plan.jobs.len());
                    eprintln!("realo-lab: {at} of {all}: {} {}", job.program.name(), shortened(&args));
                    self.make(job, &args, &key)?
                }
            };
            // A file that came out the same changes nothing for those who read it.
            let is_file = self.root.join(&job.output).is_file();
            made.entry(&job.step)
                .or_default()
                .push(if is_file { digest } else { key });
        }
        Ok(())
    }

    /// The digest of what a command wrote, if it was made from the same and is still what it was.
    fn made(&self, job: &Job, key: &str) -> Option<String> {
        let kept = fs::read_to_string(self.key_file(job)).ok()?;
        let (_, digest) = kept.split_once(' ').filter(|(known, _)| *known == key)?;
        let written = self.written(job);
        if !written.exists() {
            return None;
        }
        let is_same = self.digest(job).is_ok_and(|found| found == digest);
        if !is_same {
            let written = written.display();
            eprintln!(
                "realo-lab: {written}: somebody changed this result after it was measured, so it is measured anew"
            );
        }
        is_same.then(|| digest.into())
    }

    /// Where it is kept what a command read, and what came of it.
    fn key_file(&self, job: &Job) -> PathBuf {
        self.plan.kept(job, self.root).with_added_extension("key")
    }

    /// A digest of all that a command wrote, and printed if that counts.
    fn digest(&self, job: &Job) -> Result<String> {
        let output = Some(self.root.join(&job.output)).filter(|output| output.exists());
        let printed = captures(job).then(|| self.plan.printed(job, self.root));
        let digests: Result<Vec<String>> = output.iter().chain(&printed).map(|path| digest_of(path)).collect();
        Ok(match &digests?[..] {
            [one] => one.clone(),
            several => key(several),
        })
    }

    /// What a command wrote, or printed.
    fn written(&self, job: &Job) -> PathBuf {
        match captures(job) {
            true => self.plan.printed(job, self.root),
            false => self.root.join(&job.output),
        }
    }

    /// Runs a command; gives the digest of what it wrote.
    fn make(&self, job: &Job, args: &[String], key: &str) -> Result<String> {
        let (output, kept) = (self.root.join(&job.output), self.plan.kept(job, self.root));
        let kept_key = self.key_file(job);
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
        let digest = self.digest(job)?;
        fs::write(&kept_key, format!("{key} {digest}")).wrap_err_with(|| kept_key.display().to_string())?;
        Ok(digest)
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

/// A digest of the files that any step may read; what is written for readers is not among them.
fn read_by_all(root: &Path) -> Result<String> {
    let mut files = Vec::new();
    for folder in READ {
        add_files(&root.join(folder), &mut files)?;
    }
    files.retain(|file| file.extension().is_none_or(|extension| extension != "md"));
    digest_of_all(files, root)
}

/// A digest of a file, or of all files in a folder.
fn digest_of(path: &Path) -> Result<String> {
    if !path.is_dir() {
        return sha256(path);
    }
    let mut files = Vec::new();
    add_files(path, &mut files)?;
    digest_of_all(files, path)
}

/// A digest of names and contents.
fn digest_of_all(mut files: Vec<PathBuf>, root: &Path) -> Result<String> {
    files.sort();
    let digests: Result<Vec<String>> = files.iter().map(|file| sha256(file)).collect();
    let names = files.iter().map(|file| file.strip_prefix(root).unwrap_or(file));
    let mut texts: Vec<String> = names.map(|name| name.display().to_string()).collect();
    texts.extend(digests?);
    Ok(key(&texts))
}

/// The files below a folder.
fn add_files(folder: &Path, files: &mut Vec<PathBuf>) -> Result<()> {
    let entries = fs::read_dir(folder).wrap_err_with(|| folder.display().to_string())?;
    for entry in entries {
        let path = entry?.path();
        match path.is_dir() {
            true => add_files(&path, files)?,
            false => files.push(path),
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

//! How a command of many runs begins, goes on and ends: what it says, and what it does with shards.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Duration;

use eyre::{Report, Result, WrapErr, bail, eyre};
pub use realo_campaign::{Earlier, Folder, FolderError, Item, Plan, PlanError, Shard, Task, digest};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::progress::duration;
use crate::{Progress, program, signals};

/// Names in a message at most.
const NAMED: usize = 5;

/// Which runs of a plan are made here, and how many at a time.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct Parts {
    /// Runs at a time [default: one for each core]
    #[arg(long, value_name = "COUNT")]
    pub jobs: Option<usize>,
    /// Only a part of the runs, as 3/16: several machines share them, each into a folder of its own
    #[arg(long, value_name = "NUMBER/COUNT")]
    pub shard: Option<Shard>,
    /// Folders of shards: takes over what they have done, and runs nothing
    #[arg(long, value_name = "DIR", num_args = 1.., conflicts_with = "shard")]
    pub merge: Vec<PathBuf>,
}

/// The runs of a plan, and where their results are.
pub struct Campaign<'a> {
    plan: &'a Plan,
    folder: Folder,
    jobs: usize,
    /// Items to run here and now.
    left: Vec<usize>,
    /// Whether they are made again beside what is there, which stays until they are done.
    anew: bool,
    /// Tasks that the time of the first says nothing about, and what they are.
    apart: Option<(usize, String)>,
}

/// How the runs ended.
#[derive(Debug, Default)]
pub struct Ended {
    /// The runs that failed, and why.
    pub failed: Vec<(String, Report)>,
    /// Runs that a signal kept from their end.
    pub not_run: usize,
}

impl<'a> Campaign<'a> {
    /// Opens the folder of a plan, merges shards, and says how many runs there are and how many are done.
    ///
    /// # Errors
    /// A folder or shard of another plan, with the value that differs; no job at a time.
    pub fn open(path: &Path, plan: &'a Plan, parts: &Parts) -> Result<Self> {
        let jobs = jobs(parts)?;
        let folder = merged(path, plan, &parts.merge)?;
        let shard = parts.shard.unwrap_or_default();
        let (mut done, mut left, mut changed) = (0, Vec::new(), Vec::new());
        for at in shard.items(plan.items.len()) {
            let item = &plan.items[at];
            match folder.earlier::<Value>(item)? {
                Earlier::Done(_) => done += 1,
                Earlier::None => left.push(at),
                Earlier::Changed(difference) => {
                    left.push(at);
                    changed.push(format!("{} ({difference})", item.key));
                }
            }
        }
        if !changed.is_empty() {
            say(&format!("run again, because something has changed: {}", few(&changed)));
        }
        if !parts.merge.is_empty() && !left.is_empty() {
            let (are, them) = if left.len() == 1 { ("is", "it") } else { ("are", "them") };
            say(&format!(
                "{} {are} in none of these folders; the same command without --merge runs {them}",
                runs(left.len())
            ));
            left.clear();
        }
        let of_shard = if shard.is_all() {
            String::new()
        } else {
            format!(" in shard {shard}")
        };
        let all = shard.items(plan.items.len()).len();
        say(&format!(
            "{}{of_shard}, {done} done already, {} to run",
            runs(all),
            left.len()
        ));
        Ok(Campaign {
            plan,
            folder,
            jobs,
            left,
            anew: false,
            apart: None,
        })
    }

    /// Opens the folder of a plan to make some items, all of them again: what is there of them stays until they are done, and all
    /// else stays as it is.
    ///
    /// # Errors
    /// A folder of another plan, with the value that differs; no job at a time.
    pub fn open_anew(path: &Path, plan: &'a Plan, parts: &Parts, is_chosen: impl Fn(&Item) -> bool) -> Result<Self> {
        let jobs = jobs(parts)?;
        let folder = Folder::open(path, plan)?;
        let left: Vec<usize> = (0..plan.items.len()).filter(|at| is_chosen(&plan.items[*at])).collect();
        let mut there = 0;
        for at in &left {
            there += usize::from(folder.earlier::<Value>(&plan.items[*at])? != Earlier::None);
        }
        say(&format!(
            "{} of {} to make, {there} of them made before and made anew",
            runs(left.len()),
            plan.items.len()
        ));
        Ok(Campaign {
            plan,
            folder,
            jobs,
            left,
            anew: true,
            apart: None,
        })
    }

    /// So many tasks are of another kind: the time of the first run says nothing about them, these words do.
    pub fn set_apart(&mut self, tasks: usize, words: String) {
        self.apart = (tasks > 0).then_some((tasks, words));
    }

    /// The items that are to run, by their numbers in the plan.
    pub fn left(&self) -> &[usize] {
        &self.left
    }

    /// How many run at a time.
    pub fn jobs(&self) -> usize {
        self.jobs
    }

    /// The items that are to run, as tasks that wait for nobody.
    pub fn tasks(&self) -> Vec<Task> {
        let task = |item: &usize| Task {
            item: *item,
            after: BTreeSet::new(),
        };
        self.left.iter().map(task).collect()
    }

    /// Has tasks run, which are those of [`Campaign::tasks`] in any order. `work` makes the run of an item, with its files in the
    /// folder, and gives what is kept in its record. Says after the first how long all take, and each failure at once.
    pub fn run<T: Serialize>(
        &self,
        what: &str,
        tasks: &[Task],
        work: impl Fn(&Item, &Path) -> Result<T> + Sync,
    ) -> Ended {
        let mut ended = Ended::default();
        if tasks.is_empty() {
            return ended;
        }
        let progress = Progress::new(what, "runs", Some(tasks.len() as f64));
        let one = |task: &Task| -> Result<()> {
            let item = &self.plan.items[task.item];
            if self.anew {
                let result = work(item, &self.folder.begin_anew(item)?)?;
                return Ok(self.folder.replace(item, &result)?);
            }
            let result = work(item, &self.folder.begin(item)?)?;
            Ok(self.folder.finish(item, &result)?)
        };
        let mut heard = 0;
        realo_campaign::execute(
            tasks,
            self.jobs,
            || signals::first().is_some(),
            one,
            |task| {
                heard += 1;
                progress.add(1.0);
                let key = &self.plan.items[tasks[task.task].item].key;
                match task.result {
                    Ok(()) if heard == 1 && tasks.len() > 1 => {
                        progress.beside(|| say(&self.estimate(task.took)));
                    }
                    Ok(()) => {}
                    // It failed because of the signal.
                    Err(_) if signals::first().is_some() => heard -= 1,
                    Err(reason) => {
                        progress.beside(|| say(&format!("failed: {key}: {reason:#}")));
                        ended.failed.push((key.clone(), reason));
                    }
                }
            },
        );
        progress.finish();
        ended.not_run = tasks.len() - heard;
        ended
    }

    fn estimate(&self, first: Duration) -> String {
        let (apart, words) = match &self.apart {
            Some((tasks, words)) => (*tasks, format!("; {words}")),
            None => (0, String::new()),
        };
        let all = self.left.len() - apart;
        let rounds = all.div_ceil(self.jobs) as f64;
        format!(
            "the first run took {:.1} s; all {all} take {} at most, {} at a time, and less where they share what they compute{words}",
            first.as_secs_f64(),
            duration(first.as_secs_f64() * rounds),
            self.jobs
        )
    }

    /// What is there of all runs of the plan, by their order; `None` for one that is not done.
    ///
    /// # Errors
    /// A record that cannot be read.
    pub fn results<T: DeserializeOwned>(&self) -> Result<Vec<Option<(PathBuf, T)>>> {
        let result = |item: &Item| {
            Ok(match self.folder.earlier(item)? {
                Earlier::Done(result) => Some((self.folder.of(item), result)),
                Earlier::Changed(_) | Earlier::None => None,
            })
        };
        self.plan.items.iter().map(result).collect()
    }
}

/// How many run at a time.
fn jobs(parts: &Parts) -> Result<usize> {
    if parts.jobs == Some(0) {
        bail!("--jobs: expected 1 or more, found 0");
    }
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    Ok(parts.jobs.unwrap_or(cores))
}

/// The folder of a plan with what shards have done. One that is refused is so before anything is written.
fn merged(path: &Path, plan: &Plan, merge: &[PathBuf]) -> Result<Folder> {
    let mut shards = Vec::new();
    for shard in merge {
        shards.push(Folder::of_shard(shard, plan).wrap_err("--merge")?);
    }
    if !shards.is_empty() {
        Folder::refuse_changed(path, &shards, plan).wrap_err("--merge")?;
    }
    let folder = Folder::open(path, plan)?;
    for (name, shard) in merge.iter().zip(&shards) {
        let taken = folder.merge(shard, plan).wrap_err("--merge")?;
        say(&format!(
            "{}: {taken} of {} taken",
            name.display(),
            runs(plan.items.len())
        ));
    }
    Ok(folder)
}

/// What helps where the files of a run that is done cannot be read.
pub fn remedy(folder: &Path) -> String {
    format!(
        "a run that is done cannot be read: remove its folder `{}`, and the same command makes it again",
        folder.display()
    )
}

/// So many runs, in words.
pub fn runs(count: usize) -> String {
    match count {
        1 => "1 run".into(),
        _ => format!("{count} runs"),
    }
}

/// The values of a plan by the names of the options that gave them; options without a value are left out.
pub fn values<'a>(options: impl IntoIterator<Item = (&'a str, String)>) -> BTreeMap<String, String> {
    let given = options.into_iter().filter(|(_, value)| !value.is_empty());
    given.map(|(name, value)| (name.to_string(), value)).collect()
}

/// The error of a command of which runs failed.
pub fn failed(ended: &Ended) -> Option<Report> {
    let names: Vec<String> = ended.failed.iter().map(|(key, _)| key.clone()).collect();
    (!names.is_empty()).then(|| {
        eyre!(
            "{} of the runs failed, the others are done: {}; the same command runs what is missing",
            names.len(),
            few(&names)
        )
    })
}

/// The first few names, and how many more there are.
fn few(names: &[String]) -> String {
    let first = names[..names.len().min(NAMED)].join("; ");
    match names.len().saturating_sub(NAMED) {
        0 => first,
        more => format!("{first} and {more} more"),
    }
}

fn say(line: &str) {
    eprintln!("{}: {line}", program::name());
}

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
        if parts.jobs == Some(0) {
            bail!("--jobs: expected 1 or more, found 0");
        }
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let folder = Folder::open(path, plan)?;
        for shard in &parts.merge {
            let of_shard = Folder::of_shard(shard, plan).wrap_err("--merge")?;
            let taken = folder.merge(&of_shard, plan).wrap_err("--merge")?;
            say(&format!(
                "{}: {taken} of {} runs taken",
                shard.display(),
                plan.items.len()
            ));
        }
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
            say(&format!(
                "{} runs are in none of these folders; the same command without --merge runs them",
                left.len()
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
            "{all} runs{of_shard}, {done} done already, {} to run",
            left.len()
        ));
        Ok(Campaign {
            plan,
            folder,
            jobs: parts.jobs.unwrap_or(cores),
            left,
        })
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
            let folder = self.folder.begin(item)?;
            let result = work(item, &folder)?;
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
                    Ok(()) if heard == 1 => {
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
        let rounds = self.left.len().div_ceil(self.jobs) as f64;
        format!(
            "the first run took {:.1} s; all {} take {} at most, {} at a time, and less where they share what they compute",
            first.as_secs_f64(),
            self.left.len(),
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

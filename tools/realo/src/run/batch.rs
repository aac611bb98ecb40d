//! The runs of a graph over its logs and egos: which are there already, which failed, and what the others came to.

use std::collections::{BTreeMap, BTreeSet};
use std::error::Error;
use std::fmt;

use eyre::{Report, Result, bail};
use realo_cli::signals::{self, Ending};
use realo_results::Run;

use super::folders::Folders;
use super::prepare::RunPlan;
use super::view::View;
use super::{Mode, realtime, replay, resume};

/// Names that a note has at most.
const NAMED: usize = 5;

/// A log, or a run over it, that failed.
#[derive(Debug)]
pub struct Failed {
    /// The log, or graph, log and ego.
    pub name: String,
    /// Why.
    pub reason: Report,
}

/// The logs that cannot be played, while others can.
#[derive(Debug, Default)]
pub struct Unplayable(Vec<Failed>);

impl Unplayable {
    /// What was asked of a log; `None`, and kept, where the log does not give it.
    pub fn check<T, E: Into<Report>>(&mut self, name: &str, result: Result<T, E>) -> Option<T> {
        let name = name.to_string();
        let failed = |reason: E| {
            self.0.push(Failed {
                name,
                reason: reason.into(),
            })
        };
        result.map_err(failed).ok()
    }
}

/// The runs of one graph.
pub struct Batch {
    plans: Vec<RunPlan>,
    /// Numbers of the plans that an earlier batch brought to their end.
    taken: BTreeSet<usize>,
    failed: Vec<Failed>,
    /// Names of those that a signal kept from results.
    unfinished: Vec<String>,
    /// Those that a signal ended after they had results, with how far they came.
    cut_short: Vec<String>,
}

/// Why a run that a signal ended gave no results.
#[derive(Debug)]
pub struct Unfinished {
    /// Graph, log and ego.
    pub name: String,
    /// What it had not done yet.
    pub reason: String,
}

impl Unfinished {
    /// A run that had not come to the end of its log.
    pub fn of(name: &str) -> Self {
        Unfinished {
            name: name.into(),
            reason: "it had not come to the end of its log".into(),
        }
    }
}

impl fmt::Display for Unfinished {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}: {}", self.name, self.reason)
    }
}

impl Error for Unfinished {}

impl Batch {
    /// The runs that were prepared, and the logs of which none could be.
    ///
    /// # Errors
    /// If no log can be played: what is the matter with each.
    pub fn new(plans: Vec<RunPlan>, Unplayable(failed): Unplayable) -> Result<Self> {
        if plans.is_empty() {
            return Err(all_failed(failed));
        }
        Ok(Batch {
            plans,
            taken: BTreeSet::new(),
            failed,
            unfinished: Vec::new(),
            cut_short: Vec::new(),
        })
    }

    /// All runs, those that are there already too.
    pub fn plans(&self) -> &[RunPlan] {
        &self.plans
    }

    /// The runs by themselves, and what could not be played, in words.
    pub fn into_parts(self) -> (Vec<RunPlan>, Vec<String>) {
        let failed = self.reasons();
        (self.plans, failed)
    }

    /// Claims the folders of the runs; with `resume` those stay as they are in which the same run has come to its end.
    ///
    /// # Errors
    /// As [`Folders::claim`].
    pub fn claim(&mut self, folders: &mut Folders, resume: bool) -> Result<()> {
        let mut changed = Vec::new();
        for (number, plan) in self.plans.iter().enumerate() {
            if resume {
                match resume::earlier(plan)? {
                    resume::Earlier::Same => {
                        self.taken.insert(number);
                        continue;
                    }
                    resume::Earlier::Other => changed.push(plan.name.as_str()),
                    resume::Earlier::None => {}
                }
            }
            folders.claim(&plan.out, &plan.recordings())?;
            plan.write_settings()?;
        }
        if resume {
            let (all, taken) = (self.plans.len(), self.taken.len());
            eprintln!(
                "realo: {taken} of {all} runs are complete and taken as they are, {} run now",
                all - taken
            );
        }
        if !changed.is_empty() {
            eprintln!(
                "realo: run again, because the graph, its settings, its files or the log have changed since: {}",
                changed.join("; ")
            );
        }
        Ok(())
    }

    /// Has the runs run that are not there yet, and reads what all came to. One that fails does not keep the others from
    /// running. `view` shows them.
    ///
    /// # Errors
    /// If every run failed: [`Unfinished`] where a signal ended one of them, and [`Batch::reasons`] has the others; results that
    /// cannot be read.
    pub fn run(&mut self, mode: Mode, rate: f64, view: Option<&View>) -> Result<Vec<Run>> {
        let open: Vec<usize> = (0..self.plans.len())
            .filter(|number| !self.taken.contains(number))
            .collect();
        let plans: Vec<&RunPlan> = open.iter().map(|number| &self.plans[*number]).collect();
        let ended: Vec<Result<()>> = match mode {
            Mode::Virtual => replay::all(&plans, view)?,
            Mode::Realtime => plans.iter().map(|plan| realtime::run(plan, rate, view)).collect(),
        };
        let mut failed = BTreeSet::new();
        let mut unfinished = None;
        for (number, ended) in open.into_iter().zip(ended) {
            let Err(reason) = ended else { continue };
            // A signal may come when all is written, and before the run has said so.
            if reason.is::<Unfinished>() && self.plans[number].out.join(realo_results::RESULT_FILE).is_file() {
                continue;
            }
            failed.insert(number);
            let name = self.plans[number].name.clone();
            match reason.is::<Unfinished>() {
                true => {
                    self.unfinished.push(name);
                    unfinished = unfinished.or(Some(reason));
                }
                false => self.failed.push(Failed { name, reason }),
            }
        }
        if failed.len() == self.plans.len() {
            return Err(unfinished.unwrap_or_else(|| all_failed(std::mem::take(&mut self.failed))));
        }
        let done = self
            .plans
            .iter()
            .enumerate()
            .filter(|(number, _)| !failed.contains(number));
        let mut runs = Vec::new();
        for (_, plan) in done {
            let run = realo_results::read_run(&plan.out)?;
            if run.result.ended_by.is_some() {
                let sweeps = run.result.frames.total as usize;
                self.cut_short.push(format!(
                    "{} after {} of its ego",
                    plan.name,
                    count(sweeps, "sweep", "sweeps")
                ));
            }
            runs.push(run);
        }
        Ok(runs)
    }

    /// Whether something is missing from what the runs came to, because of a log.
    pub fn is_partial(&self) -> bool {
        !self.failed.is_empty()
            || self.plans.iter().any(|plan| plan.truncated)
            || !same_content(self.plans.iter().map(RunPlan::log)).is_empty()
    }

    /// The signal that kept a run from its end.
    pub fn ended_by(&self) -> Option<Ending> {
        let all_ended = self.unfinished.is_empty() && self.cut_short.is_empty();
        signals::first().filter(|_| !all_ended)
    }

    /// What was not played, or not to its end, for who reads the results; nothing where all was.
    pub fn notes(&self) -> Vec<String> {
        let names: Vec<&str> = self.failed.iter().map(|failed| failed.name.as_str()).collect();
        let failed = (!names.is_empty()).then(|| {
            format!(
                "{} could not be played and {} not in these numbers: {}",
                count(names.len(), "run or log", "runs or logs"),
                are(names.len()),
                names.join("; ")
            )
        });
        let of_signal = self.ended_by().map(|ending| {
            let all = count(self.plans.len(), "run", "runs");
            let cut_short = (!self.cut_short.is_empty()).then(|| match self.plans.len() {
                1 => format!(
                    "{ending} ended the run early: these numbers are of what was played until then, {}",
                    few(&self.cut_short)
                ),
                _ => format!(
                    "{} of {all} {} ended by {ending} early, and what was played until then is in these numbers: {}",
                    self.cut_short.len(),
                    are(self.cut_short.len()),
                    few(&self.cut_short)
                ),
            });
            let unfinished = (!self.unfinished.is_empty()).then(|| {
                format!(
                    "{} of {all} had not come to the end of the log when {ending} ended the batch, and {} not in these numbers; the \
                     same command with --resume goes on: {}",
                    self.unfinished.len(),
                    are(self.unfinished.len()),
                    few(&self.unfinished)
                )
            });
            cut_short.into_iter().chain(unfinished)
        });
        let same = same_content(self.plans.iter().map(RunPlan::log));
        of_signal.into_iter().flatten().chain(failed).chain(same).collect()
    }

    /// The same with the reasons, a line for each.
    pub fn reasons(&self) -> Vec<String> {
        self.failed.iter().map(in_words).collect()
    }
}

/// A note for all logs that hold the same.
fn same_content<'a>(logs: impl Iterator<Item = (String, &'a str)>) -> Vec<String> {
    let mut names: BTreeMap<&str, BTreeSet<String>> = BTreeMap::new();
    for (name, hash) in logs {
        names.entry(hash).or_default().insert(name);
    }
    let several = names.into_values().filter(|names| names.len() > 1);
    let note = |names: BTreeSet<String>| {
        let names: Vec<String> = names.into_iter().map(|name| format!("`{name}`")).collect();
        let (last, first) = names.split_last().expect("there are several");
        format!(
            "the logs {} and {last} hold the same, but count as {}: the 95 % interval is too narrow; leave all but one out",
            first.join(", "),
            names.len()
        )
    };
    several.map(note).collect()
}

/// The first few names, and how many more there are.
fn few(names: &[String]) -> String {
    let first = names[..names.len().min(NAMED)].join("; ");
    match names.len().saturating_sub(NAMED) {
        0 => first,
        more => format!("{first} and {more} more"),
    }
}

fn are(number: usize) -> &'static str {
    if number == 1 { "is" } else { "are" }
}

/// A number with its noun.
pub(crate) fn count(number: usize, one: &str, several: &str) -> String {
    format!("{number} {}", if number == 1 { one } else { several })
}

fn in_words(failed: &Failed) -> String {
    let reason = format!("{:#}", failed.reason);
    match reason.contains(&failed.name) {
        true => reason,
        false => format!("{}: {reason}", failed.name),
    }
}

/// The error of runs of which none succeeded; of one run its own.
fn all_failed(mut failed: Vec<Failed>) -> Report {
    if failed.len() == 1 {
        return failed.remove(0).reason;
    }
    let all = failed.len();
    // What is wrong with all of them is said once.
    let reasons: BTreeSet<String> = failed.iter().map(|failed| format!("{:#}", failed.reason)).collect();
    let lines: Vec<String> = match reasons.len() {
        1 => reasons.into_iter().collect(),
        _ => failed.iter().map(in_words).collect(),
    };
    let error: Result<()> = (|| bail!("all {all} runs failed:\n  {}", lines.join("\n  ")))();
    error.expect_err("it was made an error")
}

#[cfg(test)]
mod tests {
    use eyre::eyre;

    use super::*;

    #[test]
    fn what_is_wrong_with_all_is_said_once_and_of_one_run_as_it_is() {
        let failed = |name: &str, reason: &str| Failed {
            name: name.into(),
            reason: eyre!("{reason}"),
        };
        let said = |failed: Vec<Failed>| all_failed(failed).to_string();
        assert_eq!(said(vec![failed("a", "a: junk")]), "a: junk");
        let same = said(vec![failed("a", "no ego"), failed("b", "no ego")]);
        assert_eq!(same, "all 2 runs failed:\n  no ego");
        let each = said(vec![failed("a", "a: junk"), failed("b", "cut")]);
        assert_eq!(each, "all 2 runs failed:\n  a: junk\n  b: cut");
    }

    #[test]
    fn logs_that_hold_the_same_are_named_once() {
        let logs = [("a", "1"), ("a", "1"), ("b", "2"), ("c", "1")];
        let notes = same_content(logs.into_iter().map(|(name, hash)| (name.to_string(), hash)));
        assert_eq!(notes.len(), 1);
        assert!(
            notes[0].starts_with("the logs `a` and `c` hold the same, but count as 2: "),
            "{notes:?}"
        );
    }

    #[test]
    fn a_log_that_gives_nothing_is_kept_with_its_reason() {
        let mut unplayable = Unplayable::default();
        assert_eq!(unplayable.check("a", Ok::<_, Report>(3)), Some(3));
        assert_eq!(unplayable.check("b", Err::<u8, _>(eyre!("junk"))), None);
        let error = Batch::new(Vec::new(), unplayable).err().expect("nothing is left");
        assert_eq!(error.to_string(), "junk");
    }
}

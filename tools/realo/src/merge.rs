//! `realo merge`: the logs of several agents as one.

use std::path::PathBuf;

use eyre::{Result, bail, eyre};
use realo_cli::{Force, Outcome, Output, Progress, unfinished};
use realo_logs::{Log, Merge};
use realo_schemas::{Nanos, to_millis};

/// Joins the logs that several agents recorded of one drive, by the clock of the first
#[derive(clap::Args)]
pub struct Args {
    /// Logs of agents that differ in name
    #[arg(required = true, num_args = 2..)]
    logs: Vec<PathBuf>,
    /// Where the merged log goes
    #[arg(short, long)]
    output: PathBuf,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    force: Force,
    /// Leave out what was recorded before or after the time that all logs have
    #[arg(long)]
    common: bool,
    /// What an agent's clock is ahead of the first log's, ms [default: what the agents' radios found]
    #[arg(long, value_name = "AGENT=MS", value_parser = clock)]
    clock: Vec<(String, Nanos)>,
}

/// Seconds that logs may differ by at their ends without a word.
const APART: f64 = 0.5;

fn clock(text: &str) -> Result<(String, Nanos), String> {
    let wrong = || format!("expected AGENT=MS, such as rsu1=0, found `{text}`");
    let (agent, ahead) = text.split_once('=').ok_or_else(wrong)?;
    let ahead: f64 = ahead.parse().map_err(|_| wrong())?;
    match !agent.is_empty() && ahead.is_finite() && ahead.abs() <= 1e12 {
        true => Ok((agent.into(), (ahead * 1e6).round() as Nanos)),
        false => Err(wrong()),
    }
}

/// Merges, and says what was moved; of a log that was cut what is left is merged, and the command ends with 3.
pub fn main(args: &Args) -> Result<Outcome> {
    args.force.check(&args.output, Output::Log)?;
    unfinished::end_with_signals(&args.output);
    let logs: Vec<Log> = args.logs.iter().map(Log::open).collect::<Result<_, _>>()?;
    let first = &logs[0];
    check_clocks(args, first)?;
    let mut outcome = Outcome::Complete;
    for log in &logs {
        if let Some(cut) = log.truncation() {
            eprintln!("realo: {}: {cut}", log.path().display());
            outcome = Outcome::Partial;
        }
    }
    let mut merge = Merge::new(&logs, &args.clock.iter().cloned().collect())?;
    for (log, moved) in logs.iter().zip(merge.moved()).skip(1) {
        let [first, last] = moved.by.map(to_millis);
        let path = log.path().display();
        match moved.by {
            [0, 0] => println!("{path}: its clock is that of the first log"),
            _ => println!(
                "{path}: moved by {first:.2} ms at its beginning and {last:.2} ms at its end, ± {:.2}",
                to_millis(moved.uncertainty)
            ),
        }
    }
    let [common, any] = merge
        .spans()
        .map(|[from, until]| (to_millis(until - from) * 1e-3).max(0.0));
    if args.common {
        merge = merge.of_common_time()?;
    } else if any - common > APART {
        println!(
            "{common:.1} of {any:.1} s are in all logs; `realo info` names what is missing outside, --common leaves the rest out"
        );
    }
    let progress = Progress::new("merging", "s of the logs", Some(0.0));
    merge.write_with(&args.output, |done, all| progress.of(done, all))?;
    unfinished::done(&args.output);
    progress.finish();
    for log in &logs {
        report_left_out(log);
    }
    let merged = Log::open(&args.output)?;
    let (from, until) = merged
        .span()
        .ok_or_else(|| eyre!("{}: no messages", args.output.display()))?;
    println!(
        "{}: {} agents, {:.1} s",
        args.output.display(),
        merged.info().agents.len(),
        to_millis(until - from) * 1e-3
    );
    Ok(outcome)
}

/// Refuses two clocks of one agent, and one of an agent of the first log.
fn check_clocks(args: &Args, first: &Log) -> Result<()> {
    let agents = || args.clock.iter().map(|(agent, _)| agent);
    if let Some((_, twice)) = agents()
        .enumerate()
        .find(|(at, agent)| agents().take(*at).any(|known| known == *agent))
    {
        bail!("--clock {twice}: expected one for each agent, found two; say which one is meant");
    }
    if let Some((agent, _)) = args.clock.iter().find(|(agent, _)| first.info().agent(agent).is_some()) {
        let path = first.path().display();
        bail!(
            "--clock {agent}: {path} is the first log, by whose clock all are merged: say what the others are ahead of it"
        );
    }
    Ok(())
}

/// Reports the topics of a log that its copy leaves out.
pub fn report_left_out(log: &Log) {
    let left: Vec<String> = log
        .not_read()
        .into_iter()
        .map(|(topic, n)| format!("{topic} ({n} messages)"))
        .collect();
    if !left.is_empty() {
        let path = log.path().display();
        eprintln!(
            "realo: {path}: topics that realo does not read were left out: {}",
            left.join(", ")
        );
    }
}

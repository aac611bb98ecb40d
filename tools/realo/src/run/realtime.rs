//! Runs on dora.

use crate::roles;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use eyre::{Report, Result, WrapErr, bail};
use realo_cli::Progress;
use realo_cli::signals::{self, Ending};
use realo_graph::FlatGraph;
use realo_host::TAP_VARIABLE;
use realo_host::dora::{FOLDER_VARIABLE, OVERLAY_VARIABLE, POOL_VARIABLE, Slow};
use realo_operator::Durations;
use realo_results::{Run, RunProgress};

use super::batch::Unfinished;
use super::nodes::{argument, deciding};
use super::prepare::RunPlan;
use super::tether::Tether;
use super::view::{Showing, View};
use super::{Mode, dora, machine, pace};

/// From a signal to the end of all processes at most; what is left then is killed.
const TO_END: Duration = Duration::from_millis(2600);
/// From a node's failure to the end of all others: they say meanwhile what they have to say.
const TO_TELL: Duration = Duration::from_millis(1500);

/// So long after the end of the log a run that goes on says why.
const TO_FINISH: Duration = Duration::from_secs(15);
/// It says it again after so long.
const AGAIN: Duration = Duration::from_secs(30);
/// A graph may take so long until all its nodes are ready.
const TO_BEGIN: Duration = Duration::from_secs(60);

/// What dora runs.
#[derive(Clone, Copy)]
pub struct Started<'a> {
    /// What is shown while it runs.
    pub name: &'a str,
    /// The graph with all its arguments.
    pub graph: &'a FlatGraph,
    /// Where its results go.
    pub out: &'a Path,
    /// Length of what is played, s; `None`: it goes on until it is ended.
    pub seconds: Option<f64>,
}

impl<'a> From<&'a RunPlan> for Started<'a> {
    fn from(plan: &'a RunPlan) -> Self {
        Started {
            name: &plan.name,
            graph: &plan.graph,
            out: &plan.out,
            seconds: Some(plan.seconds),
        }
    }
}

/// Has dora run a plan and checks that the run is complete. `view` shows it.
///
/// # Errors
/// Which node failed, or what is missing; dora's own words are in `dora.log`.
pub fn run(plan: &RunPlan, rate: f64, view: Option<&View>) -> Result<()> {
    if signals::first().is_some() {
        return Err(Unfinished::of(&plan.name).into());
    }
    let scene = view.map(|view| view.scene(plan, Mode::Realtime)).transpose()?;
    let showing = scene.map(|scene| scene.show_processes(rate)).transpose()?;
    start(&plan.into(), rate, showing)
}

/// Has dora run a graph until it ends or a signal ends it, and checks that it is complete.
///
/// # Errors
/// As [`run`].
pub fn start(plan: &Started, rate: f64, showing: Option<Showing>) -> Result<()> {
    let memory = machine::prepare(plan.name, plan.graph)?;
    let dora = dora::find()?;
    let graph = write_graph(plan)?;
    let overlay = graph.with_file_name("zenoh.json5");
    fs::write(&overlay, memory.overlay())?;
    let log_path = plan.out.join("dora.log");
    let log = File::create(&log_path).wrap_err_with(|| format!("{}", log_path.display()))?;
    let output = log.try_clone()?;
    let told = showing.as_ref().map(Showing::told).transpose()?.flatten();
    let (tether, child) = Tether::start(&dora, |command| {
        command
            .arg("run")
            .arg(&graph)
            .env(OVERLAY_VARIABLE, &overlay)
            .env(FOLDER_VARIABLE, plan.graph.file.parent().unwrap_or(Path::new("/")))
            .stdin(Stdio::null())
            .stdout(output)
            .stderr(log);
        if let Some(pool) = memory.pool() {
            command.env(POOL_VARIABLE, pool.to_string());
        }
        if let Some(told) = told {
            command.env(TAP_VARIABLE, told);
        }
    })?;
    let ended = watch(tether, child, plan, rate, &log_path)?;
    drop(showing);
    // What was killed could not do it.
    machine::free_orphans();
    match signals::first() {
        Some(ending) => conclude(plan, ending, ended.killed),
        None => check(plan, &ended, &log_path),
    }
}

/// How dora ended.
struct Ended {
    status: ExitStatus,
    /// The first node that failed, and how.
    culprit: Option<(String, String)>,
    /// Something of the run was left when its time to end was over.
    killed: bool,
}

/// Says in a run's result what ended it.
fn conclude(plan: &Started, ending: Ending, killed: bool) -> Result<()> {
    if !plan.out.join(realo_results::RESULT_FILE).exists() {
        return Err(no_results(
            plan,
            &match killed {
                true => format!(
                    "the graph did not end within {:.1} s, and was killed",
                    TO_END.as_secs_f64()
                ),
                false => "the run had not begun".into(),
            },
        ));
    }
    let mut run = realo_results::read_run(plan.out)?;
    if has_nothing(plan, &run) {
        // An earlier run's results are worth more.
        realo_results::claim(plan.out)?;
        return Err(no_results(plan, "it ended before the first sweep"));
    }
    run.result.ended_by = Some(ending.to_string());
    let note = format!("{ending} ended the run early: these numbers are of what was played until then");
    run.result.notes.insert(0, note);
    Ok(realo_results::write_result(plan.out, &run.result)?)
}

/// The error of a run that a signal ended without results.
fn no_results(plan: &Started, why: &str) -> Report {
    let unfinished = Unfinished {
        name: plan.name.into(),
        reason: format!("no results: {why}"),
    };
    unfinished.into()
}

/// Whether a run that a signal ended had no sweep of the ego yet; where none is scored, whether nothing had been played.
fn has_nothing(plan: &Started, run: &Run) -> bool {
    let mut results = deciding(plan.graph, roles::OUT);
    let (frames, samples) = (&run.result.frames, &run.timing.samples);
    // What comes from outside has no truth, and boxes without it are not counted as frames.
    let is_played = plan.seconds.is_some();
    match is_played && results.any(|node| ["boxes", "truth"].iter().any(|port| node.inputs.contains_key(*port))) {
        true => frames.total + frames.processed == 0,
        false => {
            let mut calls = samples.compute.values().flat_map(BTreeMap::values);
            let mut sent = samples.late.values();
            calls.all(is_empty) && sent.all(is_empty) && run.result.peers.is_empty()
        }
    }
}

fn is_empty(durations: &Durations) -> bool {
    durations.count() == 0
}

/// Writes the expanded graph with this very program behind every stage, and its types beside it.
fn write_graph(plan: &Started) -> Result<PathBuf> {
    let folder = std::path::absolute(plan.out.join("graph"))?;
    let mut graph = plan.graph.clone();
    graph.host_in(&std::env::current_exe()?);
    copy_folder(&graph.types(), &folder.join("types"))?;
    let path = folder.join("graph.yml");
    fs::write(&path, graph.to_yaml()?).wrap_err_with(|| format!("{}", path.display()))?;
    Ok(path)
}

fn copy_folder(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir_all(to).wrap_err_with(|| format!("{}", to.display()))?;
    if !from.is_dir() {
        return Ok(());
    }
    for entry in fs::read_dir(from).wrap_err_with(|| format!("{}", from.display()))? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            copy_folder(&entry.path(), &target)?;
        } else {
            fs::copy(entry.path(), &target).wrap_err_with(|| format!("{}", target.display()))?;
        }
    }
    Ok(())
}

fn watch(mut tether: Tether, mut child: Child, plan: &Started, rate: f64, log: &Path) -> Result<Ended> {
    let seconds = plan.seconds.map(|seconds| (seconds * repeats(plan) / rate).ceil());
    let progress = Progress::new(plan.name, "s", seconds);
    let begun = Instant::now();
    let mut follower = Follower::new(log, rate);
    let (mut asked, mut failed): (Option<Instant>, Option<Instant>) = (None, None);
    let mut killed = false;
    let mut remind = seconds.map(|seconds| Duration::from_secs_f64(seconds) + TO_FINISH);
    while child.try_wait()?.is_none() {
        if asked.is_none() && signals::first().is_some() {
            tether.end();
            asked = Some(Instant::now());
        }
        for line in follower.read() {
            progress.beside(|| eprintln!("realo: {}: {line}", plan.name));
        }
        if let Some(live) = follower.live.take() {
            progress.say(live.short());
        }
        if follower.culprit.is_some() {
            failed.get_or_insert_with(Instant::now);
        }
        let overdue = |since: Option<Instant>, patience| since.is_some_and(|since| since.elapsed() > patience);
        if overdue(asked, TO_END) || signals::came_again() || overdue(failed, TO_TELL) {
            killed = true;
            break;
        }
        let playing = follower.ready.unwrap_or(begun + TO_BEGIN);
        if let (None, Some(due), Some(seconds)) = (asked, remind.filter(|due| playing.elapsed() > *due), seconds) {
            let late = playing.elapsed().as_secs_f64() - seconds;
            progress.beside(|| eprintln!("realo: {}: {}", plan.name, not_ended(late, &follower.running)));
            remind = Some(due + AGAIN);
        }
        let elapsed = begun.elapsed().as_secs() as f64;
        progress.set(seconds.map_or(elapsed, |seconds| elapsed.min(seconds)));
        std::thread::sleep(Duration::from_millis(50));
    }
    // Nothing is left running, however the run ended.
    tether.kill(&mut child);
    follower.read();
    progress.finish();
    Ok(Ended {
        status: child.wait()?,
        culprit: follower.culprit,
        killed,
    })
}

/// How often the log is played.
fn repeats(plan: &Started) -> f64 {
    let players = deciding(plan.graph, roles::LOG);
    let repeats = players.filter_map(|node| argument(node, "repeat")?.parse::<f64>().ok());
    repeats.fold(1.0, f64::max)
}

/// Which nodes a run still waits for.
fn not_ended(seconds: f64, running: &BTreeMap<String, u32>) -> String {
    let named = running.iter().map(|(node, process)| match is_stopped(*process) {
        true => format!("{node} (stopped)"),
        false => node.clone(),
    });
    format!(
        "the log ended {seconds:.0} s ago, and these nodes have not: {}; a slow stage may still work; Ctrl-C ends the run",
        named.collect::<Vec<_>>().join(", ")
    )
}

/// Whether a signal has stopped a process.
fn is_stopped(process: u32) -> bool {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    let state = stat.rsplit_once(") ").map_or("", |(_, rest)| rest);
    state.starts_with(['T', 't'])
}

fn check(plan: &Started, ended: &Ended, log: &Path) -> Result<()> {
    let text = plain(&fs::read_to_string(log).unwrap_or_default());
    if let Some((node, how)) = &ended.culprit {
        let prefix = format!("{node}: ");
        // Others failed because of it.
        let own = culprits(&text).into_iter().filter(|said| said.starts_with(&prefix));
        let said: String = own.map(|line| format!("\n  {line}")).collect();
        bail!(
            "{}: the run failed: node `{node}` {how}{said}\n  see {}",
            plan.name,
            log.display()
        );
    }
    if !ended.status.success() {
        let who: String = culprits(&text).iter().map(|line| format!("\n  {line}")).collect();
        bail!(
            "{}: the run failed: dora ended with {}{who}\n  see {}",
            plan.name,
            ended.status,
            log.display()
        );
    }
    if !plan.out.join(realo_results::RESULT_FILE).exists() {
        bail!(
            "{}: the run ended without results, and no node says why: another program may have stopped dora; see {}",
            plan.name,
            log.display()
        );
    }
    Ok(())
}

/// Reads dora's log while it is written.
struct Follower {
    file: Option<File>,
    /// The begin of a line whose end is not there yet.
    begun: Vec<u8>,
    rate: f64,
    /// The first node that failed, and how.
    culprit: Option<(String, String)>,
    /// When all nodes were ready.
    ready: Option<Instant>,
    /// The nodes that have not ended, with their processes.
    running: BTreeMap<String, u32>,
    /// How the run goes, if that is new.
    live: Option<RunProgress>,
}

impl Follower {
    fn new(log: &Path, rate: f64) -> Self {
        Follower {
            file: File::open(log).ok(),
            begun: Vec::new(),
            rate,
            culprit: None,
            ready: None,
            running: BTreeMap::new(),
            live: None,
        }
    }

    /// What a person should know now.
    fn read(&mut self) -> Vec<String> {
        let Some(file) = &mut self.file else { return Vec::new() };
        // What cannot be read now is read later.
        let _ = file.read_to_end(&mut self.begun);
        let Some(end) = self.begun.iter().rposition(|byte| *byte == b'\n') else {
            return Vec::new();
        };
        let rest = self.begun.split_off(end + 1);
        let lines = std::mem::replace(&mut self.begun, rest);
        let text = plain(&String::from_utf8_lossy(&lines));
        if self.culprit.is_none() {
            self.culprit = text.lines().find_map(failed);
        }
        text.lines().for_each(|line| self.follow(line));
        self.live = text.lines().rev().find_map(RunProgress::from_line).or(self.live.take());
        let slow = text.lines().filter_map(Slow::from_line);
        slow.map(|slow| keeping_up(&slow, self.rate)).collect()
    }
}

impl Follower {
    /// Takes what dora says of a node's process.
    fn follow(&mut self, line: &str) {
        let said = line.split_once(' ').filter(|(time, _)| is_time(time));
        let said = said.and_then(|(_, rest)| rest.split_once(": ").map(|(who, what)| (who, what.trim())));
        let Some((node, what)) = said.and_then(|(who, what)| Some((who.split_whitespace().nth(1)?, what))) else {
            return;
        };
        if let Some(process) = what.strip_prefix("spawner spawned node with pid ") {
            self.running
                .extend(process.parse().ok().map(|process| (node.to_string(), process)));
        } else if what.starts_with("daemon handling node stop") || what.starts_with("daemon exited") {
            self.running.remove(node);
        } else if what.starts_with("daemon all nodes are ready") {
            self.ready.get_or_insert_with(Instant::now);
        }
    }
}

/// What a stage that is too slow means, with what to do.
fn keeping_up(slow: &Slow, rate: f64) -> String {
    format!(
        "this machine does not keep up: {slow}; {}",
        pace::remedies(slow.share * rate)
    )
}

/// The node that a line of dora's says has failed, and how.
fn failed(line: &str) -> Option<(String, String)> {
    let (time, rest) = line.split_once(" ERROR ")?;
    if !is_time(time) {
        return None;
    }
    let (node, how) = rest.trim().split_once(": daemon exited ")?;
    let how = how.trim_end_matches(" with stderr output:").trim_end_matches(':');
    let how = match how.strip_prefix("because of signal ") {
        Some(signal) => format!("was ended by {signal}"),
        None => format!("exited {how}"),
    };
    Some((node.to_string(), how))
}

/// A log without colours, and without frames that have no name.
fn plain(log: &str) -> String {
    let mut text = String::with_capacity(log.len());
    let mut rest = log;
    while let Some((before, escape)) = rest.split_once("\u{1b}[") {
        text.push_str(before);
        rest = escape
            .split_once(|c: char| c.is_ascii_alphabetic())
            .map_or("", |(_, after)| after);
    }
    text.push_str(rest);
    let lines = text.lines().filter(|line| !line.contains("<unknown>"));
    lines.map(|line| format!("{line}\n")).collect()
}

fn is_time(time: &str) -> bool {
    time.len() == 8 && time.chars().all(|c| c.is_ascii_digit() || c == ':')
}

/// Lines of one failure that are shown.
const SHOWN: usize = 12;
/// Failures that are shown.
const FAILURES: usize = 8;

/// What dora and the nodes said of failures, each thing once, with all its lines (within reason).
fn culprits(log: &str) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    let mut known = BTreeSet::new();
    let lines: Vec<(&str, &str)> = log.lines().map(said).collect();
    for (at, (speaker, text)) in lines.iter().enumerate() {
        if !is_reported(text) {
            continue;
        }
        // Other nodes speak in between.
        let own = lines[at + 1..]
            .iter()
            .filter(|(by, _)| by == speaker)
            .map(|(_, text)| *text);
        let belongs = |text: &&str| !text.is_empty() && !is_fence(text) && !is_reported(text);
        let mut all = vec![*text];
        if text.ends_with("stderr output:") {
            // dora repeats at the end what a node said, between fences; of ours it is reported already.
            let repeated: Vec<&str> = own
                .skip_while(|text| is_fence(text))
                .take_while(|text| !is_fence(text))
                .collect();
            if repeated.iter().any(|text| is_reported(text)) {
                continue;
            }
            all.extend(repeated);
        } else {
            all.extend(own.take_while(belongs));
        }
        let hidden = all.len().saturating_sub(SHOWN);
        all.truncate(SHOWN);
        let mut message = all.join("\n    ");
        if hidden > 0 {
            message.push_str(&format!("\n    … and {hidden} lines more"));
        }
        if known.insert(message.clone()) {
            let by = if speaker.is_empty() {
                String::new()
            } else {
                format!("{speaker}: ")
            };
            found.push(format!("{by}{message}"));
        }
    }
    let more = found.len().saturating_sub(FAILURES);
    found.truncate(FAILURES);
    found.extend((more > 0).then(|| format!("… and {more} more failures")));
    found
}

fn is_fence(line: &str) -> bool {
    line.starts_with("-----")
}

fn is_reported(line: &str) -> bool {
    line.contains("realo: ") || (line.contains("ode `") && line.contains("failed"))
}

/// Who says a line of dora's log, and what: `17:48:16 stdout fusion: TEXT` is said by the node, other lines by nobody.
fn said(line: &str) -> (&str, &str) {
    let named = line
        .split_once(" stdout ")
        .and_then(|(time, rest)| rest.split_once(": ").filter(|_| is_time(time)));
    let (speaker, text) = named.unwrap_or(("", line));
    (speaker, text.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_node_that_failed_first_is_known_by_its_name() {
        let colours = "\u{1b}[31mERROR\u{1b}[0m node \u{1b}[2mexited\u{1b}[0m\n  0: <unknown>\nsaid\n";
        assert_eq!(plain(colours), "ERROR node exited\nsaid\n");
        let of = |line| failed(line).map(|(node, how)| format!("{node} {how}"));
        let killed = "17:58:22 ERROR  others: daemon exited because of signal SIGKILL";
        assert_eq!(of(killed).as_deref(), Some("others was ended by SIGKILL"));
        let own = "17:48:16 ERROR  fusion: daemon exited with code 1 with stderr output:";
        assert_eq!(of(own).as_deref(), Some("fusion exited with code 1"));
        assert_eq!(of("17:58:22 DEBUG  others: daemon exited with code 1"), None);
    }

    #[test]
    fn nodes_that_have_not_ended_are_known() {
        let mut follower = Follower::new(Path::new("none"), 1.0);
        let lines = [
            "14:30:11 INFO   ego: spawner spawning `realo` in `graph`",
            "14:30:11 DEBUG  ego: spawner spawned node with pid 4294967295",
            "14:30:11 DEBUG  fusion: spawner spawned node with pid 4294967294",
            "14:30:12 INFO   [dora]: daemon all nodes are ready, starting dataflow",
            "14:30:15 stdout fusion: spawner spawned node with pid x",
            "14:30:20 DEBUG  ego: daemon handling node stop with exit status Success (restart: false)",
        ];
        lines.iter().for_each(|line| follower.follow(line));
        assert!(follower.ready.is_some());
        let said = not_ended(15.2, &follower.running);
        let expected = "the log ended 15 s ago, and these nodes have not: fusion; ";
        assert!(said.starts_with(expected) && said.contains("Ctrl-C"), "{said}");
    }

    #[test]
    fn a_machine_that_does_not_keep_up_is_reported_what_to_do() {
        let slow = Slow {
            node: "ego.encoder".into(),
            call_ms: 170.0,
            share: 0.58,
        };
        let reported = keeping_up(&slow, 1.0);
        assert!(
            reported
                .contains("node `ego.encoder` takes 170 ms a call and does 58 % of what comes; play with `--rate 0.5`"),
            "{reported}"
        );
    }

    #[test]
    fn a_failure_is_reported_once_with_all_its_lines() {
        let log = "\
17:48:12 INFO   fusion: daemon node is ready
17:48:16 stdout ego: 40 sweeps
17:48:16 stdout fusion: realo: node `fusion.fusion` failed: it said on standard error: Traceback:
17:48:16 stdout fusion:   File \"late.py\", line 3
17:48:16 stdout ego: 41 sweeps
17:48:16 stdout fusion: ValueError: no boxes
17:48:16 ERROR  fusion: daemon exited with code 1 with stderr output:
---------------------------------------------------------------------------------
realo: node `fusion.fusion` failed: it said on standard error: Traceback:
  File \"late.py\", line 3
ValueError: no boxes
---------------------------------------------------------------------------------

17:48:16 stdout score: realo: score: node `fusion` failed: exited with code 1
Node `score` failed: exited with code 1 with stderr output:
---------------------------------------------------------------------------------
realo: score: node `fusion` failed: exited with code 1
---------------------------------------------------------------------------------
Node `camera` failed: exited with code 2 with stderr output:
---------------------------------------------------------------------------------
no device
---------------------------------------------------------------------------------
";
        let expected = [
            "fusion: realo: node `fusion.fusion` failed: it said on standard error: Traceback:\n    File \"late.py\", line 3\n    \
             ValueError: no boxes",
            "score: realo: score: node `fusion` failed: exited with code 1",
            "Node `camera` failed: exited with code 2 with stderr output:\n    no device",
        ];
        assert_eq!(culprits(log), expected);
        let long = format!("realo: ego: it failed\n{}", "a line\n".repeat(100));
        let reported = culprits(&long).concat();
        assert_eq!(reported.lines().count(), SHOWN + 1);
        assert!(reported.ends_with("… and 89 lines more"), "{reported}");
    }
}

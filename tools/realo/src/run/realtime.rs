//! Runs on dora.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use eyre::{Result, WrapErr, bail};
use indicatif::{ProgressBar, ProgressStyle};
use realo_host::dora::FOLDER_VARIABLE;

use super::dora;
use super::prepare::Cell;

/// Lets dora's publishers wait for room instead of dropping at once.
const ZENOH_OVERLAY: &str = include_str!("../../../../dataflows/zenoh.json5");

/// Has dora run a cell and checks that the run is complete.
///
/// # Errors
/// Which node failed, or what is missing; dora's own words are in `dora.log`.
pub fn run(cell: &Cell, rate: f64) -> Result<()> {
    let dora = dora::find()?;
    let graph = write_graph(cell)?;
    let overlay = graph.with_file_name("zenoh.json5");
    fs::write(&overlay, ZENOH_OVERLAY)?;
    let log_path = cell.out.join("dora.log");
    let log = File::create(&log_path).wrap_err_with(|| format!("{}", log_path.display()))?;
    let child = Command::new(&dora)
        .arg("run")
        .arg(&graph)
        .env("DORA_ZENOH_CONFIG_OVERLAY", &overlay)
        .env(FOLDER_VARIABLE, cell.graph.file.parent().unwrap_or(Path::new("/")))
        .stdin(Stdio::null())
        .stdout(log.try_clone()?)
        .stderr(log)
        .spawn()
        .wrap_err_with(|| format!("{}", dora.display()))?;
    let status = watch(child, cell, rate)?;
    check(cell, status, &log_path)
}

/// Writes the expanded graph with this very program behind every stage, and its types beside it.
fn write_graph(cell: &Cell) -> Result<PathBuf> {
    let folder = std::path::absolute(cell.out.join("graph"))?;
    let mut graph = cell.graph.clone();
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

fn watch(mut child: Child, cell: &Cell, rate: f64) -> Result<ExitStatus> {
    let style = ProgressStyle::with_template("{msg:>24} [{bar:32}] {pos}/{len} s").expect("the template is a constant");
    let bar = ProgressBar::new((cell.seconds / rate).ceil() as u64).with_style(style.progress_chars("=> "));
    bar.set_message(cell.name.clone());
    let begun = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        bar.set_position(begun.elapsed().as_secs().min(bar.length().unwrap_or(u64::MAX)));
        std::thread::sleep(Duration::from_millis(50));
    };
    bar.finish_and_clear();
    Ok(status)
}

fn check(cell: &Cell, status: ExitStatus, log: &Path) -> Result<()> {
    let text = fs::read_to_string(log).unwrap_or_default();
    if !status.success() {
        let culprits = culprits(&text);
        let who: String = culprits.iter().map(|line| format!("\n  {line}")).collect();
        bail!(
            "{}: the run failed: dora ended with {status}{who}\n  see {}",
            cell.name,
            log.display()
        );
    }
    if !cell.out.join(realo_results::RESULT_FILE).exists() {
        bail!(
            "{}: the run ended without results (was it stopped?); see {}",
            cell.name,
            log.display()
        );
    }
    Ok(())
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
        if !is_told(text) {
            continue;
        }
        // Other nodes speak in between.
        let own = lines[at + 1..]
            .iter()
            .filter(|(by, _)| by == speaker)
            .map(|(_, text)| *text);
        let belongs = |text: &&str| !text.is_empty() && !is_fence(text) && !is_told(text);
        let mut all = vec![*text];
        if text.ends_with("stderr output:") {
            // dora repeats at the end what a node said, between fences; of ours it is told already.
            let repeated: Vec<&str> = own
                .skip_while(|text| is_fence(text))
                .take_while(|text| !is_fence(text))
                .collect();
            if repeated.iter().any(|text| is_told(text)) {
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

fn is_told(line: &str) -> bool {
    line.contains("realo: ") || (line.contains("ode `") && line.contains("failed"))
}

/// Who says a line of dora's log, and what: `17:48:16 stdout fusion: TEXT` is said by the node, other lines by nobody.
fn said(line: &str) -> (&str, &str) {
    let named = line.split_once(" stdout ").and_then(|(time, rest)| {
        let is_time = time.len() == 8 && time.chars().all(|c| c.is_ascii_digit() || c == ':');
        rest.split_once(": ").filter(|_| is_time)
    });
    let (speaker, text) = named.unwrap_or(("", line));
    (speaker, text.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_is_told_once_with_all_its_lines() {
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
        let told = culprits(&long).concat();
        assert_eq!(told.lines().count(), SHOWN + 1);
        assert!(told.ends_with("… and 89 lines more"), "{told}");
    }
}

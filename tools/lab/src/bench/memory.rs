use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use eyre::{Result, WrapErr, bail};
use realo_cli::Progress;
use realo_cli::program::beside;
use serde::Serialize;

/// Time in which a run fills its buffers, s.
const SETTLE: f64 = 30.0;
/// Between two looks, s.
const LOOK: f64 = 2.0;

/// Resident memory of all processes of a run.
#[derive(Serialize)]
pub struct Memory {
    seconds: f64,
    /// Median over the tenth of the time after settling, MB.
    early_mb: f64,
    /// Median over the last tenth, MB.
    late_mb: f64,
    growth_percent: f64,
    samples: usize,
}

/// Replays the demo log in a loop for `seconds` and watches resident memory.
pub fn bench(seconds: f64, progress: &Progress) -> Result<Memory> {
    if seconds < 2.0 * SETTLE {
        bail!("--seconds: expected at least {}, found {seconds}", 2.0 * SETTLE);
    }
    let out = super::framework::folder()?.join("memory");
    let log = super::framework::demo_log()?;
    let passes = (seconds / 10.0).ceil();
    let mut run = Command::new(beside("realo")?);
    run.args([
        "run",
        "dataflows/late_fusion.yml",
        "--recorded-detections",
        "--ego",
        "cav1",
    ]);
    run.arg("--log")
        .arg(&log)
        .arg("--out")
        .arg(&out)
        .args(["--set", &format!("player.repeat={passes}")]);
    let mut child = run
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .wrap_err("realo run")?;
    let samples = watch(&mut child, seconds, progress).inspect_err(|_| {
        // Nobody would end it otherwise.
        let _ = child.kill();
    })?;
    let status = child.wait()?;
    if !status.success() {
        bail!(
            "the run ended with {status} after {} looks; run `realo run` by hand to see why",
            samples.len()
        );
    }
    let settled: Vec<f64> = samples
        .iter()
        .filter(|(at, _)| *at >= SETTLE)
        .map(|(_, mb)| *mb)
        .collect();
    let tenth = (settled.len() / 10).max(1);
    if settled.len() < 2 * tenth {
        bail!(
            "the run ended after {} looks; run `realo run` by hand to see why",
            samples.len()
        );
    }
    let (early, late) = (median(&settled[..tenth]), median(&settled[settled.len() - tenth..]));
    Ok(Memory {
        seconds,
        early_mb: early,
        late_mb: late,
        growth_percent: (late / early - 1.0) * 100.0,
        samples: samples.len(),
    })
}

fn watch(child: &mut Child, seconds: f64, progress: &Progress) -> Result<Vec<(f64, f64)>> {
    progress.count("s", seconds);
    let begun = Instant::now();
    let mut samples = Vec::new();
    while child.try_wait()?.is_none() {
        let at = begun.elapsed().as_secs_f64();
        progress.set(at.round());
        // The last seconds are those of a run that ends.
        if at < seconds - LOOK {
            samples.push((at, resident_mb(child.id())?));
        }
        std::thread::sleep(Duration::from_secs_f64(LOOK));
    }
    Ok(samples)
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// Memory of a process and all its descendants that belongs to them alone or proportionally, MB.
pub(super) fn resident_mb(root: u32) -> Result<f64> {
    let mut children: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for entry in fs::read_dir("/proc").wrap_err("/proc")?.flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|name| name.parse::<u32>().ok()) else {
            continue;
        };
        if let Some(parent) = parent_of(&entry.path()) {
            children.entry(parent).or_default().push(pid);
        }
    }
    let (mut open, mut kilobytes) = (vec![root], 0u64);
    while let Some(pid) = open.pop() {
        kilobytes += proportional_kb(&PathBuf::from(format!("/proc/{pid}/smaps_rollup")));
        open.extend(children.remove(&pid).unwrap_or_default());
    }
    Ok(kilobytes as f64 / 1024.0)
}

fn parent_of(process: &Path) -> Option<u32> {
    let stat = fs::read_to_string(process.join("stat")).ok()?;
    stat.rsplit_once(')')?.1.split_whitespace().nth(1)?.parse().ok()
}

fn proportional_kb(rollup: &Path) -> u64 {
    let text = fs::read_to_string(rollup).unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix("Pss:"));
    line.and_then(|line| line.split_whitespace().next()?.parse().ok())
        .unwrap_or(0)
}

impl fmt::Display for Memory {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "resident memory of a looped realtime replay, {:.0} s, {} looks",
            self.seconds, self.samples
        )?;
        write!(
            f,
            "  early {:.1} MB, late {:.1} MB: {:+.2} % (goal: below 2 %)",
            self.early_mb, self.late_mb, self.growth_percent
        )
    }
}

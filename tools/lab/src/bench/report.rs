use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use eyre::{Result, WrapErr, bail, eyre};
use realo_browser::{Browser, HINT, Screen, installed};
use realo_cli::Progress;
use realo_cli::program::beside;
use serde::Serialize;

use super::framework::{demo_log, folder};

/// Graphs whose runs are on the page.
const GRAPHS: [&str; 2] = ["late_fusion", "no_fusion"];
/// Times that each page is made and opened.
const TIMES: usize = 3;
/// A page that takes longer fails the bench.
const PATIENCE: Duration = Duration::from_secs(60);
const SCREEN: Screen = Screen {
    size: [1280, 900],
    dark: Some(false),
};

/// A report of two runs of the demo log, without and with points.
#[derive(Serialize)]
pub struct Report {
    /// What the pages were opened in; `None`: no browser is installed.
    browser: Option<String>,
    seconds: f64,
    pages: Vec<Page>,
}

#[derive(Serialize)]
struct Page {
    name: &'static str,
    megabytes: f64,
    /// Median time to make it, s.
    made_s: f64,
    /// Median time from its address to its first picture, s.
    opened_s: Option<f64>,
    /// Pictures that the player draws in a second while both runs play, from above and in space.
    top_hz: Option<f64>,
    space_hz: Option<f64>,
}

/// Makes the pages, opens them in a headless Chromium without a graphics card, and plays so many seconds of each.
pub fn bench(seconds: f64, progress: &Progress) -> Result<Report> {
    if !(1.0..=60.0).contains(&seconds) {
        bail!("--seconds: expected 1 to 60, found {seconds}");
    }
    let folder = folder()?.join("report");
    let runs = runs(&folder)?;
    let program = installed();
    if program.is_none() {
        eprintln!("realo-lab: no browser: {HINT}");
    }
    let mut browser = match &program {
        Some(program) => Some(Browser::start(program, &folder.join("profile"))?),
        None => None,
    };
    let wanted = [("boxes", &[][..]), ("boxes and points", &["--points"][..])];
    progress.count("pages", wanted.len() as f64);
    let mut pages = Vec::new();
    for (name, options) in wanted {
        let file = folder.join("report.html");
        let made_s = median((0..TIMES).map(|_| made(&runs, &file, options)))?;
        let megabytes = std::fs::metadata(&file)?.len() as f64 / 1e6;
        let (mut opened_s, mut rates) = (None, [None; 2]);
        if let Some(browser) = &mut browser {
            opened_s = Some(median((0..TIMES).map(|_| opened(browser, &file)))?);
            rates = [
                Some(played(browser, "top", seconds)?),
                Some(played(browser, "3d", seconds)?),
            ];
        }
        let [top_hz, space_hz] = rates;
        pages.push(Page {
            name,
            megabytes,
            made_s,
            opened_s,
            top_hz,
            space_hz,
        });
        progress.add(1.0);
    }
    let version = |browser: &mut Browser| browser.call("Browser.getVersion", serde_json::json!({}));
    let version = browser.as_mut().map(version).transpose()?;
    Ok(Report {
        browser: version.and_then(|version| Some(version["product"].as_str()?.to_string())),
        seconds,
        pages,
    })
}

/// Runs of the demo log by the detections that it recorded.
fn runs(folder: &Path) -> Result<Vec<PathBuf>> {
    let log = demo_log()?;
    let mut command = Command::new(beside("realo")?);
    command
        .arg("run")
        .args(GRAPHS)
        .args(["--offline", "--recorded-detections", "--log"]);
    let output = command
        .arg(&log)
        .arg("--out")
        .arg(folder.join("runs"))
        .stdin(Stdio::null())
        .output()?;
    match output.status.success() {
        true => Ok(GRAPHS.map(|graph| folder.join("runs").join(graph)).into()),
        false => bail!("realo run: {}", String::from_utf8_lossy(&output.stderr)),
    }
}

/// Makes a page, and gives the time that it took, s.
fn made(runs: &[PathBuf], file: &Path, options: &[&str]) -> Result<f64> {
    let begun = Instant::now();
    let output = Command::new(beside("realo")?)
        .arg("report")
        .args(runs)
        .arg("-o")
        .arg(file)
        .args(options)
        .stdin(Stdio::null())
        .output()?;
    match output.status.success() {
        true => Ok(begun.elapsed().as_secs_f64()),
        false => bail!("realo report: {}", String::from_utf8_lossy(&output.stderr)),
    }
}

/// Opens a page, and gives the time until its player has drawn, s.
fn opened(browser: &mut Browser, file: &Path) -> Result<f64> {
    let begun = Instant::now();
    browser.go(&format!("file://{}", file.display()), SCREEN, PATIENCE)?;
    browser.wait("panes.length === 2 && panes[0].shown.length > 0", PATIENCE)?;
    Ok(begun.elapsed().as_secs_f64())
}

/// Pictures in a second while the player plays both runs at the speed of the log.
fn played(browser: &mut Browser, view: &str, seconds: f64) -> Result<f64> {
    browser.value(&format!(
        "(setView('{view}'), state.speed = 1, seek(0), byId('player').scrollIntoView(), played.pictures = 0, play(true))"
    ))?;
    let rate = browser
        .value(&format!(
            "new Promise((done) => {{ const from = performance.now(); \
             setTimeout(() => done(1000 * played.pictures / (performance.now() - from)), {}); }})",
            seconds * 1000.0
        ))?
        .as_f64()
        .ok_or_else(|| eyre!("the player does not count its pictures"))?;
    browser.value("play(false)").wrap_err("after playing")?;
    Ok(rate)
}

fn median(values: impl Iterator<Item = Result<f64>>) -> Result<f64> {
    let mut all = values.collect::<Result<Vec<f64>>>()?;
    all.sort_by(f64::total_cmp);
    Ok(all[all.len() / 2])
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "report of two runs of the demo log, {} (goals: made in 5 s, open in 2 s, 15 pictures a second while playing {:.0} s)",
            self.browser.as_deref().unwrap_or("no browser"),
            self.seconds
        )?;
        write!(
            f,
            "  {:<18} {:>6} {:>8} {:>8} {:>16} {:>10}",
            "page", "MB", "made, s", "open, s", "pictures a s", "in space"
        )?;
        for page in &self.pages {
            let some =
                |value: Option<f64>, places: usize| value.map_or("–".into(), |value| format!("{value:.places$}"));
            write!(
                f,
                "\n  {:<18} {:>6.1} {:>8.2} {:>8} {:>16} {:>10}",
                page.name,
                page.megabytes,
                page.made_s,
                some(page.opened_s, 2),
                some(page.top_hz, 1),
                some(page.space_hz, 1)
            )?;
        }
        Ok(())
    }
}

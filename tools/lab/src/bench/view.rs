use std::fmt;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use eyre::{Result, WrapErr, bail, eyre};
use realo_cli::Progress;
use realo_cli::program::beside;
use serde::Serialize;

use super::framework::{clone_agents, demo_log, folder};
use super::memory::resident_mb;

/// Agents of the log.
const AGENTS: usize = 4;
/// Seconds of the demo log.
const LOG_SECONDS: f64 = 10.0;
/// Between two looks at a run.
const LOOK: Duration = Duration::from_millis(200);
/// A run says within this time where it is shown.
const TO_BEGIN: Duration = Duration::from_secs(60);
/// Frames of WebSocket: one that asks whether the client is there, one that brings a picture, and one that ends the talk.
const PING: u8 = 9;
const BINARY: u8 = 2;
const CLOSE: u8 = 8;

/// What being watched costs a run in realtime.
#[derive(Serialize)]
pub struct View {
    agents: usize,
    seconds: f64,
    runs: Vec<Watched>,
}

/// One run; times in ms from the sweep's last point to fused boxes.
#[derive(Serialize)]
struct Watched {
    by: &'static str,
    rate_hz: f64,
    p50: f64,
    p95: f64,
    /// Pictures that came to one who reads, in a second between the first and the last.
    pictures_hz: Option<f64>,
    /// Bytes of a picture.
    picture_kb: Option<f64>,
    /// Max of the memory of all processes, MB.
    most_mb: f64,
}

/// Who looks at a run.
#[derive(Clone, Copy, PartialEq)]
enum Who {
    Nobody,
    /// Takes all pictures.
    Reader,
    /// Takes all pictures, while another one has stopped reading.
    Both,
}

impl Who {
    fn words(self) -> &'static str {
        match self {
            Who::Nobody => "nobody",
            Who::Reader => "one who reads",
            Who::Both => "and eight who stopped",
        }
    }

    /// How many look without reading.
    fn stopped(self) -> usize {
        if self == Who::Both { 8 } else { 0 }
    }
}

/// Runs early fusion with four agents on dora: alone, watched, and watched by some who stopped reading, too.
pub fn bench(seconds: f64, progress: &Progress) -> Result<View> {
    let folder = folder()?;
    let log = folder.join("view.mcap");
    clone_agents(&demo_log()?, &log, AGENTS, LOG_SECONDS)?;
    let all = [Who::Nobody, Who::Reader, Who::Both];
    progress.count("runs", all.len() as f64);
    let mut runs = Vec::new();
    for who in all {
        runs.push(run(&log, &folder.join("view"), seconds, who).wrap_err(who.words())?);
        progress.add(1.0);
    }
    Ok(View {
        agents: AGENTS,
        seconds,
        runs,
    })
}

fn run(log: &Path, out: &Path, seconds: f64, who: Who) -> Result<Watched> {
    let passes = (seconds / LOG_SECONDS).ceil().max(1.0);
    let mut command = Command::new(beside("realo")?);
    command.args(["run", "dataflows/early_fusion.yml", "--ego", "cav1", "--log"]);
    command.arg(log).arg("--out").arg(out);
    command.args(["--set", &format!("player.repeat={passes}")]);
    if who != Who::Nobody {
        command.args(["--view", "--view-exit"]);
    }
    let child = command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .wrap_err("realo run")?;
    let mut running = Running(child);
    let said = Said::of(&mut running.0)?;
    let mut clients = match who {
        Who::Nobody => None,
        _ => Some(Clients::start(&said.host()?, who)?),
    };
    let most_mb = watch(&mut running.0)?;
    let status = running.0.wait()?;
    if !status.success() {
        bail!("the run ended with {status}: {}", said.all());
    }
    let seen = clients.as_mut().map(Clients::end).transpose()?;
    let timing = realo_results::read_run(out)?.timing;
    let latency = timing.latency_ms.get("end_to_end");
    let of = |pick: fn(&realo_results::Spread) -> Option<f64>| {
        latency.and_then(pick).ok_or_else(|| eyre!("the run has no latency"))
    };
    Ok(Watched {
        by: who.words(),
        rate_hz: timing.rate_hz.unwrap_or(0.0),
        p50: of(|spread| spread.p50)?,
        p95: of(|spread| spread.p95)?,
        pictures_hz: seen.as_ref().and_then(Seen::rate),
        picture_kb: seen.as_ref().map(Seen::kb),
        most_mb,
    })
}

/// A run that ends with whoever measures it.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        if !matches!(self.0.try_wait(), Ok(Some(_))) {
            let _ = self.0.kill();
            let _ = self.0.wait();
        }
    }
}

/// Looks at the memory of a run until its end.
fn watch(child: &mut Child) -> Result<f64> {
    let mut most = 0.0f64;
    while child.try_wait()?.is_none() {
        most = most.max(resident_mb(child.id())?);
        std::thread::sleep(LOOK);
    }
    Ok(most)
}

/// What a run says, line by line.
struct Said(Arc<std::sync::Mutex<Vec<String>>>);

impl Said {
    fn of(child: &mut Child) -> Result<Self> {
        let said = Said(Arc::default());
        let lines = said.0.clone();
        let from = child.stderr.take().ok_or_else(|| eyre!("realo run: no messages"))?;
        std::thread::spawn(move || {
            for line in BufReader::new(from).lines().map_while(Result::ok) {
                lines
                    .lock()
                    .unwrap_or_else(std::sync::PoisonError::into_inner)
                    .push(line);
            }
        });
        Ok(said)
    }

    fn all(&self) -> String {
        let lines = self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        lines.join("\n")
    }

    /// Host and port at which the run is shown.
    fn host(&self) -> Result<String> {
        let begun = Instant::now();
        while begun.elapsed() < TO_BEGIN {
            let all = self.all();
            let found = all.split_once("http://").and_then(|(_, rest)| rest.split_once('/'));
            if let Some((host, _)) = found {
                return Ok(host.into());
            }
            std::thread::sleep(LOOK / 10);
        }
        bail!(
            "it did not say where it is shown in {} s: {}",
            TO_BEGIN.as_secs(),
            self.all()
        )
    }
}

/// Those who look: one reads until the end, the others only hold their connections.
struct Clients {
    reader: Option<JoinHandle<Result<Seen>>>,
    stopped: Vec<JoinHandle<()>>,
    over: Arc<AtomicBool>,
}

impl Clients {
    fn start(host: &str, who: Who) -> Result<Self> {
        let stream = connected(host)?;
        let over = Arc::new(AtomicBool::new(false));
        let stopped = (0..who.stopped()).map(|_| {
            let (host, over) = (host.to_string(), over.clone());
            std::thread::spawn(move || stop_reading(&host, &over))
        });
        Ok(Clients {
            stopped: stopped.collect(),
            reader: Some(std::thread::spawn(move || read_all(stream))),
            over,
        })
    }

    fn end(&mut self) -> Result<Seen> {
        self.over.store(true, Ordering::SeqCst);
        for thread in self.stopped.drain(..) {
            let _ = thread.join();
        }
        let seen = self.reader.take().and_then(|reader| reader.join().ok());
        seen.ok_or_else(|| eyre!("whoever reads pictures failed"))?
    }
}

/// Connects and never reads; the server ends such a connection after a time, so that it comes again.
fn stop_reading(host: &str, over: &AtomicBool) {
    while !over.load(Ordering::SeqCst) {
        let held = connected(host);
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(6) && !over.load(Ordering::SeqCst) {
            std::thread::sleep(LOOK);
        }
        drop(held);
    }
}

/// A connection of WebSocket to the pictures of a run.
fn connected(host: &str) -> Result<TcpStream> {
    let mut stream = TcpStream::connect(host).wrap_err_with(|| host.to_string())?;
    stream.set_read_timeout(Some(TO_BEGIN))?;
    let request = format!(
        "GET /pictures HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    );
    stream.write_all(request.as_bytes())?;
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).wrap_err("no answer")?;
        head.push(byte[0]);
    }
    match head.starts_with(b"HTTP/1.1 101 ") {
        true => Ok(stream),
        false => bail!("{host}: {}", String::from_utf8_lossy(&head)),
    }
}

/// What came to one who reads.
#[derive(Default)]
struct Seen {
    times: Vec<Instant>,
    bytes: u64,
}

impl Seen {
    fn rate(&self) -> Option<f64> {
        let (first, last) = (self.times.first()?, self.times.last()?);
        let seconds = last.duration_since(*first).as_secs_f64();
        (seconds > 0.0).then(|| (self.times.len() - 1) as f64 / seconds)
    }

    fn kb(&self) -> f64 {
        self.bytes as f64 / 1000.0 / self.times.len().max(1) as f64
    }
}

/// Takes all that comes until the server goes, and answers when it is asked.
fn read_all(stream: TcpStream) -> Result<Seen> {
    let mut answers = stream.try_clone()?;
    let mut from = BufReader::new(stream);
    let mut seen = Seen::default();
    while let Ok((kind, content)) = frame(&mut from) {
        match kind {
            BINARY => {
                seen.times.push(Instant::now());
                seen.bytes += content.len() as u64;
            }
            PING => {
                // Masked, as frames of clients are: by nothing.
                let mut pong = vec![0x8a, 0x80 | content.len() as u8, 0, 0, 0, 0];
                pong.extend(content);
                answers.write_all(&pong)?;
            }
            CLOSE => break,
            _ => {}
        }
    }
    Ok(seen)
}

fn frame(from: &mut impl Read) -> std::io::Result<(u8, Vec<u8>)> {
    let mut head = [0; 2];
    from.read_exact(&mut head)?;
    let mut long = [0; 8];
    let length = match head[1] {
        126 => {
            from.read_exact(&mut long[6..])?;
            u64::from_be_bytes(long)
        }
        127 => {
            from.read_exact(&mut long)?;
            u64::from_be_bytes(long)
        }
        short => u64::from(short),
    };
    let mut content = Vec::new();
    // Grows as bytes come, whatever the length says.
    if from.take(length).read_to_end(&mut content)? as u64 != length {
        return Err(std::io::ErrorKind::UnexpectedEof.into());
    }
    Ok((head[0] & 0x0f, content))
}

impl fmt::Display for View {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "early fusion in realtime on dora, {} agents, {:.0} s of log (goals: rate and p95 within 5 % of those that nobody watches, \
             8 pictures a second)",
            self.agents, self.seconds
        )?;
        write!(
            f,
            "  {:<24} rate Hz   p50 ms   p95 ms   pictures a s   KB each   most MB",
            "watched by"
        )?;
        for run in &self.runs {
            let some = |value: Option<f64>| value.map_or("–".into(), |value| format!("{value:.1}"));
            write!(
                f,
                "\n  {:<24} {:>7.2} {:>8.1} {:>8.1} {:>14} {:>9} {:>9.0}",
                run.by,
                run.rate_hz,
                run.p50,
                run.p95,
                some(run.pictures_hz),
                some(run.picture_kb),
                run.most_mb
            )?;
        }
        Ok(())
    }
}

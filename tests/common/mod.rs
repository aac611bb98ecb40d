//! What the end-to-end tests share: the programs, small logs made once, results read back.
#![allow(dead_code)]

pub mod machine;
pub mod python;
pub mod watched;

use std::fs::{self, File};
use std::net::TcpListener;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use serde_json::Value;

/// The workbench; tests of the package `realo`, which does not have it, call its library.
pub const LAB: Option<&str> = option_env!("CARGO_BIN_EXE_realo-lab");

/// The program of the car: for tests of the workbench the one beside it.
pub const REALO: &str = match (option_env!("CARGO_BIN_EXE_realo"), LAB) {
    (Some(realo), _) => realo,
    (None, Some(lab)) => lab.split_at(lab.len() - "-lab".len()).0,
    (None, None) => panic!("the end-to-end tests are of the packages `realo` and `realo-lab`"),
};

/// The repository.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .canonicalize()
        .expect("the repository is there")
}

/// A shipped graph.
pub fn graph(name: &str) -> String {
    root()
        .join(format!("dataflows/{name}.yml"))
        .to_string_lossy()
        .into_owned()
}

/// A shipped graph in `home/dataflows`, with its modules and links to what it needs; each change is made wherever it applies.
pub fn changed_graph(home: &Path, name: &str, changes: &[(&str, &str)]) -> PathBuf {
    let dir = home.join("dataflows");
    fs::create_dir_all(dir.join("modules")).expect("folders can be made");
    for beside in ["models", "dataflows/types", "dataflows/bin"] {
        if !home.join(beside).exists() {
            std::os::unix::fs::symlink(root().join(beside), home.join(beside)).expect("links can be made");
        }
    }
    let path = dir.join(format!("{name}.yml"));
    let shipped = fs::read_dir(root().join("dataflows/modules")).expect("modules can be listed");
    let modules = shipped.map(|module| module.expect("an entry").path());
    let copies = modules.map(|from| (dir.join("modules").join(from.file_name().expect("a name")), from));
    let mut texts: Vec<(PathBuf, String)> = copies
        .chain([(path.clone(), graph(name).into())])
        .map(|(to, from)| (to, fs::read_to_string(from).expect("it can be read")))
        .collect();
    for (from, to) in changes {
        let mut changed = 0;
        for (_, text) in texts.iter_mut().filter(|(_, text)| text.contains(from)) {
            *text = text.replace(from, to);
            changed += 1;
        }
        assert!(changed > 0, "{from}");
    }
    for (file, text) in texts {
        fs::write(file, text).expect("it can be written");
    }
    path
}

/// Runs `realo` and returns what it said, whatever its exit code.
pub fn realo<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Output {
    // So wide that no sentence of a table is broken.
    Command::new(REALO)
        .args(args)
        .current_dir(root())
        .env("COLUMNS", "400")
        .output()
        .unwrap_or_else(|error| not_built(&error))
}

/// Ends a test that needs a program which is not there. `cargo test --workspace` builds both.
pub fn not_built(error: &std::io::Error) -> ! {
    panic!("{REALO}: {error}; it is built by `cargo build --release -p realo`")
}

/// Runs a command of the workbench as a process of its own and returns what it said, whatever its exit code.
pub fn lab<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Output {
    Command::new(LAB.expect("a test of the package `realo-lab`"))
        .args(args)
        .current_dir(root())
        .env("COLUMNS", "400")
        .output()
        .expect("the workbench can be started")
}

/// Runs a command of the workbench as a process of its own, which must succeed, and returns its standard output.
pub fn lab_said<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> String {
    let output = lab(args);
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{:?}\n{out}\n{err}", output.status);
    out
}

/// Runs a command of the workbench in this process; it must succeed.
pub fn lab_ok<S: Into<std::ffi::OsString>>(args: impl IntoIterator<Item = S>) {
    let outcome = realo_lab::run(args).unwrap_or_else(|error| panic!("{error:#}"));
    assert_eq!(outcome, realo_cli::Outcome::Complete);
}

/// Runs `realo`, which must succeed, and returns its standard output.
pub fn realo_ok<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> String {
    let output = realo(args);
    let (out, err) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{:?}\n{out}\n{err}", output.status);
    out
}

/// Bytes as text.
pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A file under the tests' own folder that `make` writes once; other test processes wait for it.
pub fn once(name: &str, make: impl FnOnce(&Path)) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let path = folder.join(name);
    let lock = File::create(folder.join(format!("{name}.lock"))).expect("the folder can be written");
    lock.lock().expect("locks work");
    if !newer(&path, Path::new(REALO)) {
        make(&path);
    }
    path
}

fn newer(path: &Path, than: &Path) -> bool {
    let modified = |path: &Path| fs::metadata(path).and_then(|meta| meta.modified());
    matches!((modified(path), modified(than)), (Ok(a), Ok(b)) if a > b)
}

/// A simulated log, made once per build of the program.
pub fn simulated(name: &str, args: &[&str]) -> PathBuf {
    once(&format!("{name}.mcap"), |path| {
        let mut all = vec!["simulate"];
        all.extend(args);
        let path = path.to_string_lossy();
        all.extend(["-o", &path]);
        lab_ok(all);
    })
}

/// An empty folder of the test's own.
pub fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).expect("the folder can be made");
    path
}

/// A JSON file.
pub fn json(path: &Path) -> Value {
    let text = fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Runs a shipped graph in virtual time into an own folder and returns `result.json` of it.
pub fn run_virtual(out: &str, graph_name: &str, log: &Path, args: &[&str]) -> Value {
    run_virtual_file(out, &graph(graph_name), log, args)
}

/// The same of a log that may have faults, such as an agent that begins late.
pub fn run_virtual_faulty(out: &str, graph_name: &str, log: &Path, args: &[&str]) -> Value {
    replayed(out, &graph(graph_name), log, args, true)
}

/// Runs a graph in virtual time into an own folder and returns `result.json` of it.
pub fn run_virtual_file(out: &str, graph: &str, log: &Path, args: &[&str]) -> Value {
    replayed(out, graph, log, args, false)
}

fn replayed(out: &str, graph: &str, log: &Path, args: &[&str], faults: bool) -> Value {
    let out = folder(out);
    let mut all = vec![
        "run".into(),
        graph.into(),
        "--log".into(),
        log.to_string_lossy().into_owned(),
    ];
    all.extend(["--out".to_string(), out.to_string_lossy().into_owned()]);
    if !args.contains(&"--offline") {
        all.extend(["--mode".to_string(), "virtual".into()]);
    }
    all.extend(args.iter().map(|arg| arg.to_string()));
    let output = realo(all);
    let (said, code) = (text(&output.stderr), output.status.code());
    assert!(
        code == Some(0) || faults && code == Some(3),
        "{code:?}\n{}\n{said}",
        text(&output.stdout)
    );
    json(&out.join("result.json"))
}

/// (true, false, total) of a class at an IoU in `accuracy.sorted`.
pub fn counts(result: &Value, class: &str, iou: &str) -> (u64, u64, u64) {
    let counts = &result["accuracy"]["sorted"]["counts"][class][iou];
    let get = |key: &str| {
        counts[key]
            .as_u64()
            .unwrap_or_else(|| panic!("counts.{class}.{iou}.{key} in {counts}"))
    };
    (get("true"), get("false"), get("total"))
}

/// A port that is free, as is the one behind it.
pub fn free_port() -> u16 {
    // Below those that systems give to who connects: peers that try again and again would take it before it is listened to.
    const PORTS: std::ops::Range<u32> = 12_000..32_000;
    static TRIES: AtomicU32 = AtomicU32::new(0);
    for _ in 0..1000 {
        let place = std::process::id()
            .wrapping_mul(7919)
            .wrapping_add(TRIES.fetch_add(2, Ordering::Relaxed));
        let port = (PORTS.start + place % (PORTS.end - PORTS.start)) as u16;
        if [port, port + 1].map(|port| TcpListener::bind(("127.0.0.1", port)).is_ok()) == [true; 2] {
            return port;
        }
    }
    panic!("no two ports side by side are free");
}

/// What starts an agent's graph.
pub fn arguments(name: &str, log: &Path, out: &Path, set: &[String]) -> Vec<String> {
    let mut all: Vec<String> = ["run", &graph(name), "--recorded-detections", "--log"]
        .map(String::from)
        .into();
    all.extend([log.display().to_string(), "--out".into(), out.display().to_string()]);
    all.extend(set.iter().flat_map(|set| ["--set".to_string(), set.clone()]));
    all
}

/// An agent that plays its part of the log again and again until it is stopped.
pub struct Peer(Child);

impl Peer {
    /// Starts its graph; `port` is where the vehicle listens.
    pub fn start(name: &str, log: &Path, out: &Path, port: u16, more: &[&str]) -> Peer {
        let mut set = vec![format!("v2x.connect=tcp/127.0.0.1:{port}"), "player.repeat=20".into()];
        set.extend(more.iter().map(|more| more.to_string()));
        Peer::spawn(arguments(name, log, out, &set))
    }

    /// Starts `realo`.
    pub fn spawn(arguments: Vec<String>) -> Peer {
        let mut command = Command::new(REALO);
        command.args(arguments).current_dir(root());
        Peer::of(command)
    }

    /// Starts a graph by this command.
    pub fn of(mut command: Command) -> Peer {
        command.stdout(Stdio::null()).stderr(Stdio::null()).process_group(0);
        Peer(command.spawn().unwrap_or_else(|error| not_built(&error)))
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        end(&mut self.0);
    }
}

/// Ends the process group of a child: asks, then kills.
pub fn end(child: &mut Child) {
    let group = format!("-{}", child.id());
    let _ = Command::new("kill").args(["-INT", "--", &group]).status();
    let begun = Instant::now();
    while begun.elapsed() < Duration::from_secs(10) {
        if matches!(child.try_wait(), Ok(Some(_))) {
            return;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    let _ = Command::new("kill").args(["-KILL", "--", &group]).status();
    let _ = child.wait();
}

/// The boxes of every frame, without its time.
pub fn boxes(out: &Path) -> Vec<Value> {
    let mut samples = json(&out.join("evaluation.json"));
    let frames = samples["evaluation"]["scenes"][0]["frames"].take();
    let frames = frames.as_array().expect("frames");
    frames.iter().map(|frame| frame["detections"].clone()).collect()
}

/// All files below a folder; none where there is no folder.
pub fn files_below(dir: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(dir).into_iter().flatten().flatten();
    let paths = entries.map(|entry| entry.path());
    paths
        .flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] })
        .collect()
}

/// What is waited for at most.
const PATIENCE: Duration = Duration::from_secs(180);

/// Waits until something is so.
pub fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !is_so() {
        assert!(begun.elapsed() < PATIENCE, "{what}: not within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Sends a signal to a process.
pub fn kill(id: u32, signal: &str) {
    let sent = Command::new("kill")
        .args([&format!("-{signal}"), &id.to_string()])
        .status();
    assert!(sent.expect("there is a kill").success());
}

/// Whether whoever runs the tests said that a closing terminal does not matter.
pub fn hangups_are_ignored() -> bool {
    let status = fs::read_to_string("/proc/self/status").expect("it is Linux");
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.expect("it has a mask of ignored signals") & 1 == 1
}

/// Asserts that files of two folders are the same to the bit.
pub fn assert_same_files(one: &Path, other: &Path, files: &[&str]) {
    for file in files {
        let [one, other] = [one, other].map(|folder| fs::read(folder.join(file)).expect("it is there"));
        assert!(one == other, "{file} differs");
    }
}

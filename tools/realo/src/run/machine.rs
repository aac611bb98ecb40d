//! What a machine must have for a realtime run: looked at before anything starts.

use crate::roles;
use std::fs::File;
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use eyre::{Result, bail};
use realo_cli::signals::MORE_PROCESSES;
use realo_graph::FlatGraph;
use realo_host::dora::{OVERLAY, POOL};
use realo_radio::Endpoint;
use rustix::fs::statvfs;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use super::nodes::{deciding, given};

/// Where the nodes' shared memory lies.
const SHARED: &str = "/dev/shm";
/// File descriptors of dora and of a node at most, as measured with six nodes, and as many again.
const DESCRIPTORS: u64 = 256;
/// Threads of dora and of a process of a graph beside those for each core, as measured, and a few more.
const THREADS_OF_DORA: usize = 16;
const THREADS_OF_A_PROCESS: usize = 24;
/// Threads that each of them has for each core.
const THREADS_OF_A_CORE: usize = 2;
/// Threads of a run in virtual time beside one for each core.
const THREADS_OF_VIRTUAL: usize = 8;
/// Shared memory of a process with networks beside its pool, bytes: maps and messages under way.
const WITH_NETWORKS: u64 = 48 << 20;
/// Pool of a process whose messages go through sockets: none, and dora takes the heap.
const NO_POOL: u64 = 0;
/// Processes of a shipped graph.
const PROCESSES: u64 = 6;

const MIB: u64 = 1 << 20;
/// Stack of a thread that only waits, bytes.
const STACK: usize = 64 << 10;
/// Files in shared memory are locked so long after they were made at the latest.
const NEW: Duration = Duration::from_secs(2);

/// What was found of one thing.
pub struct Check {
    /// What was looked at.
    pub what: &'static str,
    /// What was found; an error with what helps where a run would fail.
    pub found: Result<String, String>,
}

/// How nodes hand large messages to each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Memory {
    /// In shared memory.
    Shared,
    /// Through sockets.
    Sockets,
}

impl Memory {
    /// Zenoh's settings.
    pub fn overlay(self) -> String {
        match self {
            Memory::Shared => OVERLAY.into(),
            Memory::Sockets => {
                let all = OVERLAY.trim_end().strip_suffix('}').unwrap_or(OVERLAY);
                let transport = all.replacen("{ transport: {", "{ transport: { shared_memory: { enabled: false },", 1);
                format!("{transport}}}\n")
            }
        }
    }

    /// The pool of every node, where it is not its own choice.
    pub fn pool(self) -> Option<u64> {
        (self == Memory::Sockets).then_some(NO_POOL)
    }
}

/// Looks at the machine for a run, and makes the best of it.
///
/// # Errors
/// What keeps the run from running, with what helps.
pub fn prepare(name: &str, graph: &FlatGraph) -> Result<Memory> {
    for check in [descriptors(), threads(threads_of(graph.processes().len())), loopback()] {
        if let Err(reason) = check.found {
            bail!("{name}: nothing was started: {reason}");
        }
    }
    free_orphans();
    let needed = shared_memory_of(graph);
    Ok(match free_shared() {
        Some(free) if free >= needed => Memory::Shared,
        free => {
            eprintln!("realo: {name}: {}", through_sockets(free, needed));
            Memory::Sockets
        }
    })
}

/// All that `realo doctor` looks at on the machine.
pub fn checks(graph: Option<&FlatGraph>) -> Vec<Check> {
    let needed = graph.map_or(PROCESSES * (POOL as u64 + WITH_NETWORKS), shared_memory_of);
    // The next run frees what processes that are gone have left.
    let left: u64 = orphans().iter().map(|orphan| orphan.bytes).sum();
    let free = free_shared().map(|free| free + left);
    let shared = Check {
        what: "shared memory",
        found: Ok(match free {
            Some(free) if free >= needed => format!("{} MiB free in {SHARED}, {} needed", free / MIB, needed / MIB),
            free => through_sockets(free, needed),
        }),
    };
    let needed = threads_of(graph.map_or(PROCESSES as usize, |graph| graph.processes().len()));
    vec![shared, descriptors(), threads(needed), loopback()]
}

fn through_sockets(free: Option<u64>, needed: u64) -> String {
    let found = match free {
        Some(free) => format!("has {} MiB free", free / MIB),
        None => "cannot be written".into(),
    };
    format!(
        "{SHARED} {found} and the graph may need {} MiB: its messages go through sockets, which costs some time; in a \
         container --shm-size={}m (docker, podman) mends it",
        needed / MIB,
        (needed / MIB).next_multiple_of(256)
    )
}

/// What is free; `None` where nobody can write.
fn free_shared() -> Option<u64> {
    let found = statvfs(SHARED).ok()?;
    let probe = Path::new(SHARED).join(format!(".realo-{}", std::process::id()));
    std::fs::File::create(&probe).ok()?;
    let _ = std::fs::remove_file(&probe);
    Some(found.f_bavail * found.f_frsize)
}

/// Shared memory of Zenoh that no process has open.
struct Orphan {
    path: PathBuf,
    /// Bytes that it holds.
    bytes: u64,
    /// Is locked, so that nobody begins to use it before it is removed.
    _lock: File,
}

/// What processes that were killed left in shared memory. Zenoh takes such files away when it makes the first of its own, which it
/// does not where messages go through sockets because these files fill the memory.
fn orphans() -> Vec<Orphan> {
    let entries = std::fs::read_dir(SHARED).into_iter().flatten().flatten();
    let found = entries.filter_map(|entry| {
        let path = entry.path();
        let is_zenoh = path.extension().is_some_and(|kind| kind == "zenoh");
        path.file_stem()?.to_str()?.parse::<u64>().ok().filter(|_| is_zenoh)?;
        let file = File::options().read(true).write(true).open(&path).ok()?;
        let about = file.metadata().ok()?;
        // Whoever has just made it may not have locked it yet.
        let is_new = about.modified().ok()?.elapsed().is_ok_and(|age| age < NEW);
        // All that use it hold a shared lock.
        let is_orphan = !is_new && file.try_lock().is_ok();
        is_orphan.then_some(Orphan {
            path,
            bytes: about.blocks() * 512,
            _lock: file,
        })
    });
    found.collect()
}

/// Frees shared memory of Zenoh that no process has open.
pub fn free_orphans() {
    for orphan in orphans() {
        // What is not ours stays.
        let _ = std::fs::remove_file(&orphan.path);
    }
}

/// Refuses a system that has too few threads for runs in virtual time.
///
/// # Errors
/// What helps.
pub fn threads_of_virtual() -> Result<()> {
    match threads(cores() + THREADS_OF_VIRTUAL).found {
        Ok(_) => Ok(()),
        Err(reason) => bail!("nothing was run: {reason}"),
    }
}

/// Threads that a graph of so many processes has on dora.
fn threads_of(processes: usize) -> usize {
    let of_cores = THREADS_OF_A_CORE * cores();
    THREADS_OF_DORA + of_cores + processes * (THREADS_OF_A_PROCESS + of_cores)
}

/// Cores that this process may use.
pub(crate) fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Whether so many threads can be had now, by starting them: limits of users, services and containers all count.
fn threads(needed: usize) -> Check {
    let (hold, held) = std::sync::mpsc::channel::<()>();
    let held = Arc::new(Mutex::new(held));
    let mut started = Vec::new();
    let mut refused = None;
    for _ in 0..needed {
        let held = held.clone();
        let wait = move || {
            let held = held.lock().unwrap_or_else(PoisonError::into_inner);
            // Ends when nothing more is tried.
            let _ = held.recv();
        };
        match std::thread::Builder::new().stack_size(STACK).spawn(wait) {
            Ok(thread) => started.push(thread),
            Err(error) => {
                refused = Some(error);
                break;
            }
        }
    }
    let could = started.len();
    drop(hold);
    for thread in started {
        let _ = thread.join();
    }
    Check {
        what: "threads",
        found: match refused {
            None => Ok(format!("{needed} can be started")),
            Some(error) => Err(format!(
                "{needed} threads are needed, {could} can be started ({error}): {MORE_PROCESSES}"
            )),
        },
    }
}

/// Bytes of shared memory that the processes of a graph may take.
fn shared_memory_of(graph: &FlatGraph) -> u64 {
    let networks = deciding(graph, roles::MODEL).next().is_some();
    let each = POOL as u64 + if networks { WITH_NETWORKS } else { 0 };
    graph.processes().len() as u64 * each
}

/// Takes as many file descriptors as the system allows; nodes inherit them.
fn descriptors() -> Check {
    let limit = getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: limit.maximum,
        maximum: limit.maximum,
    };
    // Where it is refused, the limit stays as it is.
    let _ = setrlimit(Resource::Nofile, raised);
    let current = getrlimit(Resource::Nofile).current;
    let found = match current {
        Some(current) if current < DESCRIPTORS => Err(format!(
            "{current} file descriptors are allowed, a graph on dora needs {DESCRIPTORS}: `ulimit -n 1024` before the \
             command (a service: LimitNOFILE=1024; docker: --ulimit nofile=1024), or --mode virtual"
        )),
        Some(current) => Ok(format!("{current} allowed")),
        None => Ok("as many as wanted".into()),
    };
    Check {
        what: "file descriptors",
        found,
    }
}

/// dora and its nodes talk over it.
fn loopback() -> Check {
    let tried = TcpListener::bind("127.0.0.1:0").and_then(|listener| TcpStream::connect(listener.local_addr()?));
    let found = tried.map(|_| "127.0.0.1 answers".into()).map_err(|error| {
        format!(
            "127.0.0.1 does not answer ({error}), and dora and its nodes talk over it: bring it up (`ip link set lo up`), or \
             --mode virtual"
        )
    });
    Check {
        what: "loopback interface",
        found,
    }
}

/// What a graph that others reach says at its start; nothing where it takes messages of trusted agents alone.
pub fn open_doors(graph: &FlatGraph) -> Vec<String> {
    let radios = graph
        .nodes
        .iter()
        .filter(|node| node.stage() == Some(("node", "radio")));
    let open = radios.filter(|node| {
        let is_reached = given(node, "listen").is_some_and(is_reached);
        is_reached
            && ["key", "trust"]
                .iter()
                .any(|file| given(node, file).is_none_or(str::is_empty))
    });
    let line = |node: &realo_graph::FlatNode| {
        format!(
            "node `{}` listens on {} and takes messages of everybody who can reach it; to require keys: `realo keys new`, \
             then --set {}.key=FILE --set {}.trust=FILE (docs/reference/machines.md)",
            node.id,
            given(node, "listen").unwrap_or_default(),
            node.id,
            node.id
        )
    };
    open.map(line).collect()
}

/// Whether other machines reach one of these addresses, which commas separate.
fn is_reached(listen: &str) -> bool {
    let addresses = listen.split(',').map(|text| text.trim().parse::<Endpoint>());
    // What is not an address is refused elsewhere.
    addresses.flatten().any(|address| !address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_that_others_reach_needs_a_key_and_whom_to_trust() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dataflows/late_fusion.vehicle.yml");
        let said = |settings: &[(&str, &str)]| {
            let mut graph = FlatGraph::load(&file).unwrap();
            settings
                .iter()
                .for_each(|(key, value)| graph.set("v2x", key, value).unwrap());
            open_doors(&graph).join("\n")
        };
        for listen in [
            "tcp/0.0.0.0:7447",
            "tcp/192.168.1.7:7447",
            "tcp/127.0.0.1:7447,tcp/car.local:7449",
        ] {
            assert!(said(&[("listen", listen)]).contains(listen), "{listen}");
        }
        assert_eq!(said(&[("listen", "tcp/127.0.0.1:7447,tcp/[::1]:7449")]), "");
        let key = ("key", "cav1.key");
        assert!(said(&[key]).contains("v2x.trust=FILE"));
        assert_eq!(said(&[key, ("trust", "trust.toml")]), "");
    }

    #[test]
    fn sockets_take_the_place_of_shared_memory() {
        assert_eq!(Memory::Shared.overlay(), OVERLAY);
        let overlay = Memory::Sockets.overlay();
        assert!(
            overlay.contains("{ transport: { shared_memory: { enabled: false }, link: {"),
            "{overlay}"
        );
        assert_eq!(overlay.matches('{').count(), overlay.matches('}').count(), "{overlay}");
        assert!(through_sockets(Some(64 * MIB), 192 * MIB).contains("--shm-size=256m"));
    }
}

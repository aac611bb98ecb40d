//! Graphs and modules that somebody damaged, by accident or on purpose: a graph or an error that names the file; no panic,
//! and neither more time nor more memory than their size allows.
//!
//! `REALO_FUZZ_CASES=1000000 cargo test --release -p realo-graph --test fuzz` runs as many cases.
#![allow(clippy::result_large_err)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use damage::{Draw, cases, damaged_yaml, most_held};
use realo_graph::{FlatGraph, Graph, GraphError, hosted, validate};
use realo_operator::Registry;

/// A case takes some milliseconds; a machine that is busy with other things gets its time.
const LONGEST: Duration = Duration::from_secs(20);

/// Memory for files of so many bytes: the parser takes 800 for each list in a list, which are two.
fn bound(bytes: usize) -> u64 {
    (64 << 20) + 512 * bytes as u64
}

/// A folder in memory where there is one: a case is a file.
fn folder() -> tempfile::TempDir {
    let shm = Path::new("/dev/shm");
    match shm.is_dir() {
        true => tempfile::tempdir_in(shm).unwrap(),
        false => tempfile::tempdir().unwrap(),
    }
}

/// The shipped graphs and modules, by their path from the folder of graphs.
fn shipped() -> BTreeMap<PathBuf, String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dataflows");
    let mut files = BTreeMap::new();
    for below in ["", "modules"] {
        for entry in fs::read_dir(root.join(below)).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|extension| extension == "yml") {
                let name = Path::new(below).join(path.file_name().unwrap());
                files.insert(name, fs::read_to_string(&path).unwrap());
            }
        }
    }
    files
}

/// Reads a file as the program does, as a graph or as a module that a process hosts; whether it is one.
fn read(root: &Path, file: &Path, thorough: bool) -> Result<FlatGraph, GraphError> {
    let is_module = file.parent().is_some_and(|folder| folder.ends_with("modules"));
    let flat = match is_module {
        true => hosted(
            "ego",
            &file.to_string_lossy(),
            &["nms.threshold=0.3".into()],
            None,
            root,
        )
        .or_else(|_| hosted("ego", &file.to_string_lossy(), &[], None, root)),
        false => {
            let graph = Graph::load(&root.join(file))?;
            if thorough {
                let _ = graph.clone().with_detection("recorded").expand();
            }
            graph.expand()
        }
    }?;
    let _ = flat.ranks(&Registry(&[]));
    let _ = validate(&flat, &Registry(&[])).iter().map(ToString::to_string).count();
    // What is written for dora is read as the same processes, or not at all.
    if thorough
        && let Ok(text) = flat.to_yaml()
        && let Ok(again) = Graph::parse(&text, &root.join("again.yml")).and_then(|graph| graph.expand())
    {
        assert_eq!(again.processes().len(), flat.processes().len());
    }
    Ok(flat)
}

/// Reads a file within bounds; the error, if it is none.
fn check(root: &Path, file: &Path, bytes: usize, case: &str, thorough: bool) -> Option<String> {
    let begun = Instant::now();
    let mut error = None;
    let held = most_held(|| error = read(root, file, thorough).err());
    assert!(held <= bound(bytes), "{case} of {bytes} bytes took {held} bytes");
    assert!(begun.elapsed() <= LONGEST, "{case} took {:?}", begun.elapsed());
    let error = error.map(|error| error.to_string());
    if let Some(error) = &error {
        assert!(
            error.contains('/') || error.contains(".yml"),
            "{case}: no file in {error}"
        );
        assert!(error.len() < 40_000, "{case}: a message of {} bytes", error.len());
    }
    error
}

const WORDS: &[&str] = &[
    "nodes",
    "id",
    "path",
    "args",
    "module",
    "inputs",
    "outputs",
    "inputs_optional",
    "params",
    "env",
    "build",
    "deploy",
    "name",
    "source",
    "queue_size",
    "input_timeout",
    "input_types",
    "output_types",
    "strict_types",
    "operator",
    "bin/realo",
    "../bin/realo",
    "/bin/true",
    "modules/sense.yml",
    "sense.yml",
    "modules/lane.yml",
    "lane.yml",
    "modules/detect.network.yml",
    "detect.network.yml",
    "detect.recorded.yml",
    "../late_fusion.yml",
    "modules",
    "modules/none.yml",
    "/dev/zero",
    "/dev/null",
    "host modules/sense.yml",
    "host modules/v2x.yml link.seed=3",
    "host late_fusion.yml",
    "host modules",
    "host /dev/zero",
    "host",
    "host modules/fuse.boxes.yml nms.x",
    "host 'a",
    "operator nms threshold=0.2",
    "node player log=$PARAM_A",
    "program x.py",
    "program",
    "$PARAM_A$PARAM_A",
    "${_param.a}",
    "_mod/clouds",
    "_mod/none",
    "player/clouds",
    "ego/boxes",
    "ego.nms/boxes",
    "v2x/to_ego",
    "dora/logs/info/ego",
    "realo/v1/Boxes",
    "ego",
    "player",
    "a b",
    "",
];

#[test]
fn damaged_graphs_and_modules_are_graphs_or_errors() {
    let (files, dir) = (shipped(), folder());
    let root = dir.path();
    fs::create_dir(root.join("modules")).unwrap();
    for (name, text) in &files {
        fs::write(root.join(name), text).unwrap();
    }
    // A module of processes is read by the graphs that use it: a process cannot host it.
    let is_read_alone = |name: &Path, text: &str| !(name.starts_with("modules") && text.contains("args: host "));
    for (name, text) in files.iter().filter(|(name, text)| is_read_alone(name, text)) {
        assert_eq!(check(root, name, text.len(), &name.to_string_lossy(), true), None);
    }
    let names: Vec<&PathBuf> = files.keys().collect();
    // The graphs in which a file is read, or the file alone.
    let readers = |file: &PathBuf| {
        let named = file.to_string_lossy().into_owned();
        let uses = |name: &PathBuf| name == file || !name.starts_with("modules") && files[name].contains(&named);
        names
            .iter()
            .copied()
            .filter(|name| uses(name))
            .collect::<Vec<&PathBuf>>()
    };
    let (mut taken, mut refused) = (0u64, 0u64);
    // Every test process has cases of its own, so that several of them see more.
    let first: u64 = std::env::var("REALO_FUZZ_FIRST").map_or(0, |text| text.parse().expect("a number"));
    for case in first..first + cases(12_000) {
        let mut draw = Draw::new(case);
        let changed = draw.pick(&names);
        let bytes = damaged_yaml(&files[changed], &mut draw, WORDS);
        fs::write(root.join(changed), &bytes).unwrap();
        let (read, thorough) = (draw.pick(&readers(changed)), draw.chance(4));
        match check(
            root,
            read,
            bytes.len(),
            &format!("case {case} ({})", changed.display()),
            thorough,
        ) {
            None => taken += 1,
            Some(_) => refused += 1,
        }
        fs::write(root.join(changed), &files[changed]).unwrap();
    }
    assert!(
        taken > refused / 50 && refused > taken / 50,
        "{taken} taken, {refused} refused"
    );
    println!("{taken} taken, {refused} refused");
}

/// Each file of `hostile/` says in its first line what is said of it.
#[test]
fn kept_files_are_refused_with_the_reason() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hostile");
    let mut seen = 0;
    for entry in fs::read_dir(&root).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            continue;
        }
        let bytes = fs::read(&path).unwrap();
        let head = String::from_utf8_lossy(&bytes);
        let expected = head.lines().next().unwrap().trim_start_matches("# expected: ");
        let name = path.file_name().unwrap();
        let error = check(&root, Path::new(name), bytes.len(), &name.to_string_lossy(), true);
        let error = error.unwrap_or_else(|| panic!("{}: it was taken", path.display()));
        assert!(
            error.contains(expected),
            "{}: expected `{expected}`, found {error}",
            path.display()
        );
        seen += 1;
    }
    assert!(seen >= 16, "{seen}");
}

/// Files that are too long to be kept: each is made here, with the part of the message that it gets.
#[test]
fn what_grows_without_end_is_refused_soon() {
    let dir = folder();
    let root = dir.path();
    let many = |n: usize, item: &dyn Fn(usize) -> String| (0..n).map(item).collect::<String>();
    let nodes = |n: usize, rest: &str| many(n, &|k| format!("- {{ id: n{k}, path: x, {rest} }}\n"));
    let head = "module: { name: m, inputs_optional: [i] }\nnodes:\n";
    let long = "x".repeat(500_000);
    let uses = |n: usize, of: &str| many(n, &|k| format!("- {{ id: m{k}, module: {of} }}\n"));
    for k in 0..8 {
        fs::write(
            root.join(format!("ten{k}.yml")),
            format!("{head}{}", uses(10, &format!("ten{}.yml", k + 1))),
        )
        .unwrap();
    }
    fs::write(root.join("ten8.yml"), format!("{head}{}", nodes(1, ""))).unwrap();
    fs::write(root.join("hundred.yml"), format!("{head}{}", nodes(100, ""))).unwrap();
    fs::write(
        root.join("params.yml"),
        format!("{head}- {{ id: a, path: x, args: '{}' }}", "$PARAM_A ".repeat(9_000)),
    )
    .unwrap();
    fs::write(root.join("comment.yml"), format!("# {long}\n{head}{}", nodes(1, ""))).unwrap();
    let at_once = "brackets";
    let cases = [
        (format!("nodes:\n{}", uses(1, "ten1.yml")), "at most 1024 nodes"),
        (
            format!("nodes:\n{}", uses(1, "ten0.yml")),
            "more than 8 modules within each other",
        ),
        (format!("nodes:\n{}", nodes(20_000, "")), at_once),
        (
            format!("nodes:\n{}", many(20_000, &|k| format!("- id: n{k}\n  path: x\n"))),
            "at most 1024 nodes",
        ),
        (
            format!("nodes:\n- {{ id: a, module: hundred.yml, env: {{ A: {long} }} }}"),
            "bytes of text",
        ),
        (
            format!("nodes:\n- {{ id: a, module: hundred.yml, build: {long} }}"),
            "bytes of text",
        ),
        (
            format!("nodes:\n- {{ id: a, module: hundred.yml, deploy: {{ A: {long} }} }}"),
            "bytes of text",
        ),
        (
            format!("nodes:\n- {{ id: a, module: params.yml, params: {{ a: {long} }} }}"),
            "with the parameters in it",
        ),
        (format!("nodes:\n{}", uses(100, "comment.yml")), "bytes of text"),
        (
            format!(
                "nodes:\n- {{ id: a, path: x, outputs: [{}] }}",
                many(2000, &|k| format!("o{k},"))
            ),
            "at most 1000 entries",
        ),
        (format!("nodes:\n- {{ id: {long}, path: x }}"), "at most 200 letters"),
        (format!("? {long}\n: 1\nnodes: []"), "unknown key"),
        (
            format!("nodes: [{}]", "x,".repeat(400_000)),
            "expected a mapping, found `x`",
        ),
        (
            format!(
                "debug: &a [{}]\nenv: [{}]\nnodes: []",
                "x,".repeat(9_000),
                "*a,".repeat(9_000)
            ),
            "aliases",
        ),
        ("[".repeat(1 << 20), at_once),
        ("{a: ".repeat(1 << 18), at_once),
        ("- ".repeat(1 << 19), "recursion limit"),
        (format!("nodes: []\n#{}", " ".repeat(1 << 20)), "at most 1048576 bytes"),
    ];
    for (k, (text, expected)) in cases.iter().enumerate() {
        let name = format!("g{k}.yml");
        fs::write(root.join(&name), text).unwrap();
        let error = check(
            root,
            Path::new(&name),
            text.len().max(1 << 20),
            &format!("case {k}"),
            true,
        );
        let error = error.unwrap_or_else(|| panic!("{k}: it was taken; expected `{expected}`"));
        assert!(
            error.contains(expected),
            "{k}: expected `{expected}`, found {error:.500}"
        );
    }
    // What is large and sound is read; that nothing fits is said in bounded time, too.
    let wires = many(900, &|k| format!("i{k}: nowhere{k}/o, "));
    let large = format!(
        "nodes:\n{}",
        many(20, &|k| format!("- {{ id: n{k}, path: x, inputs: {{ {wires} }} }}\n"))
    );
    fs::write(root.join("large.yml"), &large).unwrap();
    assert_eq!(check(root, Path::new("large.yml"), large.len(), "large", true), None);
}

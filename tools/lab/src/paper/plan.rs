//! The runs of the tables: who cooperates, how late messages are, the method, the scene.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::Path;
use std::str::FromStr;

use eyre::{Result, WrapErr};
use realo_cli::campaign::{self, Item, Plan, Task, digest};
use serde_json::Value;

use super::worlds::Worlds;
use crate::measure::{Program, Programs, Tree, run};

/// The seed of the first scene: trainings see none from here on.
pub const FIRST_SEED: u64 = 900;
/// Scenes at most.
pub const MOST_SCENES: u64 = 100;

/// Who cooperates, and the paper's name for it.
pub const MODES: [(&str, &str); 3] = [
    ("v2v", "V2V: a vehicle and the other vehicles"),
    ("v2i", "V2I: a vehicle and the roadside units"),
    ("i2i", "I2I: a roadside unit and the others"),
];

/// How late messages are, and the options that say so.
pub const WAYS: [(&str, &[&str]); 3] = [
    ("offline", &["--offline"]),
    ("delayed", &["--mode", "virtual", "--link", "paper"]),
    (
        "online",
        &["--mode", "virtual", "--link", "paper", "--compute", "paper"],
    ),
];

/// The methods, and their names in tables. What computes longest is first, since the time of all runs is told by the first.
pub const METHODS: [(&str, &str); 6] = [
    ("v2xvit", "V2X-ViT"),
    ("attfuse", "AttFuse"),
    ("fcooper", "F-Cooper"),
    ("early_fusion", "early fusion"),
    ("late_fusion", "late fusion"),
    ("no_fusion", "no fusion"),
];

/// Benches whose figures are in the tables of messages and times.
pub const BENCHES: [&str; 2] = ["transmission", "network"];

/// What results depend on, below the root.
const SOURCES: [&str; 9] = [
    "Cargo.lock",
    "Cargo.toml",
    "schemas",
    "operators",
    "nodes",
    "tools",
    "dataflows",
    "models",
    "python",
];

/// A cell of the tables: a method in a mode, one way.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cell {
    mode: &'static str,
    way: &'static str,
    method: &'static str,
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}/{}/{}", self.mode, self.way, self.method)
    }
}

/// One of some names.
fn one<T: Copy>(of: &[(&'static str, T)], name: &str, what: &str) -> Result<&'static str, String> {
    let found = of.iter().map(|(known, _)| *known).find(|known| *known == name);
    let known = || of.iter().map(|(known, _)| *known).collect::<Vec<_>>().join(", ");
    found.ok_or_else(|| format!("{what}: expected one of {}, found `{name}`", known()))
}

impl FromStr for Cell {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let &[mode, way, method] = &*text.split('/').collect::<Vec<_>>() else {
            return Err(format!(
                "expected MODE/WAY/METHOD, as v2v/online/attfuse, found `{text}`"
            ));
        };
        Ok(Cell {
            mode: one(&MODES, mode, "mode")?,
            way: one(&WAYS, way, "way")?,
            method: one(&METHODS, method, "method")?,
        })
    }
}

/// Every cell.
pub fn cells() -> impl Iterator<Item = Cell> {
    let modes = MODES.iter().map(|(mode, _)| *mode);
    modes.flat_map(|mode| {
        let ways = WAYS.iter().map(|(way, _)| *way);
        ways.flat_map(move |way| METHODS.iter().map(move |(method, _)| Cell { mode, way, method }))
    })
}

/// What an item of the plan is.
enum Work {
    Bench(&'static str),
    Run(Cell, u64),
}

/// All runs.
pub struct Runs {
    /// Benches, then scene by scene.
    pub plan: Plan,
    /// Scenes.
    pub scenes: u64,
    /// Seconds of each.
    pub seconds: u64,
    works: BTreeMap<String, Work>,
}

impl Runs {
    /// The runs over so many scenes by the sources of a tree.
    ///
    /// # Errors
    /// A tree that git does not know.
    pub fn new(scenes: u64, seconds: u64, tree: &Tree) -> Result<Self> {
        let parts = sources(tree)?;
        let mut works = BTreeMap::new();
        let mut items = Vec::new();
        let mut add = |key: String, work: Work| {
            items.push(Item {
                key: key.clone(),
                parts: parts.clone(),
            });
            works.insert(key, work);
        };
        for bench in BENCHES {
            add(bench_key(bench), Work::Bench(bench));
        }
        for scene in 0..scenes {
            for cell in cells() {
                add(run_key(&cell, scene), Work::Run(cell, scene));
            }
        }
        let values = [("--scenes", scenes), ("--seconds", seconds)];
        let values = campaign::values(values.map(|(name, value)| (name, value.to_string())));
        Ok(Runs {
            plan: Plan::new("paper", values, items)?,
            scenes,
            seconds,
            works,
        })
    }

    /// Whether an item is a run of one of these cells.
    pub fn is_of(&self, item: &Item, cells: &[Cell]) -> bool {
        matches!(&self.works[&item.key], Work::Run(cell, _) if cells.contains(cell))
    }

    /// Makes a run in its folder; of a bench what it printed.
    ///
    /// # Errors
    /// A program that failed, with its last lines.
    pub fn make(&self, item: &Item, folder: &Path, worlds: &Worlds, programs: &Programs, root: &Path) -> Result<Value> {
        let folder = std::path::absolute(folder)?;
        let kept = folder.join("printed");
        match &self.works[&item.key] {
            Work::Bench(name) => {
                let args = ["bench", name, "--json"].map(String::from);
                run(programs.path(Program::Lab), &args, root, &kept)?;
                let printed = kept.with_added_extension("stdout");
                let text = fs::read_to_string(&printed).wrap_err_with(|| printed.display().to_string())?;
                serde_json::from_str(&text).wrap_err_with(|| printed.display().to_string())
            }
            Work::Run(cell, scene) => {
                let log = worlds.log(*scene)?;
                let ways = WAYS.iter().find(|(way, _)| *way == cell.way);
                let mut args: Vec<String> = vec!["run".into(), format!("dataflows/{}.yml", cell.method)];
                args.extend(
                    ways.into_iter()
                        .flat_map(|(_, options)| options.iter().map(|word| word.to_string())),
                );
                args.extend(["--coop", cell.mode, "--isa", "avx2", "--log"].map(String::from));
                args.extend([
                    log.display().to_string(),
                    "--out".into(),
                    folder.join("run").display().to_string(),
                ]);
                run(programs.path(Program::Realo), &args, root, &kept)?;
                Ok(Value::Null)
            }
        }
    }
}

/// How many benches are among tasks, which are in the order of the plan.
pub fn benches(tasks: &[Task]) -> usize {
    tasks.iter().take_while(|task| task.item < BENCHES.len()).count()
}

/// Puts the first run first, since its time says how long the others take, and then the benches, beside which nothing runs.
pub fn order(tasks: &mut [Task]) {
    let benches = benches(tasks);
    let Some(first) = tasks.get_mut(..=benches) else {
        wait(tasks, benches);
        return;
    };
    first.rotate_right(1);
    wait(tasks, if benches == 0 { 0 } else { benches + 1 });
}

/// Has each task wait for all before it, but for those after the first few, which wait for these.
fn wait(tasks: &mut [Task], first: usize) {
    for (place, task) in tasks.iter_mut().enumerate() {
        task.after = (0..first.min(place)).collect();
    }
}

/// The key of a bench.
pub fn bench_key(name: &str) -> String {
    format!("bench/{name}")
}

/// The key of a run.
pub fn run_key(cell: &Cell, scene: u64) -> String {
    format!("{cell}/{}", FIRST_SEED + scene)
}

/// Git's names of the sources that results depend on, and a digest of changes that are in no commit.
fn sources(tree: &Tree) -> Result<BTreeMap<String, String>> {
    let mut parts = BTreeMap::new();
    for source in SOURCES {
        let known = tree.git(&["rev-parse", "--short=12", &format!("HEAD:{source}")])?;
        parts.insert(source.to_string(), known);
    }
    let changes = tree.git(&[&["diff", "HEAD", "--"][..], &SOURCES].concat())?;
    if !changes.is_empty() {
        parts.insert("changes".into(), digest(&changes));
    }
    Ok(parts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_timed_before_the_benches_and_nothing_runs_beside_them() {
        let ordered = |items: &[usize]| {
            let task = |item: &usize| Task {
                item: *item,
                after: Default::default(),
            };
            let mut tasks: Vec<Task> = items.iter().map(task).collect();
            order(&mut tasks);
            let after = |task: &Task| (task.item, task.after.iter().copied().collect::<Vec<_>>());
            tasks.iter().map(after).collect::<Vec<_>>()
        };
        assert_eq!(
            ordered(&[0, 1, 2, 3]),
            [(2, vec![]), (0, vec![0]), (1, vec![0, 1]), (3, vec![0, 1, 2])]
        );
        assert_eq!(ordered(&[1, 7]), [(7, vec![]), (1, vec![0])]);
        assert_eq!(ordered(&[0, 1]), [(0, vec![]), (1, vec![0])]);
        assert_eq!(ordered(&[4, 7]), [(4, vec![]), (7, vec![])]);
        assert_eq!(ordered(&[]), []);
    }

    #[test]
    fn a_cell_is_named_by_mode_way_and_method() {
        assert_eq!(cells().count(), MODES.len() * WAYS.len() * METHODS.len());
        for cell in cells() {
            assert_eq!(cell.to_string().parse::<Cell>().unwrap(), cell);
        }
        for (text, expected) in [
            ("v2v/online", "expected MODE/WAY/METHOD"),
            ("v2x/online/attfuse", "mode: expected one of v2v, v2i, i2i, found `v2x`"),
            ("v2v/late/attfuse", "way: expected one of offline, delayed, online"),
            ("v2v/online/attfuze", "method: expected one of v2xvit"),
        ] {
            let error = text.parse::<Cell>().unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }
}

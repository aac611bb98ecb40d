//! Finds scenes, agents and frames below a folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use realo_logs::AgentKind;

use super::super::folders::{Listed, frame_of, list, name_of, scene_name};
use super::frame_file::FrameFile;
use crate::scenes::{Found, Lost, Scene, SceneAgent, SweepFiles, agent_name};
use crate::{ImportError, Options};

/// Folders between the one that is given and an agent's, at most: the split, the scene, and one more.
const DEEPEST: usize = 4;
/// How names of label files end.
const LABELS: &str = "yaml";
/// What follows the number in names of clouds where an agent has several LiDARs: the first one counts, whose pose the labels have.
const FIRST_LIDAR: &str = "_lidar0";

/// The number of a cloud, the beginning of its name, and how that ends.
fn cloud_of(name: &str) -> Option<(u64, &str, &str)> {
    let (stem, end) = name.rsplit_once('.')?;
    let (digits, _) = name.split_at(stem.strip_suffix(FIRST_LIDAR).unwrap_or(stem).len());
    let is_number = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    Some((digits.parse().ok().filter(|_| is_number)?, digits, end))
}

/// Whether a folder has frames of an agent.
fn is_agent(listed: &Listed, clouds: &[&str]) -> bool {
    let is_frame = |name: &String| {
        frame_of(name).is_some_and(|(_, end)| end == LABELS)
            || cloud_of(name).is_some_and(|(_, _, end)| clouds.contains(&end))
    };
    listed.files.iter().any(is_frame)
}

/// Sweeps by their numbers. What is missing has the name that it should have.
fn sweeps(listed: &Listed, dir: &Path, clouds: &[&str]) -> BTreeMap<u64, SweepFiles> {
    let mut stems = BTreeMap::<u64, &str>::new();
    for name in &listed.files {
        let labels = frame_of(name).filter(|(_, end)| *end == LABELS);
        let labels = labels.map(|(number, end)| (number, &name[..name.len() - end.len() - 1]));
        let cloud = cloud_of(name).filter(|(_, _, end)| clouds.contains(end));
        if let Some((number, stem)) = labels.or(cloud.map(|(number, stem, _)| (number, stem))) {
            stems.entry(number).or_insert(stem);
        }
    }
    let sweep = |(number, stem): (u64, &str)| {
        let ends = clouds.iter().copied();
        let mut names = ends
            .clone()
            .flat_map(|end| [format!("{stem}.{end}"), format!("{stem}{FIRST_LIDAR}.{end}")]);
        let there = names.find(|name| listed.files.contains(name));
        let missing = || format!("{stem}.{}", ends.clone().next().unwrap_or_default());
        let files = SweepFiles {
            cloud: dir.join(there.unwrap_or_else(missing)),
            labels: dir.join(format!("{stem}.{LABELS}")),
            ..SweepFiles::default()
        };
        (number, files)
    };
    stems.into_iter().map(sweep).collect()
}

/// Whether a folder's name is an agent's: a number.
pub fn is_number(name: &str) -> bool {
    let digits = name.strip_prefix('-').unwrap_or(name);
    !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit())
}

/// Walks down and collects the scenes.
struct Walk<'a> {
    root: &'a Path,
    clouds: Vec<&'a str>,
    /// Folders of roadside units, besides negative ones.
    roadside: &'a [&'a str],
    /// Whether one scene with labels is enough.
    is_brief: bool,
    found: Found,
}

impl Walk<'_> {
    fn walk(&mut self, dir: &Path, depth: usize) -> Result<(), ImportError> {
        let listed = list(dir)?;
        let mut agents = Vec::new();
        let mut empty = Vec::new();
        for folder in &listed.folders {
            let inside = list(folder)?;
            if self.is_enough() {
                return Ok(());
            }
            if is_agent(&inside, &self.clouds) {
                agents.push((folder.clone(), inside));
            } else if is_number(&name_of(folder)) && inside.folders.is_empty() {
                empty.push(folder.clone());
            } else if depth < DEEPEST {
                self.walk(folder, depth + 1)?;
            }
        }
        for folder in empty {
            let name = folder.strip_prefix(self.root).unwrap_or(&folder).display().to_string();
            self.found.faults.add("folder of an agent without frames", name);
        }
        match agents.is_empty() {
            true => Ok(()),
            false => self.scene(dir, agents),
        }
    }

    /// Whether nothing more must be found.
    fn is_enough(&self) -> bool {
        self.is_brief && self.found.scenes.iter().any(|scene| first_file(scene).is_some())
    }

    fn scene(&mut self, dir: &Path, folders: Vec<(PathBuf, Rc<Listed>)>) -> Result<(), ImportError> {
        let name = scene_name(self.root, dir);
        let mut agents: Vec<SceneAgent> = Vec::new();
        let mut known: Vec<Known> = Vec::new();
        for (folder, listed) in folders {
            let sweeps = sweeps(&listed, &folder, &self.clouds);
            let folder = name_of(&folder);
            let first = first_of(&sweeps);
            let is_roadside = self.roadside.contains(&&*folder)
                || folder.starts_with('-')
                || first.as_ref().is_some_and(FrameFile::is_roadside);
            let kind = match is_roadside {
                true => AgentKind::Roadside,
                false => AgentKind::Vehicle,
            };
            let stated = first.map_or(Ok(None), |file| file.agent_name())?;
            known.push(Known {
                kind,
                folder,
                stated,
                sweeps,
            });
        }
        let are_named = known.iter().all(|known| known.stated.is_some());
        known.sort_by_key(|known| known.place(are_named));
        let names: BTreeMap<String, String> = stated_names(dir, &known)?;
        for Known {
            kind,
            folder,
            stated,
            sweeps,
        } in known
        {
            let taken = |name: &str| names.contains_key(name) || agents.iter().any(|agent| agent.name == name);
            let name = stated.unwrap_or_else(|| agent_name(&folder, kind, taken));
            agents.push(SceneAgent {
                folder,
                name,
                kind,
                sweeps,
            });
        }
        self.found.scenes.push(Scene {
            name,
            agents,
            unwanted: Vec::new(),
            assumed: Vec::new(),
            lost: Lost::default(),
        });
        Ok(())
    }
}

/// What is known of an agent before its sweeps are read.
struct Known {
    kind: AgentKind,
    folder: String,
    /// Its name, where its files say it.
    stated: Option<String>,
    sweeps: BTreeMap<u64, SweepFiles>,
}

impl Known {
    /// Its place among the agents: vehicles first, by their names where all have one, else by their folders; `cav2` before `cav10`.
    fn place(&self, are_named: bool) -> (AgentKind, String, i64, String) {
        let folder = &self.folder;
        let name = self.stated.as_ref().filter(|_| are_named);
        let stem = name.map_or("", |name| name.trim_end_matches(|c: char| c.is_ascii_digit()));
        let number = match name {
            Some(name) => name[stem.len()..].parse().unwrap_or(i64::MAX),
            None => folder.parse::<i64>().map_or(i64::MAX, i64::abs),
        };
        (self.kind, stem.into(), number, folder.clone())
    }
}

/// The first label file of an agent that can be read.
fn first_of(sweeps: &BTreeMap<u64, SweepFiles>) -> Option<FrameFile> {
    let mut files = sweeps.values().take(3);
    files.find_map(|files| FrameFile::read(&files.labels).ok())
}

/// The names that files state, each with the folder of its agent.
///
/// # Errors
/// A name of two agents.
fn stated_names(scene: &Path, known: &[Known]) -> Result<BTreeMap<String, String>, ImportError> {
    let mut names = BTreeMap::new();
    for Known { folder, stated, .. } in known {
        let Some(name) = stated else { continue };
        if let Some(other) = names.insert(name.clone(), folder.clone()) {
            let reason = format!(
                "agent_name: expected a name for each agent, found `{name}` in the files of `{other}` and of `{folder}`; correct one of \
                 them, or remove the key from all files of one"
            );
            return Err(ImportError::content(scene, reason));
        }
    }
    Ok(names)
}

/// The scenes below a folder, which may be the data set, a split, or a scene. `roadside`: folders of roadside units, besides negative ones.
///
/// # Errors
/// None at all, or the folder of an agent.
pub fn find(dir: &Path, clouds: &[&'static str], roadside: &[&str], options: &Options) -> Result<Found, ImportError> {
    let mut clouds: Vec<&str> = clouds.to_vec();
    if let Some(wanted) = options.cloud.as_deref() {
        clouds.sort_by_key(|end| *end != wanted);
    }
    found_in(dir, clouds, roadside, false)
}

fn found_in(dir: &Path, clouds: Vec<&str>, roadside: &[&str], is_brief: bool) -> Result<Found, ImportError> {
    if is_agent(list(dir)?.as_ref(), &clouds) {
        let reason = "expected a scene with a folder for each agent, found the frames of one agent; give the folder that it is in";
        return Err(ImportError::content(dir, reason));
    }
    let mut walk = Walk {
        root: dir,
        clouds,
        roadside,
        is_brief,
        found: Found::default(),
    };
    walk.walk(dir, 1)?;
    let Walk { found, clouds, .. } = walk;
    if found.scenes.is_empty() {
        let missing = match found.faults.by_cause.is_empty() {
            true => String::new(),
            false => format!("\n{}", found.faults.listed()),
        };
        // PLY is read, and what no set is shipped in.
        let usual: Vec<&str> = clouds.into_iter().filter(|end| *end != "ply").collect();
        let reason = format!(
            "expected SCENE/AGENT/000000.yaml with 000000.{} beside it, at most {DEEPEST} folders down, found none; unpack the data \
             set, or see what `import auto` says of this folder{missing}",
            usual.join(" or .")
        );
        return Err(ImportError::content(dir, reason));
    }
    Ok(found)
}

/// The first label file of a scene that can be read.
fn first_file(scene: &Scene) -> Option<(PathBuf, FrameFile)> {
    let mut files = scene
        .agents
        .iter()
        .flat_map(|agent| agent.sweeps.values().take(2))
        .take(20);
    files.find_map(|files| Some((files.labels.clone(), FrameFile::read(&files.labels).ok()?)))
}

/// The first label file below a folder that can be read, for a look at its keys.
pub fn first_labels(dir: &Path) -> Result<(PathBuf, FrameFile), String> {
    let found = found_in(dir, vec!["pcd", "bin"], &[], true).map_err(|error| error.to_string())?;
    let first = found.scenes.iter().find_map(first_file);
    first.ok_or_else(|| "no label file (`.yaml`) that can be read".into())
}

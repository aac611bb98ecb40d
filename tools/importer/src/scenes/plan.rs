//! Which scenes become which logs, and the work of writing them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, mpsc};

use realo_logs::Log;

use super::clock::Clock;
use super::frame::numbers;
use super::name::plain;
use super::write::{SceneImport, all_missing, source};
use super::{Found, Layout, Scene, SceneAgent, SceneSummary};
use crate::faults::listed;
use crate::{ImportError, Options};

/// Logs to be written.
pub struct Work {
    layout: &'static dyn Layout,
    dir: PathBuf,
    found: Found,
    clocks: Vec<Clock>,
    options: Options,
    outputs: Vec<PathBuf>,
}

/// Finds the scenes that are wanted. `output`: a log, for one scene, or a folder for a log of each.
///
/// # Errors
/// Another layout; scenes, agents or frames that do not exist; several scenes for one log.
pub fn plan(layout: &'static dyn Layout, dir: &Path, output: &Path, options: &Options) -> Result<Work, ImportError> {
    if !dir.is_dir() {
        let found = if dir.exists() { "a file" } else { "nothing" };
        let reason = format!("expected the folder of a data set, found {found}; give the folder that holds its scenes");
        return Err(ImportError::content(dir, reason));
    }
    let mut found = layout.find(dir, options)?;
    select_scenes(dir, &mut found.scenes, &options.scenes)?;
    leave_out(dir, &mut found.scenes, &options.without)?;
    let clocks: Vec<Clock> = found.scenes.iter().map(|scene| Clock::of(scene, options)).collect();
    select_agents(dir, &mut found.scenes, &options.agents)?;
    let empty = found.scenes.iter().find(|scene| numbers(scene, options).is_empty());
    if let Some(scene) = empty {
        let all = numbers(scene, &Options::default());
        let [from, to] = options.frames;
        let has = match (all.first(), all.last()) {
            (Some(first), Some(last)) => format!("{first} to {last}"),
            _ => "none".into(),
        };
        let reason = format!("--frames {from}..{to}: scene `{}` has frames {has}", scene.name);
        return Err(ImportError::content(dir, reason));
    }
    let outputs = outputs(dir, &found.scenes, output)?;
    Ok(Work {
        layout,
        dir: dir.into(),
        found,
        clocks,
        options: options.clone(),
        outputs,
    })
}

impl Work {
    /// The logs, one a scene.
    pub fn outputs(&self) -> &[PathBuf] {
        &self.outputs
    }

    /// Writes the logs; calls `progress` with the frames that are done, and all frames.
    ///
    /// # Errors
    /// All that is missing or damaged, at once; logs of scenes that are complete are written all the same.
    pub fn run(&self, progress: &mut dyn FnMut(u64, u64)) -> Result<Vec<SceneSummary>, ImportError> {
        let options = &self.options;
        let scenes = &self.found.scenes;
        let all: usize = scenes.iter().map(|scene| numbers(scene, options).len()).sum();
        progress(0, all as u64);
        let next = AtomicUsize::new(0);
        let made: Mutex<BTreeMap<usize, Result<SceneSummary, ImportError>>> = Mutex::default();
        let (sender, written_frames) = mpsc::channel();
        std::thread::scope(|scope| {
            for _ in 0..options.jobs.clamp(1, scenes.len().max(1)) {
                let (sender, next, made) = (sender.clone(), &next, &made);
                scope.spawn(move || {
                    loop {
                        let place = next.fetch_add(1, Ordering::Relaxed);
                        if place >= scenes.len() {
                            return;
                        }
                        // The receiver outlives all senders.
                        let summary = self.scene(place, || _ = sender.send(()));
                        if summary.is_err() {
                            // Most likely the next scene fails as well: the disk is full.
                            next.store(scenes.len(), Ordering::Relaxed);
                        }
                        let mut made = made.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                        made.insert(place, summary);
                    }
                });
            }
            drop(sender);
            (1..)
                .zip(written_frames)
                .for_each(|(done, ())| progress(done, all as u64));
        });
        let made = made.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner());
        let summaries = made.into_values().collect::<Result<Vec<SceneSummary>, ImportError>>()?;
        let incomplete: usize = summaries.iter().map(|summary| summary.incomplete_frames).sum();
        let incomplete = incomplete + self.found.lost;
        let lost: usize = scenes.iter().map(|scene| scene.lost.frames).sum();
        let is_found_whole = self.found.faults.by_cause.is_empty();
        let some = summaries.iter().any(|summary| summary.frames > 0);
        if some && (options.skip_incomplete || (incomplete == 0 && is_found_whole)) {
            return Ok(summaries);
        }
        let written = summaries.iter().filter_map(|summary| summary.log.as_deref());
        Err(ImportError::IncompleteFrames {
            path: self.dir.clone(),
            incomplete,
            frames: all + lost + self.found.lost,
            missing: listed(&all_missing(&summaries, &self.found.faults)),
            some,
            written: written.map(|log| log.display().to_string()).collect(),
        })
    }

    /// Writes the log of a scene, or finds that it is there; calls `progress` after each frame.
    fn scene(&self, place: usize, mut progress: impl FnMut()) -> Result<SceneSummary, ImportError> {
        let (scene, output, options) = (&self.found.scenes[place], &self.outputs[place], &self.options);
        if options.resume && output.exists() {
            let found = Log::open(output)?.info().source.clone();
            let expected = source(self.layout, scene);
            if found != expected {
                let reason = format!(
                    "--resume: expected the log of `{expected}`, found that of `{found}`; give another folder to -o, or remove it"
                );
                return Err(ImportError::content(output, reason));
            }
            let frames = numbers(scene, options).len();
            (0..frames).for_each(|_| progress());
            return Ok(SceneSummary::there(&scene.name, output, frames));
        }
        if let Some(folder) = output.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(ImportError::io(folder))?;
        }
        let clock = self.clocks[place].clone();
        let is_whole = scene.lost.frames == 0 && !self.found.is_unclear;
        let import = SceneImport::new(self.layout, &self.dir, scene, clock, options);
        import.run((is_whole || options.skip_incomplete).then_some(output), progress)
    }

    /// What is missing besides files of sweeps, and what is there in no scene, in words; empty without any.
    pub fn noted(&self) -> String {
        let Found { faults, unneeded, .. } = &self.found;
        let lines = [
            ("missing in the data set", faults),
            ("in the data set, and in no log", unneeded),
        ];
        let some = lines.iter().filter(|(_, found)| !found.by_cause.is_empty());
        let texts: Vec<String> = some
            .map(|(what, found)| format!("note: {what}:\n{}", found.listed()))
            .collect();
        texts.join("\n")
    }
}

/// Names as a message lists them, at most ten.
fn names<'a>(all: impl Iterator<Item = &'a str>) -> String {
    let all: Vec<&str> = all.collect();
    let shown: Vec<String> = all.iter().take(10).map(|name| format!("`{name}`")).collect();
    match all.len() > 10 {
        true => format!("{} and {} more", shown.join(", "), all.len() - 10),
        false => shown.join(", "),
    }
}

fn select_scenes(dir: &Path, scenes: &mut Vec<Scene>, wanted: &[String]) -> Result<(), ImportError> {
    let is = |scene: &Scene, name: &str| scene.name == name || scene.name.rsplit('/').next() == Some(name);
    if let Some(name) = wanted.iter().find(|name| !scenes.iter().any(|scene| is(scene, name))) {
        let reason = format!(
            "--scenes: there is no scene `{name}`; there are {}",
            names(scenes.iter().map(|scene| scene.name.as_str()))
        );
        return Err(ImportError::content(dir, reason));
    }
    scenes.retain(|scene| wanted.is_empty() || wanted.iter().any(|name| is(scene, name)));
    Ok(())
}

/// Leaves out scenes whose names contain a word.
fn leave_out(dir: &Path, scenes: &mut Vec<Scene>, words: &[String]) -> Result<(), ImportError> {
    let all = names(scenes.iter().map(|scene| scene.name.as_str()));
    scenes.retain(|scene| !words.iter().any(|word| scene.name.contains(word)));
    match scenes.is_empty() {
        false => Ok(()),
        true => {
            let reason = format!("--without leaves out every scene: {all}; give fewer or longer words");
            Err(ImportError::content(dir, reason))
        }
    }
}

/// Keeps the agents that are wanted, and the scenes that have any.
fn select_agents(dir: &Path, scenes: &mut [Scene], wanted: &[String]) -> Result<(), ImportError> {
    if wanted.is_empty() {
        return Ok(());
    }
    let is_there = |name: &&String| {
        let mut agents = scenes.iter().flat_map(|scene| &scene.agents);
        agents.any(|agent| agent.folder == **name || agent.name == **name)
    };
    let (there, missing): (Vec<&String>, Vec<&String>) = wanted.iter().partition(is_there);
    // Where none of them is there, the first scene without any is named.
    if !there.is_empty() && !missing.is_empty() {
        let folders: BTreeSet<&str> = scenes
            .iter()
            .flat_map(|scene| &scene.agents)
            .map(|agent| agent.folder.as_str())
            .collect();
        let reason = format!(
            "--agents: no scene has an agent {}; there are {}; correct the name, or leave it out",
            names(missing.into_iter().map(String::as_str)),
            names(folders.into_iter())
        );
        return Err(ImportError::content(dir, reason));
    }
    for scene in scenes {
        let all = names(scene.agents.iter().map(|agent| agent.folder.as_str()));
        let is_wanted = |agent: &SceneAgent| wanted.contains(&agent.folder) || wanted.contains(&agent.name);
        let unwanted = scene.agents.iter().filter(|agent| !is_wanted(agent));
        scene.unwanted = unwanted.map(|agent| agent.folder.clone()).collect();
        scene.agents.retain(is_wanted);
        if scene.agents.is_empty() {
            let reason = format!(
                "--agents: scene `{}` has none of them; it has {all}; choose it with --scenes",
                scene.name
            );
            return Err(ImportError::content(dir, reason));
        }
    }
    Ok(())
}

/// Where the log of each scene goes.
fn outputs(dir: &Path, scenes: &[Scene], output: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let is_log = output
        .extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("mcap"))
        && !output.is_dir();
    match (is_log, scenes.len()) {
        (true, 1) => Ok(vec![output.into()]),
        (true, several) => {
            let names = names(scenes.iter().map(|scene| scene.name.as_str()));
            let reason = format!(
                "a log is one scene, and there are {several}: {names}; give a folder to -o, or choose one with --scenes"
            );
            Err(ImportError::content(dir, reason))
        }
        (false, _) => Ok(file_names(scenes).into_iter().map(|name| output.join(name)).collect()),
    }
}

/// A name for the log of each scene, which no other has, whatever letters file systems tell apart.
fn file_names(scenes: &[Scene]) -> Vec<String> {
    let mut taken = BTreeSet::new();
    let name = |scene: &Scene| {
        let plain = plain_path(&scene.name);
        let numbered = (2..).map(|number| format!("{plain}_{number}"));
        let mut free = std::iter::once(plain.clone()).chain(numbered);
        let name = free.find(|name| taken.insert(name.to_lowercase()));
        format!("{}.mcap", name.expect("there is always another number"))
    };
    scenes.iter().map(name).collect()
}

/// The name of a scene as a file's: `-` for what parts folders.
fn plain_path(name: &str) -> String {
    let parts: Vec<String> = name.split('/').map(plain).collect();
    parts.join("-")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_whose_names_are_alike_as_files_have_logs_of_their_own() {
        let scene = |name: &str| Scene {
            name: name.into(),
            agents: Vec::new(),
            unwanted: Vec::new(),
            assumed: Vec::new(),
            lost: crate::scenes::Lost::default(),
        };
        let scenes = ["a/b", "a-b", "A-B", "a-b_2", "场景", "地点"].map(scene);
        let names = file_names(&scenes);
        assert_eq!(
            names,
            [
                "a-b.mcap",
                "a-b_2.mcap",
                "A-B_3.mcap",
                "a-b_2_2.mcap",
                "__.mcap",
                "___2.mcap"
            ]
        );
    }
}

//! An import that is ready to be run, and what comes of it.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::bag::BagSummary;
use crate::dair::Summary;
use crate::scenes::{self, Layout, SceneSummary, Work};
use crate::{ImportError, Options};

/// An import that can be run.
pub struct Job {
    outputs: Vec<PathBuf>,
    run: Run,
    /// What was assumed before, a line.
    assumed: Option<String>,
    /// What to try where it fails.
    hint: Option<String>,
    /// What belongs to what was imported.
    then: Option<Then>,
}

type Report<'a> = &'a mut dyn FnMut(&'static str, u64, u64);
type Then = Box<dyn FnOnce(&mut Imported)>;
type Run = Box<dyn FnOnce(Report) -> Result<Imported, ImportError>>;

impl Job {
    pub(super) fn new(
        outputs: Vec<PathBuf>,
        run: impl FnOnce(Report) -> Result<Imported, ImportError> + 'static,
    ) -> Self {
        Job {
            outputs,
            run: Box::new(run),
            assumed: None,
            hint: None,
            then: None,
        }
    }

    /// With what is done once all is written.
    pub(super) fn with(self, then: impl FnOnce(&mut Imported) + 'static) -> Self {
        Job {
            then: Some(Box::new(then)),
            ..self
        }
    }

    /// With what was assumed of the whole data set.
    pub(super) fn assuming(self, line: String) -> Self {
        Job {
            assumed: Some(line),
            ..self
        }
    }

    /// With what to try where it fails.
    pub(super) fn hinting(self, hint: String) -> Self {
        Job {
            hint: Some(hint),
            ..self
        }
    }

    /// Of scenes in one of the layouts.
    pub(super) fn of_scenes(
        layout: &'static dyn Layout,
        dir: &Path,
        output: &Path,
        options: &Options,
    ) -> Result<Self, ImportError> {
        let work: Work = scenes::plan(layout, dir, output, options)?;
        let outputs = work.outputs().to_vec();
        let run = move |report: Report| {
            let summaries = work.run(&mut |done, all| report("importing", done, all))?;
            Ok(Imported::Scenes(summaries, work.noted()))
        };
        Ok(Job::new(outputs, run))
    }

    /// The logs that it writes.
    pub fn outputs(&self) -> &[PathBuf] {
        &self.outputs
    }

    /// Writes the logs; calls `report` with what it is at, what is done, and all there is to do.
    ///
    /// # Errors
    /// All that is missing or damaged, at once.
    pub fn run(self, report: Report) -> Result<Imported, ImportError> {
        let mut imported = (self.run)(report).map_err(|error| match self.hint {
            Some(hint) => error.with_hint(hint),
            None => error,
        })?;
        if let Some(then) = self.then {
            then(&mut imported);
        }
        if let (Imported::Scenes(scenes, _), Some(line)) = (&mut imported, self.assumed) {
            scenes
                .iter_mut()
                .for_each(|scene| scene.assumed.insert(0, line.clone()));
        }
        Ok(imported)
    }
}

/// What was imported.
#[derive(Clone, Debug, PartialEq)]
pub enum Imported {
    /// Of DAIR-V2X-C.
    Dair(Summary),
    /// Of each scene, and what else is said of the data set, in lines.
    Scenes(Vec<SceneSummary>, String),
    /// Of bags of ROS.
    Bags(Box<BagSummary>),
}

impl Imported {
    /// The logs that were written; `None` where that is all that were asked for.
    pub fn logs(&self) -> Option<Vec<&Path>> {
        match self {
            Imported::Dair(_) | Imported::Bags(_) => None,
            Imported::Scenes(scenes, _) => Some(scenes.iter().filter_map(|scene| scene.log.as_deref()).collect()),
        }
    }
}

impl fmt::Display for Imported {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Imported::Dair(summary) => write!(f, "{summary}"),
            Imported::Bags(summary) => write!(f, "{summary}"),
            Imported::Scenes(scenes, noted) => {
                let texts: Vec<String> = scenes.iter().map(SceneSummary::to_string).collect();
                f.write_str(&texts.join("\n\n"))?;
                match noted.is_empty() {
                    true => Ok(()),
                    false => write!(f, "\n{noted}"),
                }
            }
        }
    }
}

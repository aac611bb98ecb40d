//! DAIR-V2X-C behind the trait of all kinds.

use std::path::Path;

use super::{Imported, Importer, Job, Kind};
use crate::dair::lists::{COOPERATIVE, LIST, ListOf, list_of};
use crate::dair::{DairOptions, DairStep, dair_with};
use crate::{ImportError, Options};

/// DAIR-V2X-C.
pub struct Dair;

static KIND: Kind = Kind {
    name: "dair",
    title: "DAIR-V2X-C in its original layout, images missing or not",
    needs: "cooperative/, vehicle-side/ and infrastructure-side/, each with data_info.json",
    unit: "pairs",
    paths: None,
    is_exact: true,
    options: &[("roadside-stamp", "start"), ("level", "pose"), ("skip-incomplete", "")],
};

impl Importer for Dair {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        match list_of(dir)? {
            (ListOf::DairC, why) => Ok(why),
            (ListOf::Seq, why) => Err(format!("{why}, as V2X-Seq-SPD")),
        }
    }

    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        let list = dir.join(COOPERATIVE).join(LIST);
        // Where there is none, all lists are looked for, and those that are missing are named together.
        if let Err(reason) = list_of(dir)
            && list.is_file()
        {
            return Err(ImportError::content(dir, reason));
        }
        let dair_options = DairOptions {
            roadside_stamp: options.roadside_stamp,
            level: options.level,
            skip_incomplete: options.skip_incomplete,
        };
        let (dir, output) = (dir.to_path_buf(), output.to_path_buf());
        let outputs = vec![output.clone()];
        Ok(Job::new(outputs, move |report| {
            let progress = |step, done, all| report(name(step), done, all);
            dair_with(&dir, &output, dair_options, progress).map(Imported::Dair)
        }))
    }
}

/// What a step is called.
fn name(step: DairStep) -> &'static str {
    match step {
        DairStep::Checking => "checking",
        DairStep::Writing => "importing",
    }
}

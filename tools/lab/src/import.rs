//! `realo-lab import`: other people's data to our logs.

mod kind;

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use clap::Subcommand;
use eyre::{Result, bail};
use realo_cli::{Force, Outcome, Output, Progress, one_of, report_left_out, unfinished};
use realo_importer::{FolderMemory, Imported, Importer, Level, Options};
use realo_logs::Log;

use self::kind::KindArgs;

/// Imports a data set
///
/// A log is one run of agents on one clock. So a data set of scenes becomes a log for each: give a folder to -o, or a file where
/// there is one scene, or --scenes chooses one.
#[derive(clap::Args)]
#[command(arg_required_else_help = true, args_conflicts_with_subcommands = true)]
pub struct Args {
    /// Name the kinds of data sets with what each needs
    #[arg(long)]
    list: bool,
    #[command(subcommand)]
    source: Option<Source>,
}

#[derive(Subcommand)]
enum Source {
    /// Say which kind of data set a folder is and why; with -o, import it with the options of that kind as they are by default
    Auto {
        /// The folder of the data set
        #[arg(value_name = "FOLDER")]
        dir: PathBuf,
        /// The log to write, or the folder for a log of each scene
        #[arg(short = 'o', long = "output")]
        output: Option<PathBuf>,
        #[allow(missing_docs, reason = "clap would print it")]
        #[command(flatten)]
        force: Force,
    },
    /// A log of realo whose body frames are not level: a copy in which they are
    Log {
        /// The log to read
        log: PathBuf,
        /// The log to write
        #[arg(short = 'o', long = "output")]
        output: PathBuf,
        #[allow(missing_docs, reason = "clap would print it")]
        #[command(flatten)]
        force: Force,
        /// By what: the recorded poses, or, where they have no roll and pitch, a plane through the ground around the sensor
        #[arg(long, value_parser = one_of(Level::ALL), default_value = "pose")]
        level: Level,
    },
    #[command(flatten)]
    Kind(KindArgs),
}

/// Writes the log and says what was taken and what was left out.
pub fn main(args: &Args) -> Result<Outcome> {
    if args.list {
        println!("{}", realo_importer::list());
        return Ok(Outcome::Complete);
    }
    match &args.source {
        None => Ok(Outcome::Complete),
        Some(Source::Auto { dir, output, force }) => {
            let look = Look::begin();
            let seen = realo_importer::look_at(dir);
            let importer = seen.only(dir)?;
            look.beside(|| println!("{seen}"));
            match output {
                Some(output) => import(look, importer, dir, output, *force, &importer.kind().defaults()),
                None => {
                    let next = seen.next(dir);
                    look.end();
                    println!("{next}");
                    Ok(Outcome::Complete)
                }
            }
        }
        Some(Source::Log {
            log,
            output,
            force,
            level,
        }) => relevel(log, output, *force, *level),
        Some(Source::Kind(args)) => {
            let options = args.options()?;
            import(
                Look::begin(),
                args.importer,
                &args.dir,
                &args.output,
                args.force,
                &options,
            )
        }
    }
}

/// The look over a folder before its import: what was listed is not listed again, and a terminal shows how far it is.
struct Look {
    _memory: FolderMemory,
    shown: Option<Rc<Progress>>,
}

impl Look {
    fn begin() -> Self {
        let is_seen = std::io::stderr().is_terminal();
        let shown = is_seen.then(|| Rc::new(Progress::new("looking", "folders", None)));
        let known = shown.clone();
        let look = move |folders: u64| {
            if let Some(shown) = &known {
                shown.set(folders as f64);
            }
        };
        Look {
            _memory: FolderMemory::new(look),
            shown,
        }
    }

    /// Prints beside the bar.
    fn beside(&self, print: impl FnOnce()) {
        match &self.shown {
            Some(shown) => shown.beside(print),
            None => print(),
        }
    }

    fn end(self) {}
}

fn import(
    look: Look,
    importer: &dyn Importer,
    dir: &Path,
    output: &Path,
    force: Force,
    options: &Options,
) -> Result<Outcome> {
    let job = importer.job(dir, output, options)?;
    look.end();
    let outputs = job.outputs().to_vec();
    for output in &outputs {
        is_no_source(
            output,
            std::iter::once(dir).chain(options.more.iter().map(PathBuf::as_path)),
        )?;
        force.check(output, Output::Log)?;
        unfinished::end_with_signals(output);
    }
    let unit = importer.kind().unit;
    let progress = Progress::new("importing", unit, Some(0.0));
    let mut at = "";
    let imported = job.run(&mut |step, done, all| {
        if std::mem::replace(&mut at, step) != step {
            progress.rename(step, unit);
            progress.begin(done as f64, all as f64);
        }
        progress.of(done as f64, all as f64);
    });
    progress.finish();
    let imported = imported?;
    outputs.iter().for_each(|output| unfinished::done(output));
    println!("{imported}");
    let asked = outputs.iter().map(PathBuf::as_path);
    let written: Vec<&Path> = imported.logs().unwrap_or_else(|| asked.collect());
    match written[..] {
        [log] => println!("{}", realo_logs::describe(log)?),
        _ => written.iter().for_each(|log| println!("written: {}", log.display())),
    }
    match &imported {
        Imported::Bags(summary) if summary.is_partial() => {
            eprintln!(
                "realo-lab: {}: part of a bag is missing (see `note:`); the log has what is left of it",
                output.display()
            );
            Ok(Outcome::Partial)
        }
        _ => Ok(Outcome::Complete),
    }
}

/// Refuses to write a log over what it is made of.
fn is_no_source<'a>(output: &Path, mut sources: impl Iterator<Item = &'a Path>) -> Result<()> {
    let Ok(own) = output.canonicalize() else { return Ok(()) };
    // Of a folder, parts of a bag.
    let is_of = |source: &Path| {
        let source = source.canonicalize();
        source.is_ok_and(|source| own == source || (own.starts_with(&source) && source.join("metadata.yaml").is_file()))
    };
    match sources.find(|source| is_of(source)) {
        Some(source) => bail!(
            "refuse to write `{}`: it is part of what is imported, `{}`; give another file to -o",
            output.display(),
            source.display()
        ),
        None => Ok(()),
    }
}

fn relevel(log: &Path, output: &Path, force: Force, level: Level) -> Result<Outcome> {
    is_no_source(output, std::iter::once(log))?;
    force.check(output, Output::Log)?;
    unfinished::end_with_signals(output);
    let progress = Progress::new("levelling", "s of the log", Some(0.0));
    let done = realo_importer::relevel_with(log, output, level, |done, all| progress.of(done, all));
    progress.finish();
    done?;
    unfinished::done(output);
    let log = &Log::open(log)?;
    report_left_out(log);
    let mut outcome = Outcome::Complete;
    if let Some(cut) = log.truncation() {
        eprintln!("realo-lab: {}: {cut}", log.path().display());
        outcome = Outcome::Partial;
    }
    println!("{}", realo_logs::describe(output)?);
    Ok(outcome)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_is_not_written_over_what_it_is_made_of() {
        let dir = tempfile::tempdir().unwrap();
        let (bag, own) = (dir.path().join("bag"), dir.path().join("own.mcap"));
        std::fs::create_dir(&bag).unwrap();
        for file in [&bag.join("metadata.yaml"), &bag.join("bag_0.mcap"), &own] {
            std::fs::write(file, "").unwrap();
        }
        let check = |output: &Path| is_no_source(output, [bag.as_path(), own.as_path()].into_iter());
        for output in [own.clone(), dir.path().join("bag/../own.mcap"), bag.join("bag_0.mcap")] {
            let error = check(&output).unwrap_err().to_string();
            assert!(error.contains("it is part of what is imported"), "{error}");
        }
        check(&dir.path().join("new.mcap")).unwrap();
        std::fs::write(dir.path().join("other.mcap"), "").unwrap();
        check(&dir.path().join("other.mcap")).unwrap();
    }
}

//! A subcommand for each kind of data set, made from the registry of the importer.

use std::path::PathBuf;

use clap::{Arg, ArgMatches, Args as _, Command, Error, FromArgMatches, Subcommand, value_parser};
use eyre::Result;
use realo_cli::Force;
use realo_importer::{Importer, KINDS, Kind, Options, importer, option_info};

use crate::option;

/// What was asked of a kind.
pub struct KindArgs {
    /// The kind.
    pub importer: &'static dyn Importer,
    /// The folder of the data set, or the first bag.
    pub dir: PathBuf,
    /// Further bags.
    more: Vec<PathBuf>,
    /// A log, or a folder for a log of each scene.
    pub output: PathBuf,
    /// Whether the output may be replaced.
    pub force: Force,
    /// Options with their texts.
    set: Vec<(&'static str, String)>,
}

impl KindArgs {
    /// The options of the import.
    pub fn options(&self) -> Result<Options> {
        let kind = self.importer.kind();
        let mut options = kind.defaults();
        options.more.clone_from(&self.more);
        for (name, text) in &self.set {
            kind.set(&mut options, name, text)?;
        }
        Ok(options)
    }
}

fn command(kind: &'static Kind) -> Command {
    let dir = Arg::new("dir").required(true).value_parser(value_parser!(PathBuf));
    let dir = match kind.paths {
        None => dir.value_name("FOLDER").help("The folder of the data set"),
        Some(help) => dir.value_name("PATH").num_args(1..).help(help),
    };
    let has_scenes = kind.options.iter().any(|(name, _)| *name == "scenes");
    let output = Arg::new("output")
        .short('o')
        .long("output")
        .value_name("OUTPUT")
        .required(true)
        .value_parser(value_parser!(PathBuf))
        .help(match has_scenes {
            true => "The log to write, `.mcap`, of one scene; else the folder for a log of each scene",
            false => "The log to write",
        });
    let command = Command::new(kind.name)
        .after_help(format!("Needs {}", kind.needs))
        .arg(dir)
        .arg(output);
    let options = kind
        .options
        .iter()
        .filter_map(|(name, default)| Some((option_info(name)?, *default)));
    let command = options.fold(command, |command, (info, default)| {
        command.arg(option::arg(info.name, info.help, info.value, info.choices, default))
    });
    // Arguments of a struct bring its text along.
    Force::augment_args(command).about(kind.title).long_about(None)
}

impl Subcommand for KindArgs {
    fn augment_subcommands(parent: Command) -> Command {
        KINDS
            .iter()
            .fold(parent, |parent, importer| parent.subcommand(command(importer.kind())))
    }

    fn augment_subcommands_for_update(parent: Command) -> Command {
        Self::augment_subcommands(parent)
    }

    fn has_subcommand(name: &str) -> bool {
        importer(name).is_ok()
    }
}

impl FromArgMatches for KindArgs {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let missing = || Error::new(clap::error::ErrorKind::MissingSubcommand);
        let (name, matches) = matches.subcommand().ok_or_else(missing)?;
        let importer = importer(name).map_err(|_| missing())?;
        let path = |id: &str| matches.get_one::<PathBuf>(id).cloned().ok_or_else(missing);
        let text = |(name, _): &(&'static str, &'static str)| {
            let text = match option_info(name)?.value {
                Some(_) => matches.get_one::<String>(name).cloned()?,
                None => matches.get_flag(name).then(String::new)?,
            };
            Some((*name, text))
        };
        let mut dirs = matches.get_many::<PathBuf>("dir").ok_or_else(missing)?.cloned();
        Ok(KindArgs {
            importer,
            dir: dirs.next().ok_or_else(missing)?,
            more: dirs.collect(),
            output: path("output")?,
            force: Force::from_arg_matches(matches)?,
            set: importer.kind().options.iter().filter_map(text).collect(),
        })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(words: &[&str]) -> Result<KindArgs, Error> {
        let command = KindArgs::augment_subcommands(Command::new("import"));
        command.clone().debug_assert();
        KindArgs::from_arg_matches(&command.try_get_matches_from([&["import"], words].concat())?)
    }

    #[test]
    fn every_kind_is_a_subcommand_with_its_options() {
        for importer in KINDS {
            let kind = importer.kind();
            let args = parsed(&[kind.name, "data", "-o", "out.mcap"]).unwrap();
            assert_eq!(args.importer.kind().name, kind.name);
            assert_eq!(args.options().unwrap(), kind.defaults());
        }
        let args = parsed(&[
            "opv2v",
            "data",
            "-o",
            "out",
            "--agents",
            "-1,641",
            "--skip-incomplete",
            "--handed",
            "right",
        ])
        .unwrap();
        let options = args.options().unwrap();
        assert_eq!(options.agents, ["-1", "641"]);
        assert!(options.skip_incomplete);
        let args = parsed(&[
            "dair",
            "data",
            "-o",
            "out.mcap",
            "--roadside-stamp",
            "end",
            "--level",
            "ground",
        ])
        .unwrap();
        assert_eq!(args.options().unwrap().level, realo_importer::Level::Ground);
        assert!(parsed(&["dair", "data", "-o", "out.mcap", "--handed", "left"]).is_err());
        assert!(parsed(&["dair", "data", "more", "-o", "out.mcap"]).is_err());
        let args = parsed(&["bag", "a.bag", "b.bag", "--map", "my.yml", "-o", "out.mcap"]).unwrap();
        let options = args.options().unwrap();
        assert_eq!((args.dir, options.more), ("a.bag".into(), vec!["b.bag".into()]));
        assert_eq!(options.map, Some("my.yml".into()));
    }
}

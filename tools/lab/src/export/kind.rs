//! A subcommand for each layout, made from the registry of the exporter.

use std::path::PathBuf;

use clap::{Arg, ArgAction, ArgMatches, Command, Error, FromArgMatches, Subcommand, value_parser};
use eyre::Result;
use realo_exporter::{Exporter, KINDS, Kind, Options, exporter, option_info};

use crate::option;

/// What was asked of a kind.
pub struct KindArgs {
    /// The kind.
    pub exporter: &'static dyn Exporter,
    /// The log to read.
    pub log: PathBuf,
    /// The folder to write.
    pub output: PathBuf,
    /// Whether an earlier export may be replaced.
    pub force: bool,
    /// Options with their texts.
    set: Vec<(&'static str, String)>,
}

impl KindArgs {
    /// The options of the export.
    pub fn options(&self) -> Result<Options> {
        let mut options = Options::default();
        for (name, text) in &self.set {
            self.exporter.kind().set(&mut options, name, text)?;
        }
        Ok(options)
    }
}

fn command(kind: &'static Kind) -> Command {
    let path = |id: &'static str| Arg::new(id).required(true).value_parser(value_parser!(PathBuf));
    let command = Command::new(kind.name)
        .about(kind.title)
        .after_help(format!("Writes {}", kind.writes))
        .arg(path("log").value_name("LOG").help("The log to read"))
        .arg(
            path("output")
                .short('o')
                .long("output")
                .value_name("PATH")
                .help("The folder to write: a new one, or one that is empty"),
        );
    let options = kind.options.iter();
    let options = options.filter_map(|(name, default)| Some((option_info(name)?, *default)));
    let command = options.fold(command, |command, (info, default)| {
        command.arg(option::arg(
            info.name,
            info.help,
            Some(info.value),
            info.choices,
            default,
        ))
    });
    let force = Arg::new("force").long("force").action(ArgAction::SetTrue);
    command.arg(force.help("Replace an earlier export; what another program wrote is never replaced"))
}

impl Subcommand for KindArgs {
    fn augment_subcommands(parent: Command) -> Command {
        KINDS
            .iter()
            .fold(parent, |parent, exporter| parent.subcommand(command(exporter.kind())))
    }

    fn augment_subcommands_for_update(parent: Command) -> Command {
        Self::augment_subcommands(parent)
    }

    fn has_subcommand(name: &str) -> bool {
        exporter(name).is_ok()
    }
}

impl FromArgMatches for KindArgs {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let missing = || Error::new(clap::error::ErrorKind::MissingSubcommand);
        let (name, matches) = matches.subcommand().ok_or_else(missing)?;
        let exporter = exporter(name).map_err(|_| missing())?;
        let path = |id: &str| matches.get_one::<PathBuf>(id).cloned().ok_or_else(missing);
        let text = |(name, _): &(&'static str, &'static str)| Some((*name, matches.get_one::<String>(name).cloned()?));
        Ok(KindArgs {
            exporter,
            log: path("log")?,
            output: path("output")?,
            force: matches.get_flag("force"),
            set: exporter.kind().options.iter().filter_map(text).collect(),
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
        let command = KindArgs::augment_subcommands(Command::new("export"));
        command.clone().debug_assert();
        KindArgs::from_arg_matches(&command.try_get_matches_from([&["export"], words].concat())?)
    }

    #[test]
    fn every_kind_is_a_subcommand_with_its_options() {
        for exporter in KINDS {
            let args = parsed(&[exporter.kind().name, "a.mcap", "-o", "out"]).unwrap();
            assert_eq!(args.exporter.kind().name, exporter.kind().name);
            assert_eq!(args.options().unwrap(), Options::default());
            assert!(!args.force);
        }
        let args = parsed(&[
            "kitti", "a.mcap", "-o", "out", "--agent", "cav1", "--height", "1.9", "--force",
        ])
        .unwrap();
        let options = args.options().unwrap();
        assert_eq!((options.agents, options.height_m), (vec!["cav1".into()], Some(1.9)));
        assert!(args.force);
        assert!(parsed(&["opv2v", "a.mcap", "-o", "out", "--agent", "cav1"]).is_err());
        assert!(parsed(&["opv2v", "a.mcap", "-o", "out", "--labels", "all"]).is_err());
    }
}

//! Options that registries of kinds name, on the command line.

use clap::builder::PossibleValuesParser;
use clap::{Arg, ArgAction};

/// The argument of an option: `value` is what its value is called, `None` for a flag; `choices` are all values, empty where any text may
/// come; `default` is empty for none.
pub fn arg(
    name: &'static str,
    help: &'static str,
    value: Option<&'static str>,
    choices: &'static [&'static str],
    default: &'static str,
) -> Arg {
    let arg = Arg::new(name).long(name).help(help);
    let Some(value) = value else {
        return arg.action(ArgAction::SetTrue);
    };
    let arg = arg.value_name(value).allow_hyphen_values(true);
    let arg = match choices {
        [] => arg,
        choices => arg.value_parser(PossibleValuesParser::new(choices.iter().copied())),
    };
    match default {
        "" => arg,
        default => arg.default_value(default),
    }
}

//! The commands of a program as a page.

use std::fmt::Write;

use clap::{Arg, Command};

/// How the page of all commands begins.
pub const HEAD: &str = "# Commands\n\n<!-- Written by `realo cli-reference` and `realo-lab cli-reference`. -->\n";

/// All commands of a program, with their arguments, as Markdown.
pub fn markdown(mut command: Command) -> String {
    // What clap adds while it reads a command line.
    command.build();
    let mut page = String::new();
    section(&mut page, &command, command.get_name(), 2);
    page
}

fn section(page: &mut String, command: &Command, name: &str, level: usize) {
    let about = command.get_long_about().or(command.get_about());
    let about = about.map(ToString::to_string).unwrap_or_default();
    let _ = write!(
        page,
        "\n{} {name}\n\n{}.\n",
        "#".repeat(level),
        about.trim_end_matches('.')
    );
    let visible = |arg: &&Arg| !arg.is_hide_set() && !matches!(arg.get_id().as_str(), "help" | "version");
    let mut arguments = command.get_arguments().filter(visible).peekable();
    if arguments.peek().is_some() {
        page.push_str("\n| argument | meaning |\n|---|---|\n");
    }
    for argument in arguments {
        let _ = writeln!(
            page,
            "| `{}` | {} |",
            in_cell(&form(argument)),
            in_cell(&meaning(argument))
        );
    }
    let visible = |command: &&Command| !command.is_hide_set() && command.get_name() != "help";
    for inner in command.get_subcommands().filter(visible) {
        section(page, inner, &format!("{name} {}", inner.get_name()), level + 1);
    }
}

/// How an argument is given.
fn form(argument: &Arg) -> String {
    let names = argument.get_value_names().unwrap_or_default();
    let names: Vec<&str> = names.iter().map(|name| name.as_str()).collect();
    let takes = argument.get_action().takes_values();
    let many = match argument.get_num_args() {
        Some(range) if range.max_values() > 1 => " …",
        _ => "",
    };
    let value = match names.is_empty() {
        true => argument.get_id().as_str().to_uppercase(),
        false => names.join(" "),
    };
    let mut flags: Vec<String> = Vec::new();
    flags.extend(argument.get_short().map(|short| format!("-{short}")));
    flags.extend(argument.get_long().map(|long| format!("--{long}")));
    match (flags.is_empty(), takes) {
        (true, _) if argument.is_required_set() => format!("{value}{many}"),
        (true, _) => format!("[{value}]{many}"),
        (false, true) => format!("{} {value}{many}", flags.join(", ")),
        (false, false) => flags.join(", "),
    }
}

/// What an argument means, which values it takes and which it has without being given.
fn meaning(argument: &Arg) -> String {
    let help = argument.get_help().or(argument.get_long_help());
    let mut text = help.map(ToString::to_string).unwrap_or_default();
    if argument.get_action().takes_values() {
        let values = argument.get_possible_values();
        let named = values.iter().filter(|value| !value.is_hide_set());
        let named: Vec<String> = named
            .map(|value| match value.get_help() {
                Some(help) => format!("`{}` ({help})", value.get_name()),
                None => format!("`{}`", value.get_name()),
            })
            .collect();
        if !named.is_empty() {
            let _ = write!(text, ": {}", named.join(", "));
        }
        let defaults = argument.get_default_values().iter();
        let defaults: Vec<String> = defaults.map(|value| value.to_string_lossy().into_owned()).collect();
        if !defaults.is_empty() && !argument.is_hide_default_value_set() {
            let _ = write!(text, " [default: {}]", defaults.join(","));
        }
    }
    text
}

/// A text that stays in its cell of a table.
fn in_cell(text: &str) -> String {
    text.replace('|', "\\|").replace('\n', " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_is_a_section_with_its_arguments_as_rows() {
        let run = Command::new("run")
            .about("Runs a graph")
            .arg(Arg::new("graph").required(true).help("The graph"))
            .arg(
                Arg::new("mode")
                    .short('m')
                    .long("mode")
                    .value_parser(["realtime", "virtual"])
                    .default_value("virtual")
                    .help("a | b"),
            )
            .arg(Arg::new("secret").long("secret").hide(true));
        let page = markdown(
            Command::new("realo")
                .about("All")
                .subcommand(run)
                .subcommand(Command::new("x").hide(true)),
        );
        assert_eq!(
            page,
            "\n## realo\n\nAll.\n\n### realo run\n\nRuns a graph.\n\n| argument | meaning |\n|---|---|\n| `GRAPH` | The graph |\n\
             | `-m, --mode MODE` | a \\| b: `realtime`, `virtual` [default: virtual] |\n"
        );
    }
}

//! `realo-ros2`: live ROS 2 beside a graph, over DDS, without a ROS to build or run.
//!
//! A graph starts it as a plug-in: `args: program bin/realo-ros2 sensors map=…` is a source of clouds and poses, and `… boxes` a sink
//! that publishes boxes. Both only translate: what bytes mean is in `realo-logs` and `realo-bags`.

mod agent;
mod boxes;
mod counters;
mod heads;
mod names;
mod queue;
mod ros;
mod sensors;
mod topics;
mod watch;
mod wire;

use std::process::ExitCode;

use realo_operator::{Registration, SettingInfo, StageSettings, config, run_as};

const HELP: &str = "\
realo-ros2: live ROS 2 beside a graph

  realo-ros2 topics [key=value …]    what is published
  realo-ros2 settings                settings of all of these

In a graph, as `args: program PATH/realo-ros2 …`:

  sensors map=ros2.yml …             clouds and poses of ROS, for the graph
  boxes …                            boxes of the graph, for ROS
";

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let (command, rest) = args
        .split_first()
        .map_or(("", &[][..]), |(first, rest)| (first.as_str(), rest));
    match command {
        "sensors" => run_as(const { &Registration::source_program::<sensors::Sensors>() }, rest),
        "boxes" => run_as(const { &Registration::sink_program::<boxes::Boxes>() }, rest),
        "topics" => match topics::main(rest) {
            Ok(()) => ExitCode::SUCCESS,
            Err(reason) => {
                eprintln!("realo-ros2: {reason}");
                ExitCode::FAILURE
            }
        },
        "settings" => {
            print!("{}", settings());
            ExitCode::SUCCESS
        }
        "" | "help" | "--help" | "-h" => {
            print!("{HELP}");
            ExitCode::SUCCESS
        }
        other => {
            eprintln!(
                "realo-ros2: expected sensors, boxes, topics or settings, found `{}`\n\n{HELP}",
                other.escape_debug()
            );
            ExitCode::from(2)
        }
    }
}

/// All settings with their defaults and meanings.
fn settings() -> String {
    let of = |name: &str, lines: String| format!("{name}\n{lines}\n");
    [
        of("sensors", lines::<sensors::Settings>()),
        of("boxes", lines::<boxes::Settings>()),
        of("topics", lines::<topics::Settings>()),
    ]
    .concat()
}

fn lines<S: StageSettings>() -> String {
    let defaults = config::defaults::<S>();
    let line = |setting: &SettingInfo| {
        let default = match &defaults[setting.name] {
            serde_json::Value::String(text) => text.clone(),
            other => other.to_string(),
        };
        let range = setting.range.map(|range| format!(" ({range})")).unwrap_or_default();
        format!("  {}={default}  {}{range}\n", setting.name, setting.about)
    };
    S::SETTINGS.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_listed_with_their_defaults() {
        let text = settings();
        for part in [
            "  map=ros2.yml  YAML file",
            "  objects=/realo/objects  Topic",
            "  silent_s=5.0  ",
            "  domain=null  ",
        ] {
            assert!(text.contains(part), "{text}");
        }
    }
}

//! The stages of a host: which of them run, and what its settings change.

use std::collections::{BTreeMap, BTreeSet};

use realo_documents::shown;
use realo_operator::config::{did_you_mean, nearest_name};

use super::Outlets;
use crate::read::Node;
use crate::{Input, InputSource, flat};

/// Refuses a setting that is given twice: the second would win without a word.
pub(super) fn once_each(settings: &[String]) -> Result<(), String> {
    let mut known: BTreeMap<&str, &str> = BTreeMap::new();
    for setting in settings {
        let key = setting.split_once('=').map_or(setting.as_str(), |(key, _)| key);
        if let Some(first) = known.insert(key, setting) {
            let [first, second] = [first, setting].map(shown);
            return Err(format!(
                "`{}` is set twice, by `{first}` and by `{second}`: keep one",
                shown(key)
            ));
        }
    }
    Ok(())
}

/// Keeps the stages that this process needs, each with the inputs that a setting gives it.
pub(super) fn choose(
    stages: &mut Vec<Node>,
    host: &Node,
    settings: &[String],
    outlets: &Outlets,
) -> Result<(), String> {
    for setting in settings {
        put_before(stages, host, setting)?;
        take_inputs(stages, &host.id, setting)?;
    }
    leave_out(stages, outlets);
    let is_left = |stage: &String| stages.iter().any(|left| left.id == *stage);
    if let Some((output, (stage, _))) = outlets.iter().find(|(_, (stage, _))| !is_left(stage)) {
        return Err(format!(
            "nothing comes out of its output `{output}`: nobody feeds the stage `{stage}` behind it; wire the optional \
             inputs that it needs, or take the output away"
        ));
    }
    past_the_module(host, stages)
}

/// Leaves out the stages that do nothing for this process: those that nobody feeds, and those of which nobody outside takes
/// anything, directly or through others.
fn leave_out(stages: &mut Vec<Node>, outlets: &Outlets) {
    while let Some(at) = stages.iter().position(|stage| stage.starved) {
        let starved = stages.remove(at);
        for stage in stages.iter_mut() {
            let before = stage.inputs.len();
            stage
                .inputs
                .retain(|_, input| input.output().is_none_or(|(node, _)| node != starved.id));
            stage.starved |= stage.inputs.len() < before && stage.inputs.is_empty();
        }
    }
    let sinks = stages.iter().filter(|stage| stage.outputs.is_empty());
    let mut open: Vec<String> = sinks.map(|stage| stage.id.clone()).collect();
    open.extend(outlets.values().map(|(stage, _)| stage.clone()));
    let mut needed = BTreeSet::new();
    while let Some(id) = open.pop() {
        if let Some(stage) = stages.iter().find(|stage| stage.id == id && !needed.contains(&id)) {
            let sources = stage.inputs.values().filter_map(Input::output);
            open.extend(sources.map(|(node, _)| node.to_string()));
        }
        needed.insert(id);
    }
    stages.retain(|stage| needed.contains(&stage.id));
}

/// Refuses an input of a stage that is wired past the module's inputs.
///
/// dora gives a process what its own inputs name and nothing else.
fn past_the_module(host: &Node, stages: &[Node]) -> Result<(), String> {
    let inside: BTreeSet<&str> = stages.iter().map(|stage| stage.id.as_str()).collect();
    let wired: BTreeSet<&InputSource> = host.inputs.values().map(|wire| &wire.source).collect();
    for stage in stages {
        for (port, input) in &stage.inputs {
            let Some((node, _)) = input.output() else { continue };
            if !inside.contains(node) && !wired.contains(&input.source) {
                return Err(format!(
                    "its stage `{}` takes `{}` for its input `{port}` past the module's inputs; give the module an input for it",
                    stage.id, input.source
                ));
            }
        }
    }
    Ok(())
}

/// Gives a hosted stage the inputs of another, where a setting says so: `inner.:takes=other`.
fn take_inputs(stages: &mut [Node], host: &str, setting: &str) -> Result<(), String> {
    let parts = setting.split_once('=');
    let takes = parts.and_then(|(left, other)| Some((left.rsplit_once('.')?, other)));
    let Some(((inner, _), other)) = takes.filter(|((_, key), _)| *key == flat::TAKES) else {
        return Ok(());
    };
    let find = |inner: &str| {
        let found = stages.iter().position(|stage| stage.id == format!("{host}.{inner}"));
        found.ok_or_else(|| no_stage(&shown(setting), inner, &names_within(stages, host)))
    };
    let (taker, other) = (find(inner)?, find(other)?);
    stages[taker].inputs = stages[other].inputs.clone();
    stages[taker].starved = stages[other].starved;
    Ok(())
}

/// Puts a new stage before an input of a hosted one, where a setting says so: `inner.:before=other.port input output`.
fn put_before(stages: &mut Vec<Node>, host: &Node, setting: &str) -> Result<(), String> {
    let parts = setting.split_once('=');
    let before = parts.and_then(|(left, place)| Some((left.rsplit_once('.')?, place)));
    let Some(((inner, _), place)) = before.filter(|((_, key), _)| *key == flat::BEFORE) else {
        return Ok(());
    };
    let wrong = || {
        format!(
            "setting `{}`: expected `STAGE.PORT INPUT OUTPUT` behind `=`",
            shown(setting)
        )
    };
    let [place, input, output] = place.split(' ').collect::<Vec<&str>>()[..] else {
        return Err(wrong());
    };
    let (taker, port) = place.rsplit_once('.').ok_or_else(wrong)?;
    let [id, taker_id] = [inner, taker].map(|name| format!("{}.{name}", host.id));
    if stages.iter().any(|stage| stage.id == id) {
        return Err(format!(
            "setting `{}`: there is a stage `{inner}` already",
            shown(setting)
        ));
    }
    let Some(at) = stages.iter().position(|stage| stage.id == taker_id) else {
        return Err(no_stage(&shown(setting), taker, &names_within(stages, &host.id)));
    };
    let own = Input::from(InputSource::Output {
        node: id.clone(),
        output: output.into(),
    });
    let Some(wire) = stages[at].inputs.insert(port.into(), own) else {
        return Err(format!(
            "setting `{}`: nothing feeds the input `{port}` of `{taker}`",
            shown(setting)
        ));
    };
    let stage = Node {
        id,
        inputs: [(input.to_string(), wire)].into(),
        outputs: [output.to_string()].into(),
        output_types: BTreeMap::new(),
        input_types: BTreeMap::new(),
        ..stages[at].clone()
    };
    stages.insert(at, stage);
    Ok(())
}

/// The stages that a host has, by their names in it.
fn names_within(stages: &[Node], host: &str) -> Vec<String> {
    let within = |stage: &Node| stage.id.strip_prefix(host)?.strip_prefix('.').map(str::to_string);
    stages.iter().filter_map(within).collect()
}

fn no_stage(setting: &str, inner: &str, known: &[String]) -> String {
    let nearest = nearest_name(inner, known.iter().map(String::as_str));
    let hint = did_you_mean(&nearest);
    let names = known.join(", ");
    format!(
        "setting `{setting}`: no stage `{}`{hint}; there are: {names}",
        shown(inner)
    )
}

/// Changes a setting of a hosted stage: `stage.key=value`.
pub(super) fn set(stages: &mut [Node], host: &str, setting: &str) -> Result<(), String> {
    let written = shown(setting);
    let wrong = || format!("setting `{written}` is not of the form stage.key=value");
    let (left, value) = setting.split_once('=').ok_or_else(wrong)?;
    let (inner, key) = left.rsplit_once('.').ok_or_else(wrong)?;
    let id = format!("{host}.{inner}");
    let known = names_within(stages, host);
    let Some(stage) = stages.iter_mut().find(|stage| stage.id == id) else {
        return Err(no_stage(&written, inner, &known));
    };
    if key == flat::STAGE {
        stage.args = Some(value.into());
        return Ok(());
    }
    if [flat::TAKES, flat::BEFORE].contains(&key) {
        return Ok(());
    }
    let mut words = shlex::split(stage.args.as_deref().unwrap_or_default()).unwrap_or_default();
    match words.as_mut_slice() {
        [word, path, ..] if key == flat::PROGRAM && word == flat::PROGRAM => *path = value.into(),
        _ => flat::set_argument(&mut words, key, value),
    }
    let args = shlex::try_join(words.iter().map(String::as_str)).map_err(|error| error.to_string())?;
    stage.args = Some(args);
    Ok(())
}

//! What a module and the node that stands for it owe each other: parameters, inputs, outputs.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use realo_operator::config::{did_you_mean, nearest_name};

use super::hosting::{is_host, is_realo};
use super::{Outlets, Producers};
use crate::read::{Module, Node};
use crate::{GraphError, Input, InputSource, params};

/// The parameters that a module of processes names are those that its node gives. A module within it, or a program that is
/// not ours, may read them from its environment.
pub(super) fn check_params(module: &Module, outer: &Node) -> Result<(), String> {
    let ours = |node: &Node| node.path.as_deref().is_some_and(is_realo);
    let named: BTreeSet<String> = module
        .nodes
        .iter()
        .filter_map(|node| node.args.as_deref())
        .flat_map(params::named)
        .collect();
    let known = || named.iter().cloned().collect::<Vec<_>>().join(", ");
    let given: BTreeSet<String> = outer.params.keys().map(|key| key.to_lowercase()).collect();
    if let Some(unused) = given
        .iter()
        .find(|key| !named.contains(*key))
        .filter(|_| module.nodes.iter().all(ours))
    {
        let nearest = nearest_name(unused, named.iter().map(String::as_str));
        let hint = did_you_mean(&nearest);
        return Err(format!(
            "module `{}` has no parameter `{unused}`{hint}; it has: {}",
            module.name,
            known()
        ));
    }
    for node in module.nodes.iter().filter(|node| is_host(node)) {
        let missing = params::named(node.args.as_deref().unwrap_or_default());
        if let Some(missing) = missing.into_iter().find(|key| !given.contains(key)) {
            return Err(format!(
                "module `{}` needs the parameter `{missing}` for its node `{}`; write it under `params`",
                module.name, node.id
            ));
        }
    }
    Ok(())
}

pub(super) fn check_inputs(module: &Module, outer: &Node) -> Result<(), String> {
    if let Some(missing) = module.inputs.iter().find(|port| !outer.inputs.contains_key(*port)) {
        return Err(format!(
            "module `{}` needs the input `{missing}`; wire it under `inputs`",
            module.name
        ));
    }
    let declared: Vec<&str> = module
        .inputs
        .iter()
        .chain(&module.inputs_optional)
        .map(String::as_str)
        .collect();
    match outer.inputs.keys().find(|port| !declared.contains(&port.as_str())) {
        Some(port) => {
            let nearest = nearest_name(port, declared.iter().copied());
            let hint = did_you_mean(&nearest);
            Err(format!(
                "module `{}` has no input `{port}`{hint}; it has: {}",
                module.name,
                declared.join(", ")
            ))
        }
        None => Ok(()),
    }
}

/// The inputs of a module's node as the outer graph wires them; an optional one without a wire is left out.
pub(super) fn inner_inputs(
    inputs: &BTreeMap<String, Input>,
    outer: &Node,
    siblings: &BTreeSet<String>,
    optional: &BTreeSet<String>,
) -> Result<BTreeMap<String, Input>, String> {
    let mut wired = BTreeMap::new();
    for (port, input) in inputs {
        let mut input = input.clone();
        match &mut input.source {
            InputSource::Output { node, output } if node == "_mod" => match outer.inputs.get(output) {
                Some(wire) => input = input.fed_by(wire),
                None if optional.contains(output) => continue,
                None => return Err(format!("input `{port}`: the module declares no input `{output}`")),
            },
            // Of a module beside it the inner node, too.
            InputSource::Output { node, .. } if siblings.contains(node.split('.').next().unwrap_or_default()) => {
                *node = format!("{}.{node}", outer.id)
            }
            InputSource::Output { .. } => {}
            InputSource::Builtin(source) => {
                let node = source
                    .strip_prefix("dora/logs/")
                    .and_then(|filter| filter.split_once('/'));
                if let Some((level, node)) = node.filter(|(_, node)| siblings.contains(*node)) {
                    *source = format!("dora/logs/{level}/{}.{node}", outer.id);
                }
            }
        }
        wired.insert(port.clone(), input);
    }
    Ok(wired)
}

pub(super) fn outlets(module: &str, declared: &BTreeSet<String>, producers: &Producers) -> Result<Outlets, String> {
    let find = |output: &String| match producers.get(output).map(Vec::as_slice) {
        Some([source]) => Ok((output.clone(), source.clone())),
        None | Some([]) => Err(format!(
            "module `{module}` declares the output `{output}`, which none of its nodes makes"
        )),
        Some(many) => {
            let names: Vec<String> = many.iter().map(|(node, output)| format!("{node}/{output}")).collect();
            let names = names.join(", ");
            Err(format!(
                "module `{module}` declares the output `{output}`, which several of its nodes make: {names}; \
                 take it off the module's outputs and name the inner node where it is used"
            ))
        }
    };
    declared.iter().map(find).collect()
}

/// That something has no output which a node takes.
pub(super) fn no_output(output: &str, known: &[&str], taker: &str, port: &str) -> String {
    let hint = did_you_mean(&nearest_name(output, known.iter().copied()));
    let known = known.join(", ");
    format!("it has no output `{output}`{hint}, which node `{taker}` takes for its input `{port}`; it has: {known}")
}

/// Turns inputs from modules into inputs from the nodes that make them.
pub(super) fn rewire(node: &mut Node, modules: &BTreeMap<String, Outlets>, file: &Path) -> Result<(), GraphError> {
    for (port, input) in &mut node.inputs {
        let InputSource::Output { node: source, output } = &mut input.source else {
            continue;
        };
        let Some(outlets) = modules.get(source) else { continue };
        let Some((inner, inner_output)) = outlets.get(output) else {
            let known: Vec<&str> = outlets.keys().map(String::as_str).collect();
            let reason = no_output(output, &known, &node.id, port);
            return Err(GraphError::Module {
                file: file.into(),
                node: source.clone(),
                reason,
            });
        };
        *source = inner.clone();
        *output = inner_output.clone();
    }
    Ok(())
}

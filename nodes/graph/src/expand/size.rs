//! How large a graph may become when its modules are replaced.

use std::collections::BTreeMap;

use serde_yaml::Value;

use crate::InputSource;
use crate::read::Node;

/// Nodes that a graph may have with all its modules replaced: more than a machine runs processes and threads for.
const MAX_NODES: usize = 1024;

/// What their texts and the files of all modules may have, each as often as it is used, bytes.
const MAX_TEXT: usize = 8 << 20;

/// How large a graph has become: modules that use others twice make it twice as large with every one.
#[derive(Default)]
pub(super) struct Size {
    nodes: usize,
    text: usize,
}

impl Size {
    /// Counts nodes and bytes of text in.
    pub(super) fn take(&mut self, nodes: usize, text: usize) -> Result<(), String> {
        self.nodes += nodes;
        self.text = self.text.saturating_add(text);
        if self.nodes > MAX_NODES {
            return Err(format!(
                "expected at most {MAX_NODES} nodes in the graph with all its modules replaced, found more; \
                 look for a module that is used again and again"
            ));
        }
        if self.text > MAX_TEXT {
            return Err(format!(
                "expected at most {MAX_TEXT} bytes of text in the graph with all its modules replaced, found more; \
                 look for a long text that goes into many nodes: `env`, `build`, `params`"
            ));
        }
        Ok(())
    }
}

/// Bytes of a node's texts.
pub(super) fn weight(node: &Node) -> usize {
    let texts = |map: &BTreeMap<String, String>| map.iter().map(|(key, value)| key.len() + value.len()).sum::<usize>();
    let optional = |text: &Option<String>| text.as_ref().map_or(0, String::len);
    let inputs = node.inputs.iter().map(|(port, input)| {
        let source = match &input.source {
            InputSource::Output { node, output } => node.len() + output.len(),
            InputSource::Builtin(source) => source.len(),
        };
        port.len() + source
    });
    let env = node.env.iter().map(|(name, value)| name.len() + weight_of(value));
    node.id.len()
        + [&node.path, &node.module, &node.args, &node.build]
            .map(optional)
            .iter()
            .sum::<usize>()
        + [&node.params, &node.input_types, &node.output_types]
            .map(texts)
            .iter()
            .sum::<usize>()
        + inputs.chain(env).sum::<usize>()
        + node.outputs.iter().map(String::len).sum::<usize>()
        + node.deploy.as_ref().map_or(0, weight_of)
        + node
            .other
            .iter()
            .map(|(key, value)| weight_of(key) + weight_of(value))
            .sum::<usize>()
}

fn weight_of(value: &Value) -> usize {
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) => 1,
        Value::String(text) => 1 + text.len(),
        Value::Sequence(list) => 1 + list.iter().map(weight_of).sum::<usize>(),
        Value::Mapping(map) => {
            1 + map
                .iter()
                .map(|(key, value)| weight_of(key) + weight_of(value))
                .sum::<usize>()
        }
        Value::Tagged(tagged) => 1 + weight_of(&tagged.value),
    }
}

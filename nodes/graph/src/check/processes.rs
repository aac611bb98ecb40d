//! The processes that host several stages, as dora sees them.

use super::hosting;
use super::{Findings, FlatGraph, FlatNode, Severity};

pub(super) fn check(graph: &FlatGraph, findings: &mut Findings) {
    for host in &graph.hosts {
        hosting::keys(host, true, host.outputs.is_empty(), findings);
        outputs(graph, host, findings);
    }
}

/// The outputs of a host have the types that its stages give them.
fn outputs(graph: &FlatGraph, process: &FlatNode, findings: &mut Findings) {
    for output in process
        .output_types
        .keys()
        .filter(|output| !process.outputs.contains(*output))
    {
        let found = "only its entry in `output_types`".into();
        let mend = "declare the port, or take its type away";
        findings.port(Severity::Error, process, output, "a port of the node", found, mend);
    }
    for (output, (stage, made)) in &process.outlets {
        let given = graph.node(stage).and_then(|stage| stage.output_types.get(made));
        // A stage without a type is a finding of its own.
        let Some(given) = given else { continue };
        let written = process.output_types.get(output);
        let expected = || format!("`{given}`, as `{stage}` sends it");
        match written {
            Some(written) if written == given => {}
            Some(written) => {
                let mend = "write the type that the module's stage sends";
                findings.port(
                    Severity::Error,
                    process,
                    output,
                    expected(),
                    format!("`{written}`"),
                    mend,
                );
            }
            None => {
                let mend = "add it to `output_types`; dora does not check a wire whose ends have no types";
                findings.port(Severity::Error, process, output, expected(), "no type".into(), mend);
            }
        }
    }
}

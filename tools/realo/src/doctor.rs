//! `realo doctor`: whether this machine can do what is asked of it.

use std::path::PathBuf;

use eyre::{Result, bail};
use realo_cli::Outcome;
use realo_graph::FlatGraph;

use crate::run::{Check, Choices, Pace, checks, cores, dora_on_this_machine, pace};

/// Looks at this machine: shared memory, file descriptors, threads, network, dora, processor, and the rate that it does of a graph
#[derive(clap::Args)]
pub struct Args {
    /// Graph that is to run, or the name of a shipped one
    graph: Option<PathBuf>,
    /// Plays some frames of this log, and says what this machine does of the graph's rate
    #[arg(long, requires = "graph")]
    log: Option<PathBuf>,
    /// The ego [default: the first of the log]
    #[arg(long, requires = "log")]
    ego: Option<String>,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    choices: Choices,
}

/// Prints what was found, a line for each thing.
pub fn main(args: &Args) -> Result<Outcome> {
    if let (None, Some(option)) = (&args.log, first_choice(&args.choices)) {
        bail!("{option} needs --log: settings only change the rate that is measured");
    }
    let path = args.graph.as_deref().map(realo_cli::find::graph).transpose()?;
    let graph = path.as_deref().map(FlatGraph::load).transpose()?;
    let mut all = checks(graph.as_ref());
    all.push(dora());
    all.push(processor());
    let mut outcome = Outcome::Complete;
    for Check { what, found } in all {
        match found {
            Ok(found) => println!("ok   {what}: {found}"),
            Err(reason) => {
                println!("FAIL {what}: {reason}");
                outcome = Outcome::Failed;
            }
        }
    }
    println!("{}", python());
    match (&path, &args.log) {
        (Some(graph), Some(log)) => {
            let pace = pace(graph, log, args.ego.as_deref(), &args.choices)?;
            println!("{}", pace_in_words(&pace));
        }
        (Some(_), None) => println!("note rate: not measured: add --log LOG, and some frames of it are played"),
        (None, _) => println!(
            "note rate: not measured: name a graph and a log (`realo doctor GRAPH --log LOG`), and some frames are played"
        ),
    }
    Ok(outcome)
}

/// The first option that changes the graph.
fn first_choice(choices: &Choices) -> Option<&'static str> {
    let Choices {
        link,
        localization,
        map,
        recorded_detections,
        model,
        stamps,
        isa,
        precision,
        device,
        project,
        seed,
        set,
        replace,
    } = choices;
    let given = [
        ("--link", link.is_some()),
        ("--localization", localization.is_some()),
        ("--map", map.is_some()),
        ("--recorded-detections", *recorded_detections),
        ("--model", model.is_some()),
        ("--stamps", stamps.is_some()),
        ("--isa", isa.is_some()),
        ("--precision", precision.is_some()),
        ("--device", device.is_some()),
        ("--project", project.is_some()),
        ("--seed", seed.is_some()),
        ("--set", !set.is_empty()),
        ("--replace", !replace.is_empty()),
    ];
    given
        .into_iter()
        .find(|(_, is_given)| *is_given)
        .map(|(option, _)| option)
}

/// What the machine does of a graph's rate; `note` where it does not keep up.
fn pace_in_words(pace: &Pace) -> String {
    let word = if pace.keeps_up() { "ok  " } else { "note" };
    format!("{word} rate: {pace}")
}

/// Prints the interpreter, a module of Python a line, and its version or why it cannot be imported.
const MODULES: &str = "
import importlib, sys
print('Python', sys.version.split()[0], sys.executable)
for name in ('numpy', 'pyarrow', 'realo_operator'):
    try:
        module = importlib.import_module(name)
        print(name, getattr(module, '__version__', '') or module.__file__)
    except Exception as error:
        print('missing', name, error)
";

/// What plug-ins in Python find; nothing else needs it, so nothing fails without.
fn python() -> String {
    let output = realo_host::interpreter().args(["-c", MODULES]).output();
    match output {
        Ok(output) if output.status.success() => modules(&String::from_utf8_lossy(&output.stdout)),
        Ok(output) => format!(
            "note Python plug-ins: the interpreter ended with {}: {}",
            output.status,
            String::from_utf8_lossy(&output.stderr).trim()
        ),
        Err(error) => format!(
            "note Python plug-ins: no interpreter `python` or `python3` on PATH ({error}); only plug-ins in Python need one"
        ),
    }
}

/// A line of what the interpreter printed.
fn modules(printed: &str) -> String {
    let (missing, there): (Vec<&str>, Vec<&str>) = printed.lines().partition(|line| line.starts_with("missing "));
    let there = there.join(", ");
    let names: Vec<&str> = missing.iter().filter_map(|line| line.split(' ').nth(1)).collect();
    // The module of realo itself fails with those that it imports.
    let wanted: Vec<&str> = names.iter().copied().filter(|name| *name != "realo_operator").collect();
    match (&names[..], &wanted[..]) {
        ([], _) => format!("ok   Python plug-ins: {there}"),
        (_, []) => format!(
            "note Python plug-ins: {there}; {}: `{} -m pip install CHECKOUT/python`; only plug-ins in Python need it",
            missing.join("; "),
            realo_host::python()
        ),
        _ => format!(
            "note Python plug-ins: {there}; {} cannot be imported: `{} -m pip install {}`; only plug-ins in Python need them",
            wanted.join(" and "),
            realo_host::python(),
            wanted.join(" ")
        ),
    }
}

fn dora() -> Check {
    Check {
        what: "dora",
        found: dora_on_this_machine(),
    }
}

fn processor() -> Check {
    let cores = cores();
    let known: Vec<String> = realo_methods::Isa::ALL
        .iter()
        .filter(|isa| isa.is_available())
        .map(|isa| isa.to_string())
        .collect();
    Check {
        what: "processor",
        found: Ok(format!(
            "{cores} cores; kernels {}, of which {} is taken; a realtime run that does not keep up says within ten seconds which \
             stage holds it up",
            known.join(", "),
            realo_methods::Isa::detect()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_python_lacks_is_named_with_what_to_install() {
        let all =
            "Python 3.12.1 /usr/bin/python3\nnumpy 2.1.0\npyarrow 18.0.0\nrealo_operator /x/python/realo_operator";
        assert!(
            modules(all).starts_with("ok   Python plug-ins: Python 3.12.1"),
            "{}",
            modules(all)
        );
        let bare = "Python 3.12.1 /usr/bin/python3\nnumpy 2.1.0\nmissing pyarrow No module named 'pyarrow'\n\
                    missing realo_operator No module named 'pyarrow'";
        let said = modules(bare);
        assert!(
            said.starts_with("note ") && said.contains("pip install pyarrow`") && !said.contains("CHECKOUT"),
            "{said}"
        );
        let alone =
            "Python 3.12.1 /usr/bin/python3\nnumpy 2.1.0\npyarrow 18.0.0\nmissing realo_operator No module named it";
        assert!(
            modules(alone).contains("pip install CHECKOUT/python"),
            "{}",
            modules(alone)
        );
    }
}

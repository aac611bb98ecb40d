//! `--replace`: another stage in the place of one of a graph, or a new one before an input.

use std::path::Path;

use eyre::{Result, WrapErr, bail, eyre};
use realo_graph::{FlatGraph, FlatNode, Replacement, Severity, TYPE_PREFIX};
use realo_host::Program;
use realo_operator::{Port, Registration};

use super::named;
use super::nodes::is_path;
use crate::registry;

/// What `--replace` says, paths seen from where the user is.
pub fn replacements(texts: &[String]) -> Result<Vec<Replacement>> {
    let read = |text: &String| {
        let mut replacement: Replacement = text.parse().wrap_err("--replace")?;
        anchor(&mut replacement).wrap_err_with(|| format!("--replace {text}"))?;
        Ok(replacement)
    };
    texts.iter().map(read).collect()
}

/// Makes the program, and what names a file in the arguments, absolute: stages start in the graph's folder.
fn anchor(replacement: &mut Replacement) -> Result<()> {
    let absolute = |path: &str| -> Result<String> { Ok(std::path::absolute(path)?.to_string_lossy().into_owned()) };
    let is_program = replacement.words[0] == "program";
    if is_program {
        let path = absolute(&replacement.words[1])?;
        if !Path::new(&path).is_file() {
            bail!("no program {path}; its path is seen from the current folder");
        }
        replacement.words[1] = path;
    }
    let known = registry().find(&replacement.words[0], &replacement.words[1]).ok();
    for word in &mut replacement.words[2..] {
        let Some((key, value)) = word.split_once('=') else {
            continue;
        };
        if is_path(known, key, value, Path::new("")) {
            *word = format!("{key}={}", absolute(value)?);
        }
    }
    Ok(())
}

/// Puts the stages into their places; with `ask` programs are started to learn whether their ports fit.
///
/// # Errors
/// A stage that is not there, with all that are; ports or arguments that do not fit, with those of both sides.
pub fn apply(graph: &mut FlatGraph, texts: &[String], ask: bool) -> Result<()> {
    for (mut replacement, text) in replacements(texts)?.into_iter().zip(texts) {
        let before = errors(graph, &[]);
        replacement.ports = ports(graph, &replacement, ask).wrap_err_with(|| format!("--replace {text}"))?;
        let places = graph
            .replace(&replacement)
            .wrap_err_with(|| format!("--replace {text}"))?;
        let asked: &[String] = if ask { &places } else { &[] };
        let wrong: Vec<String> = errors(graph, asked)
            .into_iter()
            .filter(|error| !before.contains(error))
            .collect();
        if !wrong.is_empty() {
            let needed = places.first().and_then(|id| Some(needed(graph, graph.node(id)?)));
            return Err(eyre!(
                "--replace {text}: it does not fit:\n  {}\n  the place has {}",
                wrong.join("\n  "),
                needed.unwrap_or_default()
            ));
        }
    }
    Ok(())
}

/// The input and the output of a stage that comes before an input; `None` for one that comes in the place of another, and for a
/// program that is not asked.
fn ports(graph: &FlatGraph, replacement: &Replacement, ask: bool) -> Result<Option<[String; 2]>> {
    let Replacement { places, words, .. } = replacement;
    if places.iter().all(|place| graph.input_of(place).is_none()) {
        return Ok(None);
    }
    let folder = graph.file.parent().unwrap_or(Path::new("/"));
    let program = Program::of(&FlatNode::alone(&words[1], words, &[]), folder);
    let registration = match program {
        Some(program) if ask => program.ask().map_err(|reason| eyre!(reason))?,
        Some(_) => return Ok(None),
        None => registry().find(&words[0], &words[1]).map_err(|reason| eyre!(reason))?,
    };
    let inputs: Vec<&Port> = registration.inputs.iter().filter(|port| port.required).collect();
    match (&inputs[..], registration.outputs) {
        ([input], [output]) => Ok(Some([input, output].map(|port| port.name.to_string()))),
        _ => bail!(
            "expected a stage of one input and one output to come before an input, found that {}",
            offer(registration)
        ),
    }
}

/// What keeps a graph from a run; of these plug-ins the ports are asked for.
fn errors(graph: &FlatGraph, asked: &[String]) -> Vec<String> {
    let folder = graph.file.parent().unwrap_or(Path::new("/"));
    let mut offers = Vec::new();
    let findings = realo_graph::validate_asking(graph, &registry(), &mut |node| {
        let program = asked.contains(&node.id).then(|| Program::of(node, folder)).flatten()?;
        let answer = program.ask();
        if let Ok(registration) = &answer {
            offers.push(offer(registration));
        }
        Some(answer)
    });
    let errors = findings.iter().filter(|finding| finding.severity == Severity::Error);
    let mut errors: Vec<String> = errors.map(|error| error.to_string()).collect();
    if !errors.is_empty() {
        offers.dedup();
        errors.extend(offers);
    }
    errors
}

/// The ports of a program.
fn offer(registration: &Registration) -> String {
    let names = |ports: &[Port]| {
        let port = |port: &Port| {
            let types: Vec<String> = port.types.iter().map(|of| of.to_string()).collect();
            format!("{} ({})", port.name, types.join(" or "))
        };
        ports.iter().map(port).collect::<Vec<_>>().join(", ")
    };
    let (inputs, outputs) = (names(registration.inputs), names(registration.outputs));
    format!(
        "`{}` offers the inputs {inputs} and the outputs {outputs}",
        registration.name
    )
}

/// The ports of a place, as they are wired.
fn needed(graph: &FlatGraph, node: &FlatNode) -> String {
    let short = |of: Option<&String>| {
        let of = of.map_or("of any type", String::as_str);
        of.strip_prefix(TYPE_PREFIX).unwrap_or(of).to_string()
    };
    let inputs = node.inputs.iter().map(|(port, input)| {
        let source = input.output();
        let of = source.and_then(|(id, output)| graph.node(id)?.output_types.get(output));
        format!("{port} ({})", short(of))
    });
    let outputs = node.outputs.iter();
    let outputs = outputs.map(|port| format!("{port} ({})", short(node.output_types.get(port))));
    let [inputs, outputs] = [inputs.collect::<Vec<_>>(), outputs.collect::<Vec<_>>()].map(|ports| ports.join(", "));
    format!("the inputs {inputs} and the outputs {outputs}")
}

/// Some places of a replacement with what stands there, as the user wrote it.
pub fn written(replacement: &Replacement, places: &[usize], text: &str) -> String {
    let places: Vec<String> = places.iter().map(|at| replacement.places[*at].join("+")).collect();
    let stage = text.split_once('=').map_or("", |(_, stage)| stage);
    format!("{}={stage}", places.join(","))
}

/// Replacements as results have them: places, and what stands there; files by their names, those of arguments with a hash.
pub fn in_words(texts: &[String]) -> Result<Vec<(String, String)>> {
    let name = |value: &str| {
        let path = Path::new(value);
        let name = path.file_name().filter(|_| path.is_absolute());
        name.map_or(value.to_string(), |name| name.to_string_lossy().into_owned())
    };
    let word = |word: &String| match word.split_once('=') {
        Some((key, value)) if Path::new(value).is_absolute() && Path::new(value).is_file() => {
            format!("{key}={}", named::file(Path::new(value)))
        }
        Some((key, value)) => format!("{key}={}", name(value)),
        None => name(word),
    };
    let one = |replacement: Replacement| {
        let places: Vec<String> = replacement.places.iter().map(|place| place.join("+")).collect();
        let words: Vec<String> = replacement.words.iter().map(word).collect();
        (places.join(","), words.join(" "))
    };
    Ok(replacements(texts)?.into_iter().map(one).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shipped() -> FlatGraph {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        FlatGraph::load(&root.join("dataflows/late_fusion.yml")).unwrap()
    }

    fn refused(text: &str) -> String {
        let refused = apply(&mut shipped(), &[text.into()], true);
        format!("{:#}", refused.expect_err(text))
    }

    #[test]
    fn an_operator_of_other_ports_or_arguments_is_refused_with_both_sides() {
        for (text, expected) in [
            ("fusion.fusion=operator fusion-boxes ego_boxes=maybe", "ego_boxes"),
            ("fusion.fusion=operator fusion-boxs", "fusion-boxes"),
            (
                "fusion.fusion=operator nms threshold=0.2",
                "port `ego`: expected an input of `nms`: fill, proposals",
            ),
            (
                "fusion.fusion=operator nms",
                "the place has the inputs ego (Boxes), selections (Selection) and the outputs proposals (Boxes)",
            ),
            ("fusion.fuse=operator nms", "the graph has: player"),
            (
                "fusion.nms.proposal=operator nms",
                "nothing feeds an input `proposal` of `fusion.nms` (did you mean `proposals`?)",
            ),
            (
                "fusion.nms.proposals=operator fusion-boxes",
                "found that `fusion-boxes` offers the inputs ego (Boxes), selections (Selection)",
            ),
            ("ego.sense.sync.poses=operator liar", "`ego.sense.liar`"),
            ("fusion.fusion=program no_such.py", "seen from the current folder"),
        ] {
            let said = refused(text);
            assert!(said.contains(expected), "{text}: {said}");
        }
        let text = "fusion.fusion=operator fusion-boxes ego_boxes=false".to_string();
        let mut graph = shipped();
        apply(&mut graph, std::slice::from_ref(&text), true).unwrap();
        assert_eq!(graph.node("fusion.fusion").unwrap().args[2], "ego_boxes=false");
    }

    #[test]
    fn results_name_what_stands_there_without_folders() {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("fill.py");
        std::fs::write(&program, "").unwrap();
        let text = format!("fusion.fusion=program {} overlap=0.2", program.display());
        let words = in_words(&[text]).unwrap();
        let expected = ("fusion.fusion".to_string(), "program fill.py overlap=0.2".to_string());
        assert_eq!(words, [expected]);
    }
}

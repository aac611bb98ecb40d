//! Of several graphs, each gets the settings for which it has a stage.

use crate::roles;
use std::path::{Path, PathBuf};

use realo_graph::{FlatGraph, Graph, GraphError, Replacement, Setting};

use super::nodes::{deciding, given, registration};
use super::{Choices, replace};

/// The settings of one graph.
pub struct Fitted {
    /// Those that the graph can follow.
    pub choices: Choices,
    /// The others, as options; another of the graphs can follow each.
    skipped: Vec<String>,
    /// How many were asked for.
    asked: usize,
}

impl Fitted {
    /// The settings that the graph was not given, for who reads its results.
    pub fn note(&self) -> Option<String> {
        let (skipped, asked) = (self.skipped.len(), self.asked);
        let what = if asked == 1 { "setting" } else { "settings" };
        (skipped > 0).then(|| {
            format!(
                "{skipped} of {asked} {what} skipped, because this graph has nothing to set there, while another graph of the run has: {}",
                self.skipped.join("; ")
            )
        })
    }
}

/// Keeps the last of several values of one setting, as whoever adds to a command expects; says so of each.
pub fn settle(set: &mut Vec<String>) {
    let notes = keep_last(set, "--set ", |text| {
        let setting: Setting = text.parse().ok()?;
        Some((format!("{}.{}", setting.node, setting.key), setting.value))
    });
    notes.iter().for_each(|note| eprintln!("realo: {note}"));
}

/// The same of all options that may be there twice: settings, stages in one place, and keys of a link.
pub fn settle_all(choices: &mut Choices) {
    settle(&mut choices.set);
    let mut notes = keep_last(&mut choices.replace, "--replace ", |text| {
        let places = text.parse::<Replacement>().ok()?.places;
        let places: Vec<String> = places.iter().map(|place| place.join("+")).collect();
        Some((places.join(","), text.split_once('=')?.1.to_string()))
    });
    if let Some(link) = &mut choices.link {
        let mut words: Vec<String> = link.split(',').map(String::from).collect();
        notes.extend(keep_last(&mut words, "--link ", |word| {
            let (key, value) = word.split_once('=')?;
            Some((key.trim().to_string(), value.to_string()))
        }));
        *link = words.join(",");
    }
    notes.iter().for_each(|note| eprintln!("realo: {note}"));
}

/// Keeps the last of several texts of one key, as `read` gives it with its value; returns what is to be said of the others.
fn keep_last(texts: &mut Vec<String>, option: &str, read: impl Fn(&str) -> Option<(String, String)>) -> Vec<String> {
    let mut notes = Vec::new();
    let known: Vec<Option<(String, String)>> = texts.iter().map(|text| read(text)).collect();
    let mut is_last = vec![true; texts.len()];
    for (at, earlier) in known.iter().enumerate() {
        // What cannot be read is refused when it is needed.
        let Some((key, value)) = earlier else { continue };
        let mut later = known[at + 1..].iter().flatten();
        let Some((_, last)) = later.rfind(|(other, _)| other == key) else {
            continue;
        };
        is_last[at] = false;
        if last != value {
            notes.push(format!(
                "{option}{key} is there more than once: the last one counts, {last}, not {value}"
            ));
        }
    }
    let mut kept = is_last.into_iter();
    texts.retain(|_| kept.next().unwrap_or(true));
    notes
}

/// What one graph can follow of the settings of all. What no graph can follow stays, so that each says what is wrong.
pub fn fit(choices: &Choices, graphs: &[PathBuf]) -> Vec<Fitted> {
    let mut fitted: Vec<Fitted> = graphs
        .iter()
        .map(|_| Fitted {
            choices: choices.clone(),
            skipped: Vec::new(),
            asked: choices.set.len() + choices.replace.len() + usize::from(choices.model.is_some()),
        })
        .collect();
    if graphs.len() < 2 || fitted[0].asked == 0 {
        return fitted;
    }
    // A graph that cannot be read says so later; until then it has everything.
    let mut known: Vec<Option<FlatGraph>> = graphs.iter().map(|path| flat(path, choices)).collect();
    for text in &choices.replace {
        fit_replacement(text, &mut known, &mut fitted);
    }
    for text in &choices.set {
        let Ok(setting) = text.parse::<Setting>() else { continue };
        let has: Vec<bool> = known
            .iter()
            .map(|graph| has_argument(graph.as_ref(), &setting))
            .collect();
        skip(&has, &mut fitted, &format!("--set {text}"), |choices| {
            choices.set.retain(|other| other != text);
        });
    }
    if let Some(model) = &choices.model {
        let runs_network = |graph: &Option<FlatGraph>| {
            let mut graph = graph.iter();
            graph.all(|graph| deciding(graph, roles::MODEL).next().is_some())
        };
        let has: Vec<bool> = known.iter().map(runs_network).collect();
        skip(&has, &mut fitted, &format!("--model {}", model.display()), |choices| {
            choices.model = None;
        });
    }
    fitted
}

/// A graph with its modules; what is wrong with it is said when it is made for the run.
fn flat(path: &Path, choices: &Choices) -> Option<FlatGraph> {
    let graph = Graph::load(path).ok()?;
    let graph = match choices.recorded_detections {
        true => graph.with_detection("recorded").expand(),
        false => graph.expand(),
    };
    graph.ok()
}

/// Takes a setting from the graphs that lack its place, where another has it.
fn skip(has: &[bool], fitted: &mut [Fitted], option: &str, take: impl Fn(&mut Choices)) {
    if !has.contains(&true) {
        return;
    }
    for (fitted, _) in fitted.iter_mut().zip(has).filter(|(_, has)| !**has) {
        take(&mut fitted.choices);
        fitted.skipped.push(option.to_string());
    }
}

/// Whether a graph has a stage with such a setting. What a program takes only the program knows.
fn has_argument(graph: Option<&FlatGraph>, setting: &Setting) -> bool {
    let Some(graph) = graph else { return true };
    let Some(node) = graph.node(&setting.node) else {
        return false;
    };
    let Some(known) = registration(node) else { return true };
    (known.defaults)().contains_key(&setting.key) || given(node, &setting.key).is_some()
}

/// Leaves each graph the places of a replacement that it has, and makes the replacement.
fn fit_replacement(text: &str, known: &mut [Option<FlatGraph>], fitted: &mut [Fitted]) {
    let Ok(replacement) = text.parse::<Replacement>() else {
        return;
    };
    let has_place = |graph: &Option<FlatGraph>, place: &[String]| {
        let alone = Replacement {
            places: vec![place.to_vec()],
            ..replacement.clone()
        };
        let Some(mut graph) = graph.clone() else { return true };
        !matches!(
            graph.replace(&alone),
            Err(GraphError::UnknownNode { .. } | GraphError::UnknownInput { .. })
        )
    };
    let has: Vec<Vec<bool>> = known
        .iter()
        .map(|graph| replacement.places.iter().map(|place| has_place(graph, place)).collect())
        .collect();
    for (at, fitted) in fitted.iter_mut().enumerate() {
        let is_elsewhere = |place: usize| has.iter().any(|has| has[place]);
        let (left, gone): (Vec<usize>, Vec<usize>) =
            (0..replacement.places.len()).partition(|place| has[at][*place] || !is_elsewhere(*place));
        if gone.is_empty() {
            continue;
        }
        let joined = |places: &[usize]| replace::written(&replacement, places, text);
        fitted.skipped.push(format!("--replace {}", joined(&gone)));
        let texts = &mut fitted.choices.replace;
        match (texts.iter().position(|other| other == text), left.is_empty()) {
            (Some(place), true) => _ = texts.remove(place),
            (Some(place), false) => texts[place] = joined(&left),
            (None, _) => {}
        }
    }
    for (graph, has) in known.iter_mut().zip(&has) {
        let places = replacement.places.iter().zip(has).filter(|(_, has)| **has);
        let replacement = Replacement {
            places: places.map(|(place, _)| place.clone()).collect(),
            ..replacement.clone()
        };
        // What is wrong with it is said when it is made.
        if let Some(graph) = graph {
            _ = graph.replace(&replacement);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shipped(names: &[&str]) -> Vec<PathBuf> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dataflows");
        names.iter().map(|name| folder.join(format!("{name}.yml"))).collect()
    }

    fn choices(set: &[&str], replace: &[&str]) -> Choices {
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            choices: Choices,
        }
        let options = |name: &'static str, texts: &[&str]| -> Vec<String> {
            texts
                .iter()
                .flat_map(|text| [name.to_string(), text.to_string()])
                .collect()
        };
        let words = [
            vec!["realo".to_string()],
            options("--set", set),
            options("--replace", replace),
        ]
        .concat();
        <Line as clap::Parser>::parse_from(words).choices
    }

    #[test]
    fn the_last_of_several_values_of_one_setting_counts() {
        let mut set: Vec<String> = ["a.b.x=1", "a.b.y=2", "a.b.x=3", "junk", "a.b.y=2", "a.b.x=4", "junk"]
            .map(String::from)
            .into();
        let notes = keep_last(&mut set, "--set ", |text| {
            let setting: Setting = text.parse().ok()?;
            Some((format!("{}.{}", setting.node, setting.key), setting.value))
        });
        assert_eq!(set, ["junk", "a.b.y=2", "a.b.x=4", "junk"]);
        assert_eq!(
            notes,
            [
                "--set a.b.x is there more than once: the last one counts, 4, not 1",
                "--set a.b.x is there more than once: the last one counts, 4, not 3"
            ]
        );
    }

    #[test]
    fn the_last_stage_of_one_place_and_the_last_value_of_a_link_count() {
        let stages = ["a.b=operator nms", "a.c=operator nms", "a.b=operator fusion-boxes"];
        let mut given = choices(&[], &stages);
        given.link = Some("paper,loss=0.1,delay_ms=9,loss=0.2".into());
        settle_all(&mut given);
        assert_eq!(given.replace, ["a.c=operator nms", "a.b=operator fusion-boxes"]);
        assert_eq!(given.link.as_deref(), Some("paper,delay_ms=9,loss=0.2"));
    }

    const NOISE: &str = "others.sense.localization.position_noise_m=0.2";

    #[test]
    fn a_graph_without_the_stage_is_not_given_the_setting() {
        let window = "fusion.bank.window_ms=300";
        let fitted = fit(
            &choices(&[NOISE, window], &[]),
            &shipped(&["no_fusion", "late_fusion", "attfuse"]),
        );
        assert_eq!(fitted[0].choices.set, [""; 0]);
        let note = fitted[0].note().expect("a note");
        assert!(
            note.starts_with("2 of 2 settings skipped") && note.contains(NOISE),
            "{note}"
        );
        for fitted in &fitted[1..] {
            assert_eq!(fitted.choices.set, [NOISE, window]);
            assert_eq!(fitted.note(), None);
        }
    }

    #[test]
    fn a_setting_that_only_one_fusion_has_is_for_that_one() {
        let set = "fusion.fusion.ego_boxes=false";
        let fitted = fit(&choices(&[set], &[]), &shipped(&["late_fusion", "attfuse"]));
        assert_eq!((fitted[0].note(), fitted[1].choices.set.len()), (None, 0));
        assert!(
            fitted[1]
                .note()
                .is_some_and(|note| note.starts_with("1 of 1 setting skipped"))
        );
    }

    #[test]
    fn what_no_graph_has_stays_for_its_error() {
        for set in ["others.localization.noise_m=0.2", "fusion.fusion.no_such=1", "no_dot"] {
            let fitted = fit(&choices(&[set], &[]), &shipped(&["no_fusion", "late_fusion"]));
            assert!(
                fitted
                    .iter()
                    .all(|fitted| fitted.choices.set == [set] && fitted.note().is_none())
            );
        }
        let alone = fit(&choices(&[NOISE], &[]), &shipped(&["no_fusion"]));
        assert_eq!(alone[0].choices.set, [NOISE], "of one graph");
    }

    #[test]
    fn a_replacement_keeps_the_places_that_a_graph_has() {
        let text = "ego.nms,others.nms=operator nms threshold=0.4";
        let fitted = fit(&choices(&[], &[text]), &shipped(&["no_fusion", "late_fusion"]));
        assert_eq!(fitted[0].choices.replace, ["ego.nms=operator nms threshold=0.4"]);
        assert!(
            fitted[0]
                .note()
                .is_some_and(|note| note.ends_with(": --replace others.nms=operator nms threshold=0.4"))
        );
        assert_eq!(fitted[1].choices.replace, [text]);
        let fusion = "fusion.fusion=operator fusion-boxes ego_boxes=false";
        let fitted = fit(&choices(&[], &[fusion]), &shipped(&["no_fusion", "late_fusion"]));
        assert_eq!(
            (fitted[0].choices.replace.len(), fitted[1].choices.replace.len()),
            (0, 1)
        );
    }
}

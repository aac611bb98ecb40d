//! Words in tables that are not everyday English.

/// A word and what it means, where a table has it.
const WORDS: &[(&str, &str)] = &[
    (
        "AP",
        "average precision, from 0 to 1 (best), of the detections of all scored frames sorted by score",
    ),
    (
        "IoU",
        "overlap from which a detection is true (intersection over union, from above)",
    ),
    ("mAP", "mean of the classes' AP"),
    (
        "95 % interval",
        "where mAP would lie for 95 of 100 draws of as many logs; runs whose intervals overlap much may be equally good",
    ),
    (
        "objects that the ego itself sees",
        "those on which the ego alone has enough points",
    ),
    (
        "HOTA",
        "higher order tracking accuracy, from 0 to 1 (best), as TrackEval counts it: of what is found (DetA) and under one identity (AssA)",
    ),
    (
        "tracks that swap",
        "changes of identity to one under which another object was found last",
    ),
    (
        "velocity error",
        "mean size of what velocities of detections on objects are off; moving: at 1 m/s or more",
    ),
    (
        "KB per frame",
        "what crossed the links to the ego for each of its sweeps, 1 KB = 1,000 bytes",
    ),
    ("age", "from the stamp of the data to the ego's query that used them"),
    (
        "stamps apart",
        "how far the stamps of what was fused lie from the ego's: nothing is late in an offline run",
    ),
    ("Hz of log time", "sweeps that became boxes, for each second of the log"),
    ("peers", "agents on other machines"),
    ("end to end", "from a sweep's last point to its boxes"),
    ("p50 / p95 / p99", "half, 95 % and 99 % of all are not above it"),
    ("stale", "too old when the ego asked"),
    ("superseded", "a newer message of its sender took its place"),
    ("over limit", "of more collaborators than the fusion takes"),
    (
        "distrusted",
        "left out by a guard, because the ego could not confirm it",
    ),
    ("in flight", "arrived after the ego's last sweep"),
    ("rejected", "invalid, or of no use to the fusion"),
    ("coop", "who may collaborate with the ego"),
    ("compute", "computing times that virtual time charges"),
    ("project", "who brings data to the ego's frame, receiver or sender"),
    ("protocol", "what counts as an object, and what as found"),
    ("pooled", "scored as one, a run for each log and ego"),
    ("seed", "of all random draws"),
    ("isa", "the processor's instructions that networks used"),
];

/// The words of a table that it explains, in one paragraph.
pub fn explained(table: &str) -> String {
    let used = WORDS.iter().filter(|(word, _)| has_word(table, word));
    let used: Vec<String> = used.map(|(word, meaning)| format!("{word}: {meaning}")).collect();
    match used.is_empty() {
        true => String::new(),
        false => format!("{}.", used.join(". ")),
    }
}

/// Whether a text has a word, and not only as a part of another.
fn has_word(text: &str, word: &str) -> bool {
    text.match_indices(word).any(|(at, _)| {
        let [before, after] = [text[..at].chars().next_back(), text[at + word.len()..].chars().next()];
        [before, after].iter().flatten().all(|letter| !letter.is_alphanumeric())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn explains_the_words_that_are_there() {
        let said = explained("mAP 0.5\n  age, ms");
        assert!(said.starts_with("mAP: ") && said.contains(". age: "), "{said}");
        assert!(!said.contains("IoU:"), "{said}");
        assert_eq!(explained("stages"), "", "`age` is no part of a word");
    }
}

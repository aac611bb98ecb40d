//! What is wrong with boxes and their companions.

use std::collections::BTreeMap;

use realo_schemas::geometry::{PLAUSIBLE_BOX, box_fault, detection_fault};
use realo_schemas::{Box3, Boxes, Nanos, to_seconds};

use crate::boxes::{WRONG_HEADINGS, WrongHeadings};
use crate::{Entry, Log, LogError, Stream};

/// Streams of boxes, each with its companion.
const PAIRS: [[Stream; 2]; 3] = [
    [Stream::Detections, Stream::DetectionsInfo],
    [Stream::GroundTruth, Stream::GroundTruthInfo],
    [Stream::OwnLabels, Stream::OwnLabelsInfo],
];
/// So many messages wait for what belongs to them.
const WAITING: usize = 256;

/// What is wrong with an agent's boxes, as they are with their companions. What cannot be read without these is named elsewhere.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn box_faults(log: &Log, agent: &str) -> Result<Vec<String>, LogError> {
    let mut found = Vec::new();
    for [array, companion] in PAIRS.into_iter().filter(|[array, _]| log.has(agent, *array)) {
        let [topic, of_companion] = [array, companion].map(|stream| stream.topic(agent));
        let has_companion = log.has(agent, companion);
        if !has_companion && array != Stream::Detections {
            found.push(format!(
                "{topic}: {of_companion} is missing, without which a run does not play it; write both for each sweep (docs/reference/log-format.md)"
            ));
        }
        let mut wanted = vec![(agent, array)];
        wanted.extend(has_companion.then_some((agent, companion)));
        let mut faults = Faults::new(array);
        let mut reader = log.read_all(&wanted)?;
        loop {
            let taken = match reader.next() {
                Ok(Some(entry)) => faults.take(entry, has_companion),
                Ok(None) | Err(LogError::Content { .. }) => break,
                Err(error) => return Err(error),
            };
            if let Err(error) = taken {
                found.push(error);
                break;
            }
        }
        found.extend(faults.end(&topic, &of_companion));
    }
    Ok(found)
}

/// The boxes of a stream so far.
struct Faults {
    array: Stream,
    arrays: BTreeMap<Nanos, Boxes>,
    companions: BTreeMap<Nanos, Entry>,
    count: usize,
    of: usize,
    /// Stamp of the first that no object can have, and what is wrong with it.
    first: Option<(Nanos, String)>,
    wrong_headings: WrongHeadings,
    /// Stamp of the first of these.
    first_heading: Nanos,
}

impl Faults {
    fn new(array: Stream) -> Self {
        Faults {
            array,
            arrays: BTreeMap::new(),
            companions: BTreeMap::new(),
            count: 0,
            of: 0,
            first: None,
            wrong_headings: WrongHeadings::default(),
            first_heading: 0,
        }
    }

    /// Takes a message; an error is a companion that cannot be read, in words.
    fn take(&mut self, entry: Entry, has_companion: bool) -> Result<(), String> {
        let stamp = entry.stamp();
        if entry.stream == self.array {
            // What cannot be read is named with its times.
            let Ok(boxes) = entry.boxes() else { return Ok(()) };
            match self.companions.remove(&stamp) {
                Some(companion) => self.join(stamp, boxes, &companion)?,
                None if has_companion => drop(self.arrays.insert(stamp, boxes)),
                None => self.note(stamp, &boxes),
            }
        } else {
            match self.arrays.remove(&stamp) {
                Some(boxes) => self.join(stamp, boxes, &entry)?,
                None => drop(self.companions.insert(stamp, entry)),
            }
        }
        while self.companions.len() > WAITING {
            self.companions.pop_first();
        }
        while self.arrays.len() > WAITING
            && let Some((stamp, boxes)) = self.arrays.pop_first()
        {
            self.note(stamp, &boxes);
        }
        Ok(())
    }

    fn join(&mut self, stamp: Nanos, mut boxes: Boxes, companion: &Entry) -> Result<(), String> {
        let info = companion.info(&mut boxes).map_err(|error| {
            let topic = companion.stream.topic(&companion.agent);
            format!("{topic} at {:.3} s: {}", to_seconds(companion.ready()), error.reason())
        })?;
        if self.wrong_headings.count == 0 {
            self.first_heading = stamp;
        }
        self.wrong_headings.add(&info.wrong_headings);
        self.note(stamp, &boxes);
        Ok(())
    }

    fn note(&mut self, stamp: Nanos, boxes: &Boxes) {
        self.of += boxes.0.len();
        let fault: fn(&Box3) -> Option<String> = match self.array {
            Stream::Detections => detection_fault,
            _ => box_fault,
        };
        for fault in boxes.0.iter().filter_map(fault) {
            self.count += 1;
            self.first.get_or_insert((stamp, fault));
        }
    }

    fn end(mut self, topic: &str, of_companion: &str) -> Vec<String> {
        for (stamp, boxes) in std::mem::take(&mut self.arrays) {
            self.note(stamp, &boxes);
        }
        let implausible = self.first.map(|(stamp, fault)| {
            format!(
                "{topic}: {} of {} boxes are left out, because no object can have such numbers: the first, at {:.3} s, has {fault}; \
                 {PLAUSIBLE_BOX}: correct the program that wrote them",
                self.count,
                self.of,
                to_seconds(stamp)
            )
        });
        let WrongHeadings { count, first } = self.wrong_headings;
        let [note, remedy] = WRONG_HEADINGS;
        let headings = (count > 0).then(|| {
            let at = to_seconds(self.first_heading);
            format!(
                "{of_companion}: {count} of {} boxes {note} (the first, at {at:.3} s, has {first}); {remedy}",
                self.of
            )
        });
        implausible.into_iter().chain(headings).collect()
    }
}

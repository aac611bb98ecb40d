//! Messages one after the other, as Python's iterators.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Mutex;

use pyo3::prelude::*;
use realo_logs::{Entry, LogError, LogReader, Stream};
use realo_operator::Source;
use realo_player::{Output, Player};
use realo_schemas::geometry::View;
use realo_schemas::{Boxes, GroundTruth, Header, Kind, Message, Nanos, is_same_stamp};

use crate::{Row, refused, row, unreadable};

type Next = dyn Iterator<Item = Result<Message, String>> + Send;

/// An iterator over messages, each as its Arrow row.
#[pyclass(frozen, module = "realo._realo")]
pub struct Messages {
    next: Mutex<Box<Next>>,
}

impl Messages {
    pub fn new(next: impl Iterator<Item = Result<Message, String>> + Send + 'static) -> Self {
        Messages {
            next: Mutex::new(Box::new(next)),
        }
    }
}

#[pymethods]
impl Messages {
    fn __iter__(this: Py<Self>) -> Py<Self> {
        this
    }

    fn __next__(&self, py: Python) -> PyResult<Option<Row>> {
        let next = py.detach(|| self.next.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).next());
        let next = next.transpose().map_err(|reason| refused("log", reason))?;
        Ok(next.map(|message| row(&message)))
    }
}

/// The messages of a recording of a run: `boxes` (the final ones), `detections` (of each agent alone) or `truth`.
#[pyfunction]
pub fn recorded(path: PathBuf, what: &str) -> PyResult<Messages> {
    let bad = |error: LogError| unreadable("recording", &error);
    let said = |error: LogError| error.to_string();
    Ok(match what {
        "truth" => Messages::new(
            realo_recorder::truth_of(path)
                .map_err(bad)?
                .map(move |m| m.map_err(said)),
        ),
        "boxes" => Messages::new(
            realo_recorder::boxes_of(path)
                .map_err(bad)?
                .map(move |m| m.map_err(said)),
        ),
        "detections" => {
            let all = realo_recorder::read_detections(path).map_err(bad)?;
            Messages::new(all.into_iter().map(Ok))
        }
        _ => {
            return Err(refused(
                "what",
                format!("expected boxes, detections or truth, found `{what}`"),
            ));
        }
    })
}

/// The header of an entry.
pub fn header(entry: &Entry, kind: Kind) -> Header {
    Header::origin(
        &"log".into(),
        &entry.agent,
        kind,
        entry.seq(),
        entry.stamp(),
        entry.ready(),
    )
}

/// Sweeps with their points.
pub struct Clouds(pub LogReader);

impl Iterator for Clouds {
    type Item = Result<Message, String>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut read = || {
            let Some(entry) = self.0.next()? else { return Ok(None) };
            Ok(Some(Message::new(header(&entry, Kind::Points), entry.cloud()?)))
        };
        read().map_err(|error: LogError| error.to_string()).transpose()
    }
}

/// Labels or recorded detections of an agent, with what their companions and views say.
///
/// A companion completes the boxes of its stamp; boxes without one come once the next boxes are complete, or at the end.
pub struct Labels {
    reader: LogReader,
    array: Stream,
    waiting: BTreeMap<Nanos, (Entry, Boxes)>,
    companions: BTreeMap<Nanos, Entry>,
    views: BTreeMap<Nanos, Vec<View>>,
}

impl Labels {
    pub fn new(reader: LogReader, array: Stream) -> Self {
        Labels {
            reader,
            array,
            waiting: BTreeMap::new(),
            companions: BTreeMap::new(),
            views: BTreeMap::new(),
        }
    }

    fn read(&mut self) -> Result<Option<Message>, LogError> {
        while let Some(entry) = self.reader.next()? {
            let stamp = entry.stamp();
            match entry.stream {
                stream if stream == self.array => {
                    let boxes = entry.boxes()?;
                    match take(&mut self.companions, stamp) {
                        Some(companion) => return self.complete(&entry, boxes, Some(&companion)).map(Some),
                        None => drop(self.waiting.insert(stamp, (entry, boxes))),
                    }
                }
                Stream::GroundTruthViews | Stream::OwnLabelsViews => drop(self.views.insert(stamp, entry.views()?)),
                _ => match take(&mut self.waiting, stamp) {
                    Some((array, boxes)) => return self.complete(&array, boxes, Some(&entry)).map(Some),
                    None => drop(self.companions.insert(stamp, entry)),
                },
            }
        }
        match self.waiting.pop_first() {
            Some((_, (array, boxes))) => self.complete(&array, boxes, None).map(Some),
            None => Ok(None),
        }
    }

    fn complete(&mut self, array: &Entry, mut boxes: Boxes, companion: Option<&Entry>) -> Result<Message, LogError> {
        let info = companion.map(|entry| entry.info(&mut boxes)).transpose()?;
        let mut header = header(array, Kind::Truth);
        if let Some(info) = &info {
            header.seq = info.seq;
        }
        if self.array == Stream::Detections {
            header.kind = Kind::Boxes;
            return Ok(Message::new(header, boxes));
        }
        let views = take(&mut self.views, array.stamp()).unwrap_or_default();
        let truth = GroundTruth {
            boxes: boxes.0,
            views,
            key: info.as_ref().is_some_and(|info| info.key),
            agents: info.as_ref().map(|info| info.agents.clone()).unwrap_or_default(),
            points: info.and_then(|info| info.points).unwrap_or_default(),
            ..GroundTruth::default()
        };
        Ok(Message::new(header, truth))
    }
}

/// Takes what has the same stamp but for rounding.
fn take<T>(known: &mut BTreeMap<Nanos, T>, stamp: Nanos) -> Option<T> {
    let near = realo_schemas::SAME_STAMP;
    let at = known
        .range(stamp.saturating_sub(near)..=stamp.saturating_add(near))
        .map(|(at, _)| *at)
        .find(|at| is_same_stamp(*at, stamp))?;
    known.remove(&at)
}

impl Iterator for Labels {
    type Item = Result<Message, String>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().map_err(|error| error.to_string()).transpose()
    }
}

/// The truth of an ego's sweeps as a run plays it: with the points of all agents, in level frames.
pub struct PlayedTruth(pub Player);

impl Iterator for PlayedTruth {
    type Item = Result<Message, String>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            match Source::next(&mut self.0) {
                Ok(Some((_, Output::Truth(header, truth)))) => return Some(Ok(Message::new(header, truth))),
                Ok(Some(_)) => {}
                Ok(None) => return None,
                Err(error) => return Some(Err(error.to_string())),
            }
        }
    }
}

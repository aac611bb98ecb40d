use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use crate::feed::apart_words;
use realo_logs::limits::TRUTH_WINDOW as WINDOW;
use realo_logs::{
    Attitude, BoxesInfo, Entry, Log, LogError, LogReader, Step, Stream, WrongHeadings, clock_words, same,
};
use realo_schemas::geometry::View;
use realo_schemas::{Box3, Boxes, GroundTruth, Name, Nanos, OwnLabels, SAME_STAMP as SAME};

/// The truth of a collaborator that has been silent for so long is not awaited any more, ns.
const SILENT: Nanos = 10_000_000_000;
/// Of more sweeps than one in so many a fault is reported: truth may begin and end within a sweep's time.
const ONE_IN: u64 = 50;
/// As many sweeps at the ends of an agent's truth are none.
const AT_ENDS: u64 = 2;

/// Agent, stream of the array, and stamp.
type Key = (Name, Stream, Nanos);

/// Joins the ground truth of the ego's sweeps with the points that the others have on the same objects.
///
/// Reads ahead of the ego by [`WINDOW`], because a collaborator's nearest sweep may come later, and by as much as truth is logged
/// after its stamp: it may have been labelled afterwards.
pub struct TruthJoin {
    reader: Option<LogReader>,
    agents: Vec<Name>,
    /// By agent.
    footprints: Vec<Option<[f64; 4]>>,
    /// Arrays that wait for their companion, and companions that wait for their array: by agent, stream of the array and stamp.
    boxes: BTreeMap<Key, Boxes>,
    companions: BTreeMap<Key, Entry>,
    /// Keys read at the newest log time: their counterpart may be the next message.
    just_read: BTreeSet<Key>,
    /// Views by stream and stamp.
    views: BTreeMap<Stream, BTreeMap<Nanos, Vec<View>>>,
    /// Recent sweeps of the ego for which there was nothing.
    missed: VecDeque<Nanos>,
    /// What is known of the ego's sweeps, by stamp.
    ego: BTreeMap<Nanos, OfEgo>,
    /// What makes the ego's frames level, where they are not.
    level: Option<Arc<Attitude>>,
    /// Which of the ego's streams complete a sweep: truth and own labels.
    complete: [bool; 2],
    /// Which of these have views.
    viewed: Vec<Stream>,
    others: BTreeMap<Name, VecDeque<Counts>>,
    /// Stamps of the ego's sweeps whose truth has points, and those of them near which an agent has none.
    counted: u64,
    apart_from: BTreeMap<Name, Vec<Nanos>>,
    read_to: Nanos,
    /// By agent and stream, the longest time from a stamp to its log time so far, ns.
    late: BTreeMap<(Name, Stream), Nanos>,
    /// By agent: messages whose publish time is not their stamp, and the first in words.
    apart: BTreeMap<Name, (u64, String)>,
    /// By agent: messages whose stamp is later than their log time, and the first in words.
    ahead: BTreeMap<Name, (u64, String)>,
    /// By agent: boxes whose heading cannot be right, of how many.
    wrong_headings: BTreeMap<Name, (WrongHeadings, u64)>,
    /// By agent: arrays without a companion, and companions without an array.
    unpaired: BTreeMap<Name, u64>,
}

/// What the log says is around the ego at a sweep.
#[derive(Default)]
struct OfEgo {
    truth: Option<(Boxes, BoxesInfo)>,
    own: Option<Box<OwnLabels>>,
}

struct Counts {
    stamp: Nanos,
    by_track: BTreeMap<u64, u32>,
}

fn footprint(log: &Log, agent: &Name) -> Option<[f64; 4]> {
    log.info().agent(agent)?.footprint
}

impl TruthJoin {
    /// `agents`: the ego, then its collaborators. Sweeps lie at log times from `from` on. `level` makes what is around the
    /// ego level.
    pub fn new(log: &Log, agents: &[Name], from: Nanos, level: Option<Arc<Attitude>>) -> Result<Self, LogError> {
        let has_truth = |agent: &&Name| log.has(agent, Stream::GroundTruth);
        let mut wanted = Vec::new();
        for agent in agents.iter().filter(has_truth) {
            log.need(agent, Stream::GroundTruthInfo)?;
            wanted.extend([(&**agent, Stream::GroundTruth), (&**agent, Stream::GroundTruthInfo)]);
        }
        let ego = &agents[0];
        let has_own = log.has(ego, Stream::OwnLabels);
        if has_own {
            log.need(ego, Stream::OwnLabelsInfo)?;
            wanted.extend([(&**ego, Stream::OwnLabels), (&**ego, Stream::OwnLabelsInfo)]);
        }
        let mut viewed = Vec::new();
        for (stream, of) in [
            (Stream::GroundTruthViews, has_truth(&ego)),
            (Stream::OwnLabelsViews, has_own),
        ] {
            if of && log.has(ego, stream) {
                wanted.push((&**ego, stream));
                viewed.push(stream);
            }
        }
        let margin = 2 * WINDOW;
        let complete = [has_truth(&ego), has_own];
        let reader = if complete.contains(&true) {
            Some(log.read(&wanted, from.saturating_sub(margin), Nanos::MAX)?)
        } else {
            None
        };
        let others = agents[1..]
            .iter()
            .filter(has_truth)
            .map(|agent| (agent.clone(), VecDeque::new()))
            .collect();
        Ok(TruthJoin {
            reader,
            agents: agents.to_vec(),
            footprints: agents.iter().map(|agent| footprint(log, agent)).collect(),
            boxes: BTreeMap::new(),
            companions: BTreeMap::new(),
            just_read: BTreeSet::new(),
            views: BTreeMap::new(),
            missed: VecDeque::new(),
            ego: BTreeMap::new(),
            level,
            complete,
            viewed,
            others,
            counted: 0,
            apart_from: BTreeMap::new(),
            read_to: Nanos::MIN,
            late: BTreeMap::new(),
            apart: BTreeMap::new(),
            ahead: BTreeMap::new(),
            wrong_headings: BTreeMap::new(),
            unpaired: BTreeMap::new(),
        })
    }

    /// The truth of the ego's sweep at `stamp`; without boxes and not scored where the log has none. Stamps must rise. Also, how
    /// far truth lay that could not be joined from a sweep that has none, ns.
    pub fn at(&mut self, stamp: Nanos) -> Result<(GroundTruth, Vec<Nanos>), LogError> {
        while !self.knows(stamp) && self.read_one()? {}
        let lost = self.forget(stamp);
        let mut truth = GroundTruth {
            agents: self.agents.clone(),
            ego_footprint: self.footprints[0],
            other_footprints: self.footprints[1..].to_vec(),
            ..GroundTruth::default()
        };
        let Some(at) = same(&self.ego, stamp) else {
            self.missed.push_back(stamp);
            return Ok((truth, lost));
        };
        let OfEgo { truth: known, own } = self.ego.remove(&at).unwrap_or_default();
        truth.own = own;
        if let Some(own) = &mut truth.own {
            own.views = self.views_at(Stream::OwnLabelsViews, at);
        }
        if let Some((boxes, info)) = known {
            if let Some(own) = &info.points {
                self.note_joined(stamp);
                truth.points = self.points(stamp, &boxes.0, own);
            }
            (truth.boxes, truth.key) = (boxes.0, info.key);
            truth.views = self.views_at(Stream::GroundTruthViews, at);
        }
        Ok((truth, lost))
    }

    /// Others, with how many of the ego's sweeps were scored without their truth, and of how many. `is_whole`: all of the log was
    /// played; `has_sweep`: whether an agent has a sweep near a stamp.
    pub fn unjoined(&self, is_whole: bool, has_sweep: impl Fn(&Name, Nanos) -> bool) -> BTreeMap<Name, [u64; 2]> {
        let mut unjoined = BTreeMap::new();
        for (agent, stamps) in &self.apart_from {
            // Its sweeps may be of another time too.
            if is_whole && stamps.len() as u64 == self.counted {
                unjoined.insert(agent.clone(), [self.counted; 2]);
                continue;
            }
            let apart = stamps.iter().filter(|stamp| has_sweep(agent, **stamp)).count() as u64;
            if apart > AT_ENDS && apart * ONE_IN > self.counted {
                unjoined.insert(agent.clone(), [apart, self.counted]);
            }
        }
        unjoined
    }

    fn note_joined(&mut self, stamp: Nanos) {
        self.counted += 1;
        for agent in &self.agents[1..] {
            if self.nearest(agent, stamp).is_none() {
                self.apart_from.entry(agent.clone()).or_default().push(stamp);
            }
        }
    }

    /// How far what is left lay from sweeps that have no truth, ns.
    pub fn finish(&mut self) -> Vec<Nanos> {
        self.forget(Nanos::MAX)
    }

    fn knows(&self, stamp: Nanos) -> bool {
        let stamp = stamp.saturating_sub(SAME);
        let reached = |of: fn(&OfEgo) -> bool| self.ego.range(stamp..).any(|(_, known)| of(known));
        let [truth, own] = self.complete;
        let viewed = |stream: &Stream| {
            let last = self.views.get(stream).and_then(|views| views.last_key_value());
            last.is_some_and(|(last, _)| *last >= stamp)
        };
        let all = (!truth || reached(|known| known.truth.is_some()))
            && (!own || reached(|known| known.own.is_some()))
            && self.viewed.iter().all(viewed)
            && self
                .others
                .values()
                .all(|counts| counts.back().is_some_and(|counts| counts.stamp >= stamp));
        all || self.is_read(stamp.saturating_add(2 * WINDOW))
    }

    /// Whether everything of a stamp must have been read, as late as truth has been logged so far.
    fn is_read(&self, stamp: Nanos) -> bool {
        let ego = &self.agents[0];
        let of_ego = [Stream::GroundTruth, Stream::OwnLabels].into_iter().zip(self.complete);
        let of_ego = of_ego
            .filter(|(_, has)| *has)
            .map(|(stream, _)| (ego, stream, Nanos::MAX));
        let of_others = self.others.keys().map(|agent| (agent, Stream::GroundTruth, SILENT));
        of_ego.chain(of_others).all(|(agent, stream, most)| {
            let late = self.late.get(&(agent.clone(), stream)).copied().unwrap_or(most);
            self.read_to > stamp.saturating_add(late)
        })
    }

    /// By agent: how many messages since the last call have a publish time that is not their stamp, and the first in words.
    pub fn take_apart(&mut self) -> BTreeMap<Name, (u64, String)> {
        std::mem::take(&mut self.apart)
    }

    /// The same of messages whose stamp is later than their log time.
    pub fn take_ahead(&mut self) -> BTreeMap<Name, (u64, String)> {
        std::mem::take(&mut self.ahead)
    }

    /// By agent: boxes that were read since the last call and whose heading cannot be right, of how many.
    pub fn take_wrong_headings(&mut self) -> BTreeMap<Name, (WrongHeadings, u64)> {
        std::mem::take(&mut self.wrong_headings)
    }

    /// By agent: messages since the last call that are left out because their companion, or what they accompany, is not there.
    pub fn take_unpaired(&mut self) -> BTreeMap<Name, u64> {
        std::mem::take(&mut self.unpaired)
    }

    fn note_headings(&mut self, agent: &Name, info: &BoxesInfo, of: usize) {
        let (wrong, all) = self.wrong_headings.entry(agent.clone()).or_default();
        wrong.add(&info.wrong_headings);
        *all += of as u64;
    }

    fn read_one(&mut self) -> Result<bool, LogError> {
        let Some(entry) = self.reader.as_mut().map_or(Ok(None), LogReader::next)? else {
            return Ok(false);
        };
        if entry.ready() != self.read_to {
            self.just_read.clear();
        }
        self.read_to = entry.ready();
        if let Some(apart) = entry.published_apart() {
            let words = || (0, apart_words(&entry, Some(apart)));
            self.apart.entry(entry.agent.clone()).or_insert_with(words).0 += 1;
        }
        if Step::of(entry.stream, entry.stamp(), entry.ready()) == Step::Ahead {
            let words = || (0, clock_words(entry.stamp(), entry.ready()));
            self.ahead.entry(entry.agent.clone()).or_insert_with(words).0 += 1;
        }
        let stamp = entry.stamp();
        let of = match entry.stream {
            Stream::GroundTruth | Stream::GroundTruthInfo | Stream::GroundTruthViews => Stream::GroundTruth,
            _ => Stream::OwnLabels,
        };
        let late = self.late.entry((entry.agent.clone(), of)).or_default();
        *late = (*late).max(entry.ready().saturating_sub(stamp));
        let key = |array: Stream| (entry.agent.clone(), array, stamp);
        let (key, mut boxes, companion) = match entry.stream {
            array @ (Stream::GroundTruth | Stream::OwnLabels) => {
                let boxes = entry.boxes()?;
                match self.companions.remove(&key(array)) {
                    Some(companion) => (key(array), boxes, companion),
                    None => {
                        self.just_read.insert(key(array));
                        self.boxes.insert(key(array), boxes);
                        return Ok(true);
                    }
                }
            }
            Stream::GroundTruthViews | Stream::OwnLabelsViews => {
                let views = self.views.entry(entry.stream).or_default();
                views.insert(stamp, entry.views()?);
                return Ok(true);
            }
            stream => {
                let array = match stream {
                    Stream::OwnLabelsInfo => Stream::OwnLabels,
                    _ => Stream::GroundTruth,
                };
                match self.boxes.remove(&key(array)) {
                    Some(boxes) => (key(array), boxes, entry),
                    None => {
                        self.just_read.insert(key(array));
                        self.companions.insert(key(array), entry);
                        return Ok(true);
                    }
                }
            }
        };
        let info = companion.info(&mut boxes)?;
        self.note_headings(&key.0, &info, boxes.0.len());
        self.take(key, boxes, info);
        Ok(true)
    }

    /// Takes an array with its companion.
    fn take(&mut self, (agent, array, stamp): Key, mut boxes: Boxes, info: BoxesInfo) {
        if array == Stream::OwnLabels {
            self.level(stamp, &mut boxes);
            self.ego.entry(stamp).or_default().own = Some(Box::new(OwnLabels {
                boxes: boxes.0,
                points: info.points.unwrap_or_default(),
                key: info.key,
                views: Vec::new(),
            }));
            return;
        }
        match self.others.get_mut(&agent) {
            Some(counts) => counts.push_back(Counts {
                stamp,
                by_track: by_track(&boxes.0, &info),
            }),
            None => {
                self.level(stamp, &mut boxes);
                self.ego.entry(stamp).or_default().truth = Some((boxes, info));
            }
        }
    }

    /// The views of a stamp, none where the log has none.
    fn views_at(&mut self, stream: Stream, stamp: Nanos) -> Vec<View> {
        let known = self.views.entry(stream).or_default();
        let mut views = same(known, stamp).and_then(|at| known.remove(&at)).unwrap_or_default();
        if let Some(level) = &self.level {
            level.views(stamp, &mut views);
        }
        views
    }

    fn level(&self, stamp: Nanos, boxes: &mut Boxes) {
        if let Some(level) = &self.level {
            level.boxes(stamp, &mut boxes.0);
        }
    }

    /// Leaves what lies before a stamp; gives how far truth that was not asked for lay from the nearest sweep that has none, ns.
    fn forget(&mut self, stamp: Nanos) -> Vec<Nanos> {
        let first = stamp.saturating_sub(SAME);
        let later = self.ego.split_off(&first);
        let mut lost = Vec::new();
        for at in std::mem::replace(&mut self.ego, later).into_keys() {
            let far = |missed: &Nanos| missed.abs_diff(at);
            let near = (0..self.missed.len()).min_by_key(|index| far(&self.missed[*index]));
            let near = near.filter(|index| far(&self.missed[*index]) <= WINDOW as u64);
            lost.extend(
                near.and_then(|index| self.missed.remove(index))
                    .map(|missed| (missed - at).abs()),
            );
        }
        let old = first.saturating_sub(2 * WINDOW);
        while self.missed.front().is_some_and(|missed| *missed < old) {
            self.missed.pop_front();
        }
        let ego = &self.agents[0];
        let is_old = |key: &Key| key.2 < old && !self.just_read.contains(key);
        for ((agent, array, at), _) in self.boxes.extract_if(.., |key, _| is_old(key)) {
            let companions = self.companions.keys().filter(|key| key.0 == agent && key.1 == array);
            let far = companions.map(|key| (key.2 - at).abs()).min();
            match far.filter(|far| *far <= WINDOW) {
                Some(far) if agent == *ego => lost.push(far),
                Some(_) => {}
                None => *self.unpaired.entry(agent).or_default() += 1,
            }
        }
        for ((agent, ..), _) in self.companions.extract_if(.., |key, _| is_old(key)) {
            *self.unpaired.entry(agent).or_default() += 1;
        }
        for views in self.views.values_mut() {
            *views = views.split_off(&first);
        }
        for counts in self.others.values_mut() {
            while counts
                .front()
                .is_some_and(|counts| counts.stamp < stamp.saturating_sub(WINDOW))
            {
                counts.pop_front();
            }
        }
        lost
    }

    /// Points of every agent on every object, `[objects, agents]`.
    fn points(&self, stamp: Nanos, objects: &[Box3], own: &[u32]) -> Vec<u32> {
        let nearest: Vec<Option<&Counts>> = self.agents[1..]
            .iter()
            .map(|agent| self.nearest(agent, stamp))
            .collect();
        let mut points = Vec::with_capacity(objects.len() * self.agents.len());
        for (object, own) in objects.iter().zip(own) {
            points.push(*own);
            let of = |counts: &Option<&Counts>| counts.and_then(|c| c.by_track.get(&object.track?)).copied();
            points.extend(nearest.iter().map(|counts| of(counts).unwrap_or(0)));
        }
        points
    }

    fn nearest(&self, agent: &Name, stamp: Nanos) -> Option<&Counts> {
        let within = self
            .others
            .get(agent)?
            .iter()
            .filter(|counts| (counts.stamp - stamp).abs() <= WINDOW);
        within.min_by_key(|counts| ((counts.stamp - stamp).abs(), counts.stamp))
    }
}

fn by_track(boxes: &[Box3], info: &BoxesInfo) -> BTreeMap<u64, u32> {
    let points = info.points.as_deref().unwrap_or_default();
    boxes
        .iter()
        .zip(points)
        .filter_map(|(object, points)| Some((object.track?, *points)))
        .collect()
}

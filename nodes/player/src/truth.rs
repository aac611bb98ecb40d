use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use realo_logs::{Attitude, BoxesInfo, Log, LogError, LogReader, Stream};
use realo_schemas::geometry::View;
use realo_schemas::{Box3, Boxes, GroundTruth, Name, Nanos, OwnLabels};

/// A collaborator's sweep further from the ego's says nothing about the same scene.
const WINDOW: Nanos = 500_000_000;

/// Joins the ground truth of the ego's sweeps with the points that the others have on the same objects.
///
/// Reads ahead of the ego by at most [`WINDOW`], because a collaborator's nearest sweep may come later.
pub struct TruthJoin {
    reader: Option<LogReader>,
    agents: Vec<Name>,
    footprint: Option<[f64; 4]>,
    /// Arrays that wait for their companion, by agent and stream.
    boxes: BTreeMap<(Name, Stream), Boxes>,
    /// Views that wait for their truth, and their stamp, by stream.
    views: BTreeMap<Stream, (Nanos, Vec<View>)>,
    /// What is known of the ego's sweeps, by stamp.
    ego: BTreeMap<Nanos, OfEgo>,
    /// What makes the ego's frames level, where they are not.
    level: Option<Arc<Attitude>>,
    /// Which of the ego's streams complete a sweep.
    complete: [bool; 2],
    others: BTreeMap<Name, VecDeque<Counts>>,
    read_to: Nanos,
}

/// What the log says is around the ego at a sweep.
#[derive(Default)]
struct OfEgo {
    truth: Option<(Boxes, BoxesInfo, Vec<View>)>,
    own: Option<OwnLabels>,
}

struct Counts {
    stamp: Nanos,
    by_track: BTreeMap<u64, u32>,
}

impl TruthJoin {
    /// `agents`: the ego, then its collaborators. Sweeps lie at log times in `[from, until)`. `level` makes what is around the
    /// ego level.
    pub fn new(
        log: &Log,
        agents: &[Name],
        from: Nanos,
        until: Nanos,
        level: Option<Arc<Attitude>>,
    ) -> Result<Self, LogError> {
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
        for (stream, of) in [
            (Stream::GroundTruthViews, has_truth(&ego)),
            (Stream::OwnLabelsViews, has_own),
        ] {
            if of && log.has(ego, stream) {
                wanted.push((&**ego, stream));
            }
        }
        let margin = 2 * WINDOW;
        let complete = [has_truth(&ego), has_own];
        let reader = if complete.contains(&true) {
            Some(log.read(&wanted, from.saturating_sub(margin), until.saturating_add(margin))?)
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
            footprint: log.info().agent(ego).and_then(|info| info.footprint),
            boxes: BTreeMap::new(),
            views: BTreeMap::new(),
            ego: BTreeMap::new(),
            level,
            complete,
            others,
            read_to: Nanos::MIN,
        })
    }

    /// The truth of the ego's sweep at `stamp`; without boxes and not scored where the log has none. Stamps must rise.
    pub fn at(&mut self, stamp: Nanos) -> Result<GroundTruth, LogError> {
        while !self.knows(stamp) && self.read_one()? {}
        self.forget(stamp);
        let mut truth = GroundTruth {
            agents: self.agents.clone(),
            ego_footprint: self.footprint,
            ..GroundTruth::default()
        };
        let Some(OfEgo { truth: known, own }) = self.ego.remove(&stamp) else {
            return Ok(truth);
        };
        truth.own = own;
        if let Some((boxes, info, views)) = known {
            if let Some(own) = &info.points {
                truth.points = self.points(stamp, &boxes.0, own);
            }
            (truth.boxes, truth.key, truth.views) = (boxes.0, info.key, views);
        }
        Ok(truth)
    }

    fn knows(&self, stamp: Nanos) -> bool {
        let reached = |of: fn(&OfEgo) -> bool| self.ego.range(stamp..).any(|(_, known)| of(known));
        let [truth, own] = self.complete;
        let all = (!truth || reached(|known| known.truth.is_some()))
            && (!own || reached(|known| known.own.is_some()))
            && self
                .others
                .values()
                .all(|counts| counts.back().is_some_and(|counts| counts.stamp >= stamp));
        all || self.read_to > stamp.saturating_add(2 * WINDOW)
    }

    fn read_one(&mut self) -> Result<bool, LogError> {
        let Some(entry) = self.reader.as_mut().map_or(Ok(None), LogReader::next)? else {
            return Ok(false);
        };
        self.read_to = entry.ready();
        let stamp = entry.stamp();
        let array = match entry.stream {
            Stream::GroundTruth | Stream::OwnLabels => {
                self.boxes.insert((entry.agent.clone(), entry.stream), entry.boxes()?);
                return Ok(true);
            }
            Stream::GroundTruthViews | Stream::OwnLabelsViews => {
                self.views.insert(entry.stream, (stamp, entry.views()?));
                return Ok(true);
            }
            Stream::OwnLabelsInfo => Stream::OwnLabels,
            _ => Stream::GroundTruth,
        };
        let mut boxes = self.boxes.remove(&(entry.agent.clone(), array)).unwrap_or_default();
        let info = entry.info(&mut boxes)?;
        if array == Stream::OwnLabels {
            self.level(stamp, &mut boxes);
            self.ego.entry(stamp).or_default().own = Some(OwnLabels {
                boxes: boxes.0,
                points: info.points.unwrap_or_default(),
                key: info.key,
                views: self.views_at(Stream::OwnLabelsViews, stamp),
            });
            return Ok(true);
        }
        match self.others.get_mut(&entry.agent) {
            Some(counts) => counts.push_back(Counts {
                stamp,
                by_track: by_track(&boxes.0, &info),
            }),
            None => {
                self.level(stamp, &mut boxes);
                let views = self.views_at(Stream::GroundTruthViews, stamp);
                self.ego.entry(stamp).or_default().truth = Some((boxes, info, views));
            }
        }
        Ok(true)
    }

    /// The views of a stamp, none where the log has none.
    fn views_at(&mut self, stream: Stream, stamp: Nanos) -> Vec<View> {
        let found = self.views.remove(&stream).filter(|(at, _)| *at == stamp);
        let mut views = found.map(|(_, views)| views).unwrap_or_default();
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

    fn forget(&mut self, stamp: Nanos) {
        self.ego = self.ego.split_off(&stamp);
        for counts in self.others.values_mut() {
            while counts
                .front()
                .is_some_and(|counts| counts.stamp < stamp.saturating_sub(WINDOW))
            {
                counts.pop_front();
            }
        }
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

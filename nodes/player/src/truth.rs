use std::collections::{BTreeMap, VecDeque};

use realo_logs::{BoxesInfo, Log, LogError, LogReader, Stream};
use realo_schemas::{Box3, Boxes, GroundTruth, Name, Nanos};

/// A collaborator's sweep further from the ego's says nothing about the same scene.
const WINDOW: Nanos = 500_000_000;

/// Joins the ground truth of the ego's sweeps with the points that the others have on the same objects.
///
/// Reads ahead of the ego by at most [`WINDOW`], because a collaborator's nearest sweep may come later.
pub struct TruthJoin {
    reader: Option<LogReader>,
    agents: Vec<Name>,
    footprint: Option<[f64; 4]>,
    boxes: BTreeMap<Name, Boxes>,
    ego: VecDeque<(Nanos, Boxes, BoxesInfo)>,
    others: BTreeMap<Name, VecDeque<Counts>>,
    read_to: Nanos,
}

struct Counts {
    stamp: Nanos,
    by_track: BTreeMap<u64, u32>,
}

impl TruthJoin {
    /// `agents`: the ego, then its collaborators. Sweeps lie at log times in `[from, until)`.
    pub fn new(log: &Log, agents: &[Name], from: Nanos, until: Nanos) -> Result<Self, LogError> {
        let has_truth = |agent: &&Name| log.has(agent, Stream::GroundTruth);
        let mut wanted = Vec::new();
        for agent in agents.iter().filter(has_truth) {
            log.need(agent, Stream::GroundTruthInfo)?;
            wanted.extend([(&**agent, Stream::GroundTruth), (&**agent, Stream::GroundTruthInfo)]);
        }
        let ego = &agents[0];
        let margin = 2 * WINDOW;
        let reader = if has_truth(&ego) {
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
            ego: VecDeque::new(),
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
        if let Some((_, boxes, info)) = self.ego.iter().find(|(at, ..)| *at == stamp) {
            truth.boxes = boxes.0.clone();
            truth.key = info.key;
            if let Some(own) = &info.points {
                truth.points = self.points(stamp, &boxes.0, own);
            }
        }
        Ok(truth)
    }

    fn knows(&self, stamp: Nanos) -> bool {
        let reached = |newest: Option<Nanos>| newest.is_some_and(|newest| newest >= stamp);
        let all = reached(self.ego.back().map(|(at, ..)| *at))
            && self
                .others
                .values()
                .all(|counts| reached(counts.back().map(|counts| counts.stamp)));
        all || self.read_to > stamp.saturating_add(2 * WINDOW)
    }

    fn read_one(&mut self) -> Result<bool, LogError> {
        let Some(entry) = self.reader.as_mut().map_or(Ok(None), LogReader::next)? else {
            return Ok(false);
        };
        self.read_to = entry.ready();
        if entry.stream == Stream::GroundTruth {
            self.boxes.insert(entry.agent.clone(), entry.boxes()?);
            return Ok(true);
        }
        let mut boxes = self.boxes.remove(&entry.agent).unwrap_or_default();
        let info = entry.info(&mut boxes)?;
        let stamp = entry.stamp();
        match self.others.get_mut(&entry.agent) {
            Some(counts) => counts.push_back(Counts {
                stamp,
                by_track: by_track(&boxes.0, &info),
            }),
            None => self.ego.push_back((stamp, boxes, info)),
        }
        Ok(true)
    }

    fn forget(&mut self, stamp: Nanos) {
        while self.ego.front().is_some_and(|(at, ..)| *at < stamp) {
            self.ego.pop_front();
        }
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

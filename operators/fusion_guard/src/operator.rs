use std::collections::BTreeMap;
use std::path::PathBuf;

use realo_bev::Computing;
use realo_operator::{Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::report::Fate;
use realo_schemas::{Header, Message, Name, Nanos, Payload, PointCloud, Selection};
use serde::{Deserialize, Serialize};

use crate::boxes::Limits;
use crate::counters::*;
use crate::entry::{Entry, Guarded};
use crate::fit::Noise;
use crate::map_boxes::{MapContent, MapDetector};
use crate::record::Record;
use crate::search::Reach;
use crate::sight::Sight;
use crate::verdict::{Apart, Reason};

/// Objects of the ego and of others by which an agent is placed.
const KNOWN: usize = 512;

/// Settings of [`FusionGuard`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Whether anything is checked; false: selections pass as they are.
    #[setting(default = true)]
    pub enabled: bool,
    /// Model file whose heads find boxes in each BEV map by itself; weights in the same folder. Empty: maps pass unchecked.
    #[setting(role = "model", path)]
    pub model: PathBuf,
    /// Whether the fusion moves boxes by their velocities (its `move_boxes`), so that they are compared at the ego's time.
    pub move_boxes: bool,
    /// Standard deviation along an axis between two agents' centres of one object, m.
    #[setting(default = 0.3, range = 0.01..=10.0)]
    pub place_noise_m: f64,
    /// Standard deviation between two agents' headings of one object, degrees.
    #[setting(default = 4.0, range = 0.1..=90.0)]
    pub heading_noise_deg: f64,
    /// How far collaborators' places may be off, m.
    #[setting(default = 12.0, range = 1.0..=50.0)]
    pub reach_m: f64,
    /// How far their headings may be off, degrees.
    #[setting(default = 12.0, range = 0.0..=45.0)]
    pub reach_deg: f64,
    /// How far their clocks may be off, ms, which is seen with `move_boxes` alone; 0: clocks are taken as they are.
    #[setting(default = 2500, range = 0..=10_000)]
    pub clock_ms: u32,
    /// Whether collaborators that say no pose are placed by the objects that both see.
    #[setting(default = true)]
    pub constellations: bool,
    /// Boxes of a message that are looked at, the best; the others are dropped.
    #[setting(default = 256, range = 1..=2048)]
    pub max_boxes: usize,
    /// Boxes of each side that are compared to find a pose, the best.
    #[setting(default = 64, range = 2..=256)]
    pub max_objects: usize,
    /// Half of what is known of a collaborator is forgotten in this time, s.
    #[setting(default = 10.0, range = 0.1..=3600.0)]
    pub memory_s: f64,
    /// Collaborators that are known at the same time; the one that was silent longest makes room.
    #[setting(default = 256, range = 1..=100_000)]
    pub max_agents: usize,
    /// With a model, how its heads are computed.
    #[setting(flatten)]
    #[serde(flatten)]
    pub computing: Computing,
}

/// Corrects what collaborators say by what the ego sees, and leaves out what it cannot confirm.
#[derive(Describe)]
#[stage(counters(
    CORRECTED_MESSAGES,
    CORRECTED_CLOCKS,
    PLACED_MESSAGES,
    FREE_BOXES,
    UNCHECKED_MESSAGES,
    CONTRADICTED_MESSAGES,
    UNCONFIRMED_MESSAGES,
    DISTRUSTED_MESSAGES,
    SCATTERED_MESSAGES,
    IMPLAUSIBLE_BOXES,
    EXCESS_BOXES,
    WRONG_COVARIANCES,
    FORGOTTEN_AGENTS
))]
pub struct FusionGuard {
    settings: Settings,
    limits: Limits,
    map_detector: Option<MapDetector>,
    ego: Option<Message>,
    sweep: Option<(Header, PointCloud)>,
    records: BTreeMap<Name, (Record, u64)>,
    /// Messages so far.
    messages: u64,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// What the ego says of itself, as the bank and the fusion take it.
    #[port(latest, joined("frame"), any_of(PointCloud, FeatureMap, Boxes), of(Ego))]
    Ego(Message),
    /// The ego's own sweep, which shows where nothing stands; without it ghosts where the ego has no boxes pass.
    #[port(latest, joined("frame"), optional, of(Ego))]
    Clouds(Header, PointCloud),
    /// What the bank chose for it.
    #[port(latest, joined("frame"), of(Ego))]
    Selections(Header, Selection),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The same, with corrected poses, without what is left out.
    #[port(of(Ego))]
    Selections(Header, Selection),
}

/// Why a selection cannot be checked.
#[derive(Debug, thiserror::Error)]
pub enum GuardError {
    /// The selection came alone.
    #[error(
        "a selection without the ego's message of the same set ({0}); wire the message that the bank was asked with to `ego`"
    )]
    Alone(Box<Header>),
    /// The ego's own map is not as the model's.
    #[error(
        "the ego's map does not fit `model`: expected one of {expected}, found one of {found}, {size:?} rows, columns and channels, or one \
         with values that are not finite; name one model file in the encoder, the guard and the fusion"
    )]
    EgoMap {
        /// The model of the guard.
        expected: Name,
        /// That of the map.
        found: Name,
        /// Rows, columns and channels of the map.
        size: [usize; 3],
    },
}

impl Operator for FusionGuard {
    fn build(settings: Settings) -> Result<Self, Error> {
        let limits = Limits {
            noise: Noise {
                place_m: settings.place_noise_m,
                heading_rad: settings.heading_noise_deg.to_radians(),
                pose_m: 5.0,
                pose_rad: 0.1,
            },
            reach: Reach {
                metres: settings.reach_m,
                turn: settings.reach_deg.to_radians(),
            },
            clock_s: f64::from(settings.clock_ms) / 1000.0,
            max_boxes: settings.max_boxes,
            max_objects: settings.max_objects,
            moves: settings.move_boxes,
        };
        let map_detector = match settings.model.as_os_str().is_empty() {
            true => None,
            false => Some(MapDetector::new(
                &settings.model,
                &settings.computing,
                settings.max_boxes,
            )?),
        };
        Ok(FusionGuard {
            map_detector,
            settings,
            limits,
            ego: None,
            sweep: None,
            records: BTreeMap::new(),
            messages: 0,
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        match input {
            Input::Ego(message) => self.ego = Some(message),
            Input::Clouds(header, cloud) => self.sweep = Some((header, cloud)),
            Input::Selections(header, selection) => {
                let ego = self
                    .ego
                    .take()
                    .ok_or_else(|| GuardError::Alone(Box::new(header.clone())))?;
                let sweep = self.sweep.take().map(|(_, cloud)| cloud);
                let entries = match self.settings.enabled {
                    true => self.check(&ego, sweep, selection.entries, out)?,
                    false => selection.entries,
                };
                let query = selection.query;
                out.send(Output::Selections(header, Selection { query, entries }));
            }
        }
        Ok(())
    }
}

impl FusionGuard {
    /// The messages that are kept, corrected.
    fn check(
        &mut self,
        ego: &Message,
        sweep: Option<PointCloud>,
        entries: Vec<Message>,
        out: &mut Outputs<Output>,
    ) -> Result<Vec<Message>, Error> {
        let shown = self.shown(&ego.payload, out)?;
        if let (Payload::FeatureMap(map), Some(detector), None) = (&ego.payload, &self.map_detector, &shown) {
            return Err(GuardError::EgoMap {
                expected: detector.identity().into(),
                found: map.model.clone(),
                size: map.size(),
            }
            .into());
        }
        let mut sight = Sight::of(ego, shown.map(|shown| shown.boxes), sweep, self.limits.max_boxes);
        let mut guarded: Vec<Guarded> = Vec::new();
        for entry in entries {
            let record = self.record(&entry.header.agent, ego.header.stamp, out);
            let shown = self.shown(&entry.payload, out)?;
            let entry = Entry::of(
                &ego.header,
                entry,
                shown,
                &sight.known,
                &self.limits,
                self.settings.constellations,
            )?;
            guarded.push(entry.judge(&sight, record, &self.limits)?);
        }
        // Whom the ego cannot place by its own objects may be placed by those of others that it has confirmed.
        let own = sight.known.len();
        for one in guarded.iter().filter(|one| one.is_confirmed()) {
            sight.known.extend(one.objects().cloned());
            sight.known.truncate(KNOWN.max(own));
        }
        let mut kept = Vec::new();
        for mut one in guarded {
            if one.is_open() && sight.known.len() > own {
                let record = self.record(one.agent(), ego.header.stamp, out);
                one = one.again(&sight, record, &self.limits)?;
            }
            if let Some((own, _)) = self.records.get_mut(one.agent()) {
                one.remember(own);
            }
            kept.extend(settle(one, &ego.header, out));
        }
        Ok(kept)
    }

    /// Returns what a BEV map shows; `None` if it is not a map, cannot be read, or there is no model.
    fn shown(&mut self, payload: &Payload, out: &mut Outputs<Output>) -> Result<Option<MapContent>, Error> {
        match (payload, &mut self.map_detector) {
            (Payload::FeatureMap(map), Some(detector)) => detector.boxes(map, out.steps()),
            _ => Ok(None),
        }
    }

    /// What is known of an agent; of a new one too many, the agent that was silent longest is forgotten.
    fn record(&mut self, agent: &Name, now: Nanos, out: &mut Outputs<Output>) -> Record {
        self.messages += 1;
        if !self.records.contains_key(agent) && self.records.len() >= self.settings.max_agents {
            let silent = self.records.iter().min_by_key(|(_, (_, last))| *last);
            if let Some(silent) = silent.map(|(name, _)| name.clone()) {
                self.records.remove(&silent);
                out.count(&FORGOTTEN_AGENTS, &silent, 1);
            }
        }
        let (record, last) = self.records.entry(agent.clone()).or_default();
        *last = self.messages;
        record.forget(now, self.settings.memory_s);
        record.clone()
    }
}

/// Counts what became of a message, and gives it on if it is kept.
fn settle(one: Guarded, ego: &Header, out: &mut Outputs<Output>) -> Option<Message> {
    let agent = one.agent().clone();
    out.count_of(&WRONG_COVARIANCES, &agent, u64::from(one.had_wrong_covariance()), 1);
    let Some(judgement) = one.judgement() else {
        out.count(&UNCHECKED_MESSAGES, &agent, 1);
        return Some(one.into_message(ego));
    };
    let all = judgement.all;
    out.count_of(&IMPLAUSIBLE_BOXES, &agent, judgement.implausible, all);
    out.count_of(&EXCESS_BOXES, &agent, judgement.excess, all);
    out.count(&FREE_BOXES, &agent, judgement.free);
    let of = [
        (Reason::Contradicted, &CONTRADICTED_MESSAGES),
        (Reason::Unconfirmed, &UNCONFIRMED_MESSAGES),
        (Reason::Distrusted, &DISTRUSTED_MESSAGES),
        (Reason::Scattered, &SCATTERED_MESSAGES),
    ];
    for (reason, counter) in of {
        let is_this = judgement.reason == Some(reason);
        out.count_of(counter, &agent, u64::from(is_this), 1);
        if is_this {
            let [checked, free] = judgement.shares.checked;
            let Apart { far, pairs } = judgement.shares.apart;
            out.found(counter, &agent, || {
                if reason == Reason::Scattered {
                    return format!(
                        "the first: {far} of {pairs} boxes that both see are more than `place_noise_m` beside the ego's"
                    );
                }
                let seen = format!(
                    "of {checked} boxes or cells that the ego sees the place of, {free} are where nothing stands"
                );
                match judgement.shares.impossible {
                    0 => format!("the first: {seen}"),
                    impossible => format!(
                        "the first: {impossible} boxes found in its map are outside it or of impossible size; {seen}"
                    ),
                }
            });
        }
    }
    if judgement.reason.is_some() {
        out.report(one.header(), Fate::Distrusted);
        return None;
    }
    out.count(&PLACED_MESSAGES, &agent, u64::from(one.had_no_pose()));
    out.count(&CORRECTED_MESSAGES, &agent, u64::from(one.is_moved()));
    out.count(&CORRECTED_CLOCKS, &agent, u64::from(judgement.ahead_s != 0.0));
    Some(one.into_message(ego))
}

#[cfg(test)]
mod tests;

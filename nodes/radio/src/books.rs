//! What became of the messages for a peer: its sender says it in numbered sheets, its receiver joins them with what came in.
//!
//! A sheet is JSON, `{"session": 1, "number": 0, "lines": [[kind, seq, bytes, outcome], …]}`, kinds and outcomes as in
//! [`Line`]. A sheet that is lost leaves its messages out of the books, but for those that came in.

use std::collections::{BTreeMap, BTreeSet};

use realo_schemas::report::{Crossing, Fate, Fated, Traffic};
use realo_schemas::{Kind, Name, Nanos};
use serde::{Deserialize, Serialize};

use crate::protocol::{Outcome, Report};
use crate::refusal::Refusal;

const SECOND: Nanos = 1_000_000_000;
/// Lines of a sheet at most, and of a peer a second; a sender has a few kinds at a few tens of messages a second.
const LINES: usize = 1024;
/// Seconds of lines that may come at once, after the way stood still.
const STOOD_STILL: usize = 8;
/// A message that went out whole and did not come in for so long is lost, ns.
const LOST: Nanos = 2 * SECOND;
/// Messages of a kind that are remembered.
const REMEMBERED: usize = 1024;

/// What the sender says of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Line(pub Kind, pub u64, pub u64, pub Outcome);

/// What the sender says of the messages that left its hands since the sheet before.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sheet {
    /// The sender's session.
    pub session: u64,
    /// Counts the session's sheets.
    pub number: u64,
    /// Messages.
    pub lines: Vec<Line>,
}

/// The sender's side.
#[derive(Debug, Default)]
pub struct Sent {
    /// Sizes of messages that are on their way or wait.
    sizes: BTreeMap<(Kind, u64), u64>,
    lines: Vec<Line>,
    number: u64,
}

impl Sent {
    /// A message is offered.
    pub fn offered(&mut self, kind: Kind, seq: u64, bytes: usize) {
        self.sizes.insert((kind, seq), bytes as u64);
    }

    /// Messages left the sender's hands.
    pub fn reported(&mut self, reported: &[Report]) {
        for Report { kind, seq, outcome } in reported {
            let bytes = self.sizes.remove(&(*kind, *seq)).unwrap_or(0);
            self.lines.push(Line(*kind, *seq, bytes, *outcome));
        }
        let surplus = self.lines.len().saturating_sub(LINES);
        self.lines.drain(..surplus);
    }

    /// The next sheet; `None` if there is nothing to say.
    pub fn sheet(&mut self, session: u64) -> Option<Sheet> {
        if self.lines.is_empty() {
            return None;
        }
        self.number += 1;
        Some(Sheet {
            session,
            number: self.number - 1,
            lines: std::mem::take(&mut self.lines),
        })
    }
}

/// What is to be reported of a channel.
#[derive(Debug, Default, PartialEq)]
pub struct News {
    /// By kind: what entered the channel.
    pub traffic: BTreeMap<Kind, Traffic>,
    /// Messages that did not come out of it.
    pub fates: Vec<Fated>,
}

/// The receiver's side, of one peer.
#[derive(Debug)]
pub struct Heard {
    from: Name,
    to: Name,
    kinds: BTreeMap<Kind, Messages>,
    session: u64,
    /// Sheets of the session that came in.
    sheets: BTreeSet<u64>,
    /// Lines that may come, and when that was so.
    allowed: (usize, Nanos),
}

/// Messages of a kind.
#[derive(Debug, Default)]
struct Messages {
    /// Those that came in.
    arrived: BTreeSet<u64>,
    /// Those that were said to have gone out whole, when, and have not come in.
    awaited: BTreeMap<u64, Nanos>,
    /// Those that count as sent.
    sent: BTreeSet<u64>,
}

impl Heard {
    /// Of a peer of whom nothing was heard.
    pub fn new(from: Name, to: Name) -> Self {
        Heard {
            from,
            to,
            kinds: BTreeMap::new(),
            session: 0,
            sheets: BTreeSet::new(),
            allowed: (LINES * STOOD_STILL, Nanos::MIN),
        }
    }

    /// The peer was started anew: it counts from the beginning, and what was awaited is lost.
    fn begin(&mut self, session: u64, news: &mut News) {
        if session > self.session {
            self.settle(None, news);
            self.session = session;
            self.sheets.clear();
            self.kinds.clear();
        }
    }

    /// A message of a session came in.
    pub fn arrived(&mut self, session: u64, kind: Kind, seq: u64, bytes: usize, news: &mut News) {
        self.begin(session, news);
        let messages = self.kinds.entry(kind).or_default();
        messages.awaited.remove(&seq);
        remember(&mut messages.arrived, seq);
        messages.count(kind, seq, bytes as u64, news);
    }

    /// A sheet came in.
    ///
    /// # Errors
    /// [`Refusal::Flood`] of more lines than an agent has.
    pub fn sheet(&mut self, sheet: &Sheet, now: Nanos, news: &mut News) -> Result<(), Refusal> {
        let (left, then) = self.allowed;
        let since = now.saturating_sub(then).clamp(0, SECOND * STOOD_STILL as Nanos);
        let allowed = (left + (since as usize * LINES) / SECOND as usize).min(LINES * STOOD_STILL);
        let left = allowed.checked_sub(sheet.lines.len()).ok_or(Refusal::Flood)?;
        self.allowed = (left, now);
        self.begin(sheet.session, news);
        if sheet.session < self.session || !remember(&mut self.sheets, sheet.number) {
            return Ok(());
        }
        for Line(kind, seq, bytes, outcome) in sheet.lines.iter().take(LINES) {
            let messages = self.kinds.entry(*kind).or_default();
            messages.count(*kind, *seq, *bytes, news);
            let fate = match outcome {
                _ if messages.arrived.contains(seq) => continue,
                Outcome::Sent => {
                    messages.awaited.insert(*seq, now);
                    if messages.awaited.len() > REMEMBERED
                        && let Some((oldest, _)) = messages.awaited.pop_first()
                    {
                        news.fates.push(self.fated(*kind, oldest, Fate::Lost));
                    }
                    continue;
                }
                Outcome::Superseded => Fate::Superseded,
                Outcome::Late => Fate::Stale,
                Outcome::Lost => Fate::Lost,
            };
            news.fates.push(self.fated(*kind, *seq, fate));
        }
        Ok(())
    }

    /// Time goes by: what has not come in for long is lost; at the end all of it.
    pub fn settle(&mut self, now: Option<Nanos>, news: &mut News) {
        let mut lost = Vec::new();
        for (kind, messages) in &mut self.kinds {
            let is_lost = |since: &Nanos| now.is_none_or(|now| now - *since > LOST);
            let gone = messages.awaited.extract_if(.., |_, since| is_lost(since));
            lost.extend(gone.map(|(seq, _)| (*kind, seq)));
        }
        let fates = lost.into_iter().map(|(kind, seq)| self.fated(kind, seq, Fate::Lost));
        news.fates.extend(fates);
    }

    fn fated(&self, kind: Kind, seq: u64, fate: Fate) -> Fated {
        Fated {
            message: Crossing {
                from: self.from.to_string(),
                to: self.to.to_string(),
                kind,
                seq,
            },
            fate,
            r#use: None,
            entry: None,
        }
    }
}

impl Messages {
    fn count(&mut self, kind: Kind, seq: u64, bytes: u64, news: &mut News) {
        if remember(&mut self.sent, seq) {
            let traffic = news.traffic.entry(kind).or_default();
            traffic.sent += 1;
            // So much that no message has it, lest sums of what a peer made up overflow.
            traffic.bytes += bytes.min(u32::MAX.into());
        }
    }
}

/// Whether a number is new, among those that are remembered.
fn remember(numbers: &mut BTreeSet<u64>, seq: u64) -> bool {
    let old = numbers.len() >= REMEMBERED && numbers.first().is_some_and(|first| seq < *first);
    let new = !old && numbers.insert(seq);
    if numbers.len() > REMEMBERED {
        numbers.pop_first();
    }
    new
}

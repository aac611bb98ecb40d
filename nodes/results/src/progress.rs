//! How a run goes, while it goes on: for whoever started it, or for a reader where nobody did.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use realo_schemas::report::{Fate, Fated};
use realo_schemas::{Nanos, to_millis, to_seconds};
use serde::{Deserialize, Serialize};

/// Between two reports to a reader.
const EVERY: Duration = Duration::from_secs(2);
/// Between two reports to whoever started the run.
const OFTEN: Duration = Duration::from_secs(1);
/// What a line begins with that is for whoever started the run. It is not the name of the program, with which errors begin.
const LIVE: &str = "live: ";

/// How the runs of this process go, by their folders.
static KNOWN: Mutex<BTreeMap<PathBuf, RunProgress>> = Mutex::new(BTreeMap::new());

/// How a run goes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunProgress {
    /// Log time from the first boxes to the newest, s.
    pub into_log_s: f64,
    /// Boxes of the ego in a second of the log, since the last report.
    pub hz: f64,
    /// Median age of what was fused since the last report, ms.
    pub age_ms: Option<f64>,
    /// Messages that links lost in the whole run; `None` where no message crossed one.
    pub lost: Option<u64>,
    /// Messages that were too old when the ego asked for them, in the whole run.
    #[serde(default)]
    pub too_old: u64,
}

impl RunProgress {
    /// How a run of this process goes that writes to a folder; `None` before its first report.
    pub fn of(out: &Path) -> Option<RunProgress> {
        KNOWN.lock().unwrap_or_else(PoisonError::into_inner).get(out).cloned()
    }

    /// What a line of a process of a run says; `None` of any other line.
    pub fn from_line(line: &str) -> Option<RunProgress> {
        serde_json::from_str(line.split_once(LIVE)?.1.trim()).ok()
    }

    fn to_line(&self) -> String {
        format!("{LIVE}{}", serde_json::to_string(self).expect("its fields are JSON"))
    }

    /// In a few words.
    pub fn short(&self) -> String {
        let mut words = format!("{:.1} Hz", self.hz);
        if let Some(age) = self.age_ms {
            words.push_str(&format!(", {:.0} ms old", whole(age)));
        }
        if let Some(lost) = self.lost {
            words.push_str(&format!(", {lost} lost"));
        }
        if self.too_old > 0 {
            words.push_str(&format!(", {} too old", self.too_old));
        }
        words
    }
}

/// A number without a place behind the point, and never -0.
fn whole(number: f64) -> f64 {
    number.round() + 0.0
}

impl fmt::Display for RunProgress {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{:.1} s into the log, {:.1} Hz", self.into_log_s, self.hz)?;
        if let Some(age) = self.age_ms {
            write!(f, ", data {:.0} ms old when fused", whole(age))?;
        }
        if let Some(lost) = self.lost {
            write!(f, ", {lost} messages lost on links")?;
        }
        match self.too_old {
            0 => Ok(()),
            old => write!(f, ", {old} too old when asked for"),
        }
    }
}

/// Counts since the last report.
pub(crate) struct Progress {
    out: PathBuf,
    /// Whether somebody prepared the run, and reads what it says.
    is_prepared: bool,
    last: Instant,
    /// Stamp of the first boxes, and of those of the last report.
    begun: Option<[Nanos; 2]>,
    boxes: u64,
    ages: Vec<Nanos>,
    /// Of the whole run.
    lost: u64,
    too_old: u64,
    reported: u64,
}

impl Progress {
    pub fn new(out: &Path, is_prepared: bool) -> Self {
        Progress {
            out: out.into(),
            is_prepared,
            last: Instant::now(),
            begun: None,
            boxes: 0,
            ages: Vec::new(),
            lost: 0,
            too_old: 0,
            reported: 0,
        }
    }

    /// Takes boxes of a stamp, and reports when it is time; `realtime`: whether the stage is a process of its own.
    pub fn boxes(&mut self, stamp: Nanos, realtime: bool) {
        let [_, last] = *self.begun.get_or_insert([stamp; 2]);
        self.boxes += 1;
        let every = if self.is_prepared { OFTEN } else { EVERY };
        if self.last.elapsed() < every || stamp <= last {
            return;
        }
        let live = self.live(stamp);
        match (realtime, self.is_prepared) {
            (true, true) => println!("{}", live.to_line()),
            (true, false) => println!("realo: {live}"),
            (false, _) => {
                let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
                known.insert(self.out.clone(), live);
            }
        }
        self.last = Instant::now();
    }

    /// Takes what was said of messages over links.
    pub fn fates(&mut self, fates: &[Fated]) {
        self.ages
            .extend(fates.iter().filter_map(|fated| Some(fated.r#use?.age_ns)));
        self.reported += fates.iter().filter(|fated| fated.entry.is_none()).count() as u64;
        let count = |fate: Fate| fates.iter().filter(|fated| fated.fate == fate).count() as u64;
        self.lost += count(Fate::Lost);
        self.too_old += count(Fate::Stale);
    }

    /// The report of now; what is counted begins anew.
    fn live(&mut self, stamp: Nanos) -> RunProgress {
        let [first, last] = self.begun.unwrap_or([stamp; 2]);
        let boxes = std::mem::take(&mut self.boxes);
        let mut ages = std::mem::take(&mut self.ages);
        ages.sort_unstable();
        self.begun = Some([first, stamp]);
        // The boxes of the first report are one more than the times between them.
        let steps = boxes - u64::from(last == first);
        RunProgress {
            into_log_s: to_seconds(stamp - first),
            hz: steps as f64 / to_seconds(stamp - last).max(1e-9),
            age_ms: ages.get(ages.len() / 2).map(|age| to_millis(*age)),
            lost: (self.reported > 0).then_some(self.lost),
            too_old: self.too_old,
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        KNOWN.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.out);
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::Kind;
    use realo_schemas::report::{Crossing, Use};

    use super::*;

    fn fated(fate: Fate, age_ms: i64) -> Fated {
        Fated {
            message: Crossing {
                from: "rsu1".into(),
                to: "cav1".into(),
                kind: Kind::Boxes,
                seq: 0,
            },
            fate,
            r#use: (fate == Fate::Used).then_some(Use {
                query: 0,
                age_ns: age_ms * 1_000_000,
            }),
            entry: None,
        }
    }

    const TENTH: Nanos = 100_000_000;

    #[test]
    fn says_where_the_log_is_how_fast_how_old_and_what_was_lost() {
        let mut progress = Progress::new(Path::new("nowhere"), true);
        (0..20).for_each(|at| progress.boxes(at * TENTH, true));
        assert_eq!(progress.live(2_000_000_000).to_string(), "2.0 s into the log, 9.5 Hz");
        let fates = [(Fate::Used, 150), (Fate::Used, 90), (Fate::Used, 160), (Fate::Lost, 0)];
        progress.fates(&fates.map(|(fate, age)| fated(fate, age)));
        (21..=30).for_each(|at| progress.boxes(at * TENTH, true));
        let live = progress.live(3_000_000_000);
        let expected = "3.0 s into the log, 10.0 Hz, data 150 ms old when fused, 1 messages lost on links";
        assert_eq!(live.to_string(), expected);
        assert_eq!(live.short(), "10.0 Hz, 150 ms old, 1 lost");
        progress.fates(&[fated(Fate::Stale, 0), fated(Fate::Stale, 0)]);
        (31..=40).for_each(|at| progress.boxes(at * TENTH, true));
        assert_eq!(progress.live(4_000_000_000).short(), "10.0 Hz, 1 lost, 2 too old");
        let younger = RunProgress {
            age_ms: Some(-0.3),
            ..live.clone()
        };
        assert_eq!(younger.short(), "10.0 Hz, 0 ms old, 1 lost");
        assert!(younger.to_string().contains("data 0 ms old"), "{younger}");
        // As dora writes it.
        let line = format!("14:30:15 stdout score: {}", live.to_line());
        assert_eq!(RunProgress::from_line(&line), Some(live));
        assert_eq!(RunProgress::from_line("14:30:15 stdout score: live: no"), None);
    }

    #[test]
    fn a_run_of_this_process_is_known_while_it_goes_on() {
        let out = Path::new("a folder of this test alone");
        let mut progress = Progress::new(out, true);
        progress.last = Instant::now() - EVERY;
        (0..3).for_each(|at| progress.boxes(at * TENTH, false));
        assert_eq!(RunProgress::of(out).map(|live| live.hz), Some(10.0));
        drop(progress);
        assert_eq!(RunProgress::of(out), None);
    }
}

use std::cmp::Ordering;
use std::collections::BTreeMap;

use realo_operator::{Books, Durations};
use realo_schemas::{Header, Nanos};
use serde::{Deserialize, Serialize};

use crate::{Spread, VERSION};

/// Names `timing.json`.
pub const TIMING: &str = "realo/timing";
/// Key of `latency_ms` beside the stages: from the end of the sweep to the final boxes.
pub const END_TO_END: &str = "end_to_end";
/// Key of `latency_ms` beside the stages: `end_to_end` without the delays that links on the way modelled.
pub const FRAMEWORK: &str = "framework";
/// Mode of a run by the wall clock.
const REALTIME: &str = "realtime";
/// A source that is so late, ms, makes data old enough to change scores: two sweeps.
const LATE_MS: f64 = 200.0;

/// How long things took: `timing.json`. All but `compute_ns` is wall time of the way that the final boxes came.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// [`TIMING`].
    pub schema: String,
    /// [`VERSION`].
    pub version: u32,
    /// Where the log lay that was played; `None` where that is unknown, and of runs over several logs.
    #[serde(default)]
    pub log_path: Option<String>,
    /// The machine of a run in realtime and the program that ran there, for people; `None` of runs over several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
    /// By stage: from its start to its end; and [`END_TO_END`] and [`FRAMEWORK`].
    pub latency_ms: BTreeMap<String, Spread>,
    /// By stage: from when its last input was ready until its start: transport, queue, busy stage.
    pub waiting_ms: BTreeMap<String, Spread>,
    /// By stage: how long the message of this way waited until the last of its partners was ready.
    pub joining_ms: BTreeMap<String, Spread>,
    /// By source: how late it released its messages.
    pub late_ms: BTreeMap<String, Spread>,
    /// By stage and by what triggered its calls: their median, ns; what a compute profile charges.
    pub compute_ns: BTreeMap<String, BTreeMap<String, Nanos>>,
    /// By stage and by step of its calls, in realtime: see `realo_operator::Steps`.
    #[serde(default)]
    pub steps_ms: BTreeMap<String, BTreeMap<String, Spread>>,
    /// Sweeps of the ego that became boxes, per second of log time.
    pub rate_hz: Option<f64>,
    /// What all this is made from.
    pub samples: TimingSamples,
}

/// Distributions, as lists of [ns, count] to three significant digits.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TimingSamples {
    /// By stage.
    pub stages: BTreeMap<String, StageSamples>,
    /// See [`END_TO_END`].
    pub end_to_end: Durations,
    /// See [`FRAMEWORK`].
    pub framework: Durations,
    /// By source.
    pub late: BTreeMap<String, Durations>,
    /// By stage and trigger.
    pub compute: BTreeMap<String, BTreeMap<String, Durations>>,
    /// By stage and step.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub steps: BTreeMap<String, BTreeMap<String, Durations>>,
    /// Sweeps that became boxes in the time below.
    pub processed: u64,
    /// Log time of all sweeps, each with the mean time to the next, ns.
    pub duration_ns: Nanos,
}

/// What one stage on the way of the final boxes took.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageSamples {
    /// From start to end.
    pub latency: Durations,
    /// From ready to start.
    pub waiting: Durations,
    /// From ready to partners ready.
    pub joining: Durations,
}

impl TimingSamples {
    /// Takes the way that final boxes came.
    pub fn add_way(&mut self, header: &Header) {
        let Some((source, stages)) = header.trace.split_first() else {
            return;
        };
        let rate = header.clock.map_or(1.0, |clock| clock.rate);
        let wall = |log: Nanos| (log as f64 / rate).round() as Nanos;
        let (mut ready, mut delayed) = (source.ready, 0);
        for stage in stages {
            let samples = match self.stages.get_mut(&*stage.node) {
                Some(samples) => samples,
                None => self.stages.entry(stage.node.to_string()).or_default(),
            };
            samples.latency.record(wall(stage.done - stage.start));
            samples.waiting.record(wall(stage.start - stage.input));
            samples.joining.record(wall(stage.input - ready));
            delayed += stage.ready - stage.done;
            ready = stage.ready;
        }
        let whole = header.ready - source.ready;
        self.end_to_end.record(wall(whole));
        self.framework.record(wall(whole - delayed));
    }

    /// Takes what the nodes measured of themselves.
    pub fn add_books(&mut self, books: &Books) {
        for (id, node) in &books.nodes {
            if node.late.count() > 0 {
                self.late.entry(id.clone()).or_default().merge(&node.late);
            }
            add(&mut self.compute, id, &node.compute);
            add(&mut self.steps, id, &node.steps);
        }
    }

    /// Adds the samples of another run.
    pub fn merge(&mut self, other: &TimingSamples) {
        for (id, stage) in &other.stages {
            let sum = self.stages.entry(id.clone()).or_default();
            sum.latency.merge(&stage.latency);
            sum.waiting.merge(&stage.waiting);
            sum.joining.merge(&stage.joining);
        }
        self.end_to_end.merge(&other.end_to_end);
        self.framework.merge(&other.framework);
        for (id, durations) in &other.late {
            self.late.entry(id.clone()).or_default().merge(durations);
        }
        for (id, compute) in &other.compute {
            add(&mut self.compute, id, compute);
        }
        for (id, steps) in &other.steps {
            add(&mut self.steps, id, steps);
        }
        self.processed += other.processed;
        self.duration_ns += other.duration_ns;
    }
}

/// Adds what a stage took to what all did, by name.
fn add(all: &mut BTreeMap<String, BTreeMap<String, Durations>>, id: &str, more: &BTreeMap<String, Durations>) {
    if more.is_empty() {
        return;
    }
    let known = all.entry(id.into()).or_default();
    for (name, durations) in more {
        known.entry(name.clone()).or_default().merge(durations);
    }
}

impl Default for Timing {
    fn default() -> Self {
        Timing::of(TimingSamples::default())
    }
}

impl Timing {
    /// The few numbers of many samples.
    pub fn of(samples: TimingSamples) -> Self {
        let of_stages = |pick: fn(&StageSamples) -> &Durations| -> BTreeMap<String, Spread> {
            let stages = samples.stages.iter();
            stages
                .map(|(id, stage)| (id.clone(), Spread::of(pick(stage))))
                .collect()
        };
        let mut latency_ms = of_stages(|stage| &stage.latency);
        for (key, durations) in [(END_TO_END, &samples.end_to_end), (FRAMEWORK, &samples.framework)] {
            latency_ms.insert(key.into(), Spread::of(durations));
        }
        let median = |(trigger, durations): (&String, &Durations)| Some((trigger.clone(), durations.quantile(0.5)?));
        let medians = |(id, compute): (&String, &BTreeMap<String, Durations>)| {
            (id.clone(), compute.iter().filter_map(median).collect())
        };
        let spreads = |(id, steps): (&String, &BTreeMap<String, Durations>)| {
            let steps = steps.iter().map(|(step, took)| (step.clone(), Spread::of(took)));
            (id.clone(), steps.collect())
        };
        let seconds = samples.duration_ns as f64 / 1e9;
        Timing {
            schema: TIMING.into(),
            version: VERSION,
            log_path: None,
            machine: None,
            latency_ms,
            waiting_ms: of_stages(|stage| &stage.waiting),
            joining_ms: of_stages(|stage| &stage.joining),
            late_ms: samples
                .late
                .iter()
                .map(|(id, late)| (id.clone(), Spread::of(late)))
                .collect(),
            compute_ns: samples.compute.iter().map(medians).collect(),
            steps_ms: samples.steps.iter().map(spreads).collect(),
            rate_hz: (samples.duration_ns > 0).then(|| samples.processed as f64 / seconds),
            samples,
        }
    }

    /// What a run in realtime says of sources that released their messages later than they should have; `None` where all kept up.
    pub fn late_note(&self, settings: &crate::Settings) -> Option<String> {
        let (id, late) = self
            .late_ms
            .iter()
            .max_by(|a, b| a.1.p95.partial_cmp(&b.1.p95).unwrap_or(Ordering::Equal))?;
        let p95 = late.p95.filter(|p95| *p95 >= LATE_MS && settings.mode == REALTIME)?;
        Some(format!(
            "{id} was up to {:.1} s behind the log (95 % of its messages up to {:.1} s): this machine did not keep up, so ages, losses and scores are \
             those of a slower one, and clocks seem to step; `--rate 0.5` gives it more time, `--mode virtual` all that it needs",
            late.max.unwrap_or(p95) / 1e3,
            p95 / 1e3
        ))
    }
}

/// Sweeps further apart have a pause between them, as where a log is played again, ns.
const PAUSE: Nanos = 1_400_000_000;

/// How many sweeps a stream has, and the times between them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Pace {
    last: Option<Nanos>,
    /// Times between sweeps, and how many: without pauses, and pauses.
    between: [(Nanos, u64); 2],
    pub count: u64,
}

impl Pace {
    pub fn add(&mut self, stamp: Nanos) {
        if let Some(step) = self.last.map(|last| stamp - last).filter(|step| *step > 0) {
            let (sum, number) = &mut self.between[usize::from(step > PAUSE)];
            (*sum, *number) = (*sum + step, *number + 1);
        }
        self.last = self.last.max(Some(stamp));
        self.count += 1;
    }

    /// Log time of all sweeps, each with the mean time to the next, pauses left out; 0 of fewer than two.
    pub fn duration(&self) -> Nanos {
        let [steps, pauses] = self.between;
        // Where all are far apart, nothing is a pause.
        let (sum, number) = if steps.1 > 0 { steps } else { pauses };
        match number {
            0 => 0,
            _ => (sum as f64 * self.count as f64 / number as f64).round() as Nanos,
        }
    }
}

#[cfg(test)]
mod tests {
    use realo_operator::NodeBooks;
    use realo_schemas::{Clock, Kind, TraceEntry};

    use super::*;

    const MS: Nanos = 1_000_000;

    fn entry(node: &str, [input, start, done, ready]: [Nanos; 4]) -> TraceEntry {
        TraceEntry {
            node: node.into(),
            input: input * MS,
            start: start * MS,
            done: done * MS,
            ready: ready * MS,
        }
    }

    fn header(rate: f64) -> Header {
        let mut header = Header::origin(&"r".into(), &"cav1".into(), Kind::Boxes, 0, 0, 0);
        header.clock = Some(Clock {
            wall_origin: 0,
            log_origin: 0,
            rate,
        });
        // The fusion waits 6 ms for its partner, 1 ms in the queue, and takes 3 ms; the link delays by 20 ms.
        header.trace = vec![
            entry("player", [90, 100, 100, 100]),
            entry("nms", [100, 102, 104, 104]),
            entry("link", [104, 104, 104, 124]),
            entry("fusion", [130, 131, 134, 134]),
        ];
        header.ready = 134 * MS;
        header
    }

    fn max(spread: &Spread) -> f64 {
        (spread.max.unwrap() * 10.0).round() / 10.0
    }

    #[test]
    fn a_way_adds_up_and_is_in_wall_time() {
        for rate in [1.0, 0.5] {
            let mut samples = TimingSamples::default();
            samples.add_way(&header(rate));
            let timing = Timing::of(samples);
            let stages = ["nms", "link", "fusion"];
            let of = |table: &BTreeMap<String, Spread>| stages.map(|stage| max(&table[stage]) * rate);
            assert_eq!(of(&timing.latency_ms), [2.0, 0.0, 3.0]);
            assert_eq!(of(&timing.waiting_ms), [2.0, 0.0, 1.0]);
            assert_eq!(of(&timing.joining_ms), [0.0, 0.0, 6.0]);
            assert_eq!(max(&timing.latency_ms[END_TO_END]) * rate, 34.0);
            assert_eq!(max(&timing.latency_ms[FRAMEWORK]) * rate, 14.0);
            assert!(!timing.latency_ms.contains_key("player"));
        }
    }

    #[test]
    fn tells_lateness_of_sources_from_computing() {
        let (mut player, mut sync) = (NodeBooks::default(), NodeBooks::default());
        player.late.record(900);
        for nanos in [700, 710, 720] {
            sync.compute.entry("poses".into()).or_default().record(nanos);
        }
        sync.compute.entry("poses > sweeps".into()).or_default().record(2_000);
        for nanos in [1_000, 700] {
            sync.steps.entry("pairing".into()).or_default().record(nanos);
        }
        let books = Books {
            nodes: [("player".into(), player), ("sync".into(), sync)].into(),
        };
        let mut samples = TimingSamples::default();
        samples.add_books(&books);
        let timing = Timing::of(samples);
        assert_eq!(timing.late_ms["player"].max, Some(0.0009));
        let by = |mode: &str| crate::Settings {
            mode: mode.into(),
            ..crate::Settings::default()
        };
        assert_eq!(timing.late_note(&by(REALTIME)), None);
        let mut slow = timing.clone();
        slow.late_ms.insert(
            "player".into(),
            Spread {
                p95: Some(2_400.0),
                max: Some(9_731.0),
                ..Spread::default()
            },
        );
        let note = slow.late_note(&by(REALTIME)).unwrap();
        assert!(
            note.starts_with("player was up to 9.7 s behind the log (95 % of its messages up to 2.4 s)"),
            "{note}"
        );
        assert_eq!(slow.late_note(&by("virtual")), None);
        assert!(!timing.compute_ns.contains_key("player"));
        assert_eq!(timing.compute_ns["sync"]["poses"], 710);
        assert_eq!(timing.compute_ns["sync"]["poses > sweeps"], 2_000);
        let pairing = timing.steps_ms["sync"]["pairing"];
        assert_eq!(
            (pairing.p50, pairing.max, pairing.count),
            (Some(0.0007), Some(0.001), 2)
        );
        assert!(!timing.steps_ms.contains_key("player"));
    }

    #[test]
    fn rates_count_the_time_of_the_last_sweep() {
        let mut pace = Pace::default();
        assert_eq!(pace.duration(), 0);
        (0..100).for_each(|i| pace.add(i * 100 * MS));
        assert_eq!(pace.duration(), 10_000 * MS);
        let samples = TimingSamples {
            processed: 50,
            duration_ns: pace.duration(),
            ..TimingSamples::default()
        };
        assert_eq!(Timing::of(samples).rate_hz, Some(5.0));
        assert_eq!(Timing::default().rate_hz, None);
    }

    #[test]
    fn pauses_between_passes_are_no_time_of_sweeps() {
        let (mut once, mut twice, mut slow) = (Pace::default(), Pace::default(), Pace::default());
        for i in 0..100 {
            once.add(i * 100 * MS);
            slow.add(i * 2_000 * MS);
        }
        for pass in 0..2 {
            (0..50).for_each(|i| twice.add(pass * 8_000 * MS + i * 100 * MS));
        }
        assert_eq!(once.duration(), twice.duration());
        assert_eq!(slow.duration(), 200_000 * MS);
    }

    #[test]
    fn merges_as_if_measured_together() {
        let (mut one, mut other, mut both) = (
            TimingSamples::default(),
            TimingSamples::default(),
            TimingSamples::default(),
        );
        for i in 0..50 {
            let mut header = header(1.0);
            header.trace[3].done += i * 71_113;
            header.ready = header.trace[3].done;
            if i % 2 == 0 { &mut one } else { &mut other }.add_way(&header);
            both.add_way(&header);
        }
        let text = serde_json::to_string(&other).unwrap();
        one.merge(&serde_json::from_str(&text).unwrap());
        let (one, both) = (Timing::of(one), Timing::of(both));
        assert_eq!(
            serde_json::to_string(&one).unwrap(),
            serde_json::to_string(&both).unwrap()
        );
    }
}

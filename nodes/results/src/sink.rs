use std::path::PathBuf;

use realo_evaluator::{EvaluationReport, TOPIC};
use realo_runtime::{Argument, Books, Describe, Error, Port, PortId, Sink, unexpected, wrong_port};
use realo_schemas::report::{Channel, LinkReport, from_report};
use realo_schemas::{Boxes, GroundTruth, Header, Message, PayloadType, Report};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::timing::Pace;
use crate::{
    EdgeBooks, Ledger, NodeSummary, Run, RunResult, Samples, Settings, Timing, TimingSamples, add_name, claim,
    link_books, write_run,
};

/// Settings of [`Results`]. All but `out` are told in the result as they are.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Folder of the files; it is made, and an earlier run's files in it are replaced.
    pub out: PathBuf,
    /// Name of the graph.
    pub graph: String,
    /// Name of the log, by which logs are resampled.
    pub log: String,
    /// `realtime`, `virtual` or `offline`; empty: what the messages' clocks say.
    pub mode: String,
    /// Who collaborates.
    pub coop: String,
    /// The ego; empty: what the messages say.
    pub ego: String,
    /// Profile of the link.
    pub link: String,
    /// Compute profile.
    pub compute: String,
    /// Seed.
    pub seed: String,
    /// Kernel path of the networks.
    pub isa: String,
    /// The networks.
    pub model: String,
    /// Who projects.
    pub project: String,
    /// Arguments changed by hand.
    pub set: String,
}

impl Default for Config {
    fn default() -> Self {
        let empty = String::new;
        Config {
            // dora starts nodes in the folder of the graph.
            out: "../target/realo/run".into(),
            graph: empty(),
            log: empty(),
            mode: empty(),
            coop: empty(),
            ego: empty(),
            link: empty(),
            compute: empty(),
            seed: empty(),
            isa: empty(),
            model: empty(),
            project: empty(),
            set: empty(),
        }
    }
}

/// The node `results`.
pub struct Results {
    config: Config,
    result: RunResult,
    samples: Samples,
    timing: TimingSamples,
    ledger: Ledger,
    channels: Vec<Channel>,
    boxes: Pace,
    truth: Pace,
    realtime: bool,
}

const BOXES: PortId = PortId(0);
const TRUTH: PortId = PortId(1);
const EVALUATION: PortId = PortId(2);
const BANK: PortId = PortId(3);
const FUSION: PortId = PortId(4);
const LINK: PortId = PortId(5);
const LINK_STATE: PortId = PortId(6);

const fn report(name: &'static str, about: &'static str) -> Port {
    Port::new(name, &[PayloadType::Report], about).optional()
}

impl Describe for Results {
    type Config = Config;
    const NAME: &'static str = "results";
    const ABOUT: &'static str = "closes the books of a run and writes result.json, timing.json and evaluation.json";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "out",
            about: "folder of the files; an earlier run's files in it are replaced",
        },
        Argument {
            name: "graph",
            about: "name of the graph, told in the result",
        },
        Argument {
            name: "log",
            about: "name of the log, by which pooled runs are resampled",
        },
        Argument {
            name: "mode",
            about: "realtime, virtual or offline, told in the result; empty = what the messages' clocks say",
        },
        Argument {
            name: "coop",
            about: "who collaborates, told in the result",
        },
        Argument {
            name: "ego",
            about: "the ego, told in the result; empty = what the messages say",
        },
        Argument {
            name: "link",
            about: "profile of the link, told in the result",
        },
        Argument {
            name: "compute",
            about: "compute profile, told in the result",
        },
        Argument {
            name: "seed",
            about: "seed of jitter and loss, told in the result",
        },
        Argument {
            name: "isa",
            about: "kernel path of the networks, told in the result",
        },
        Argument {
            name: "model",
            about: "the networks, told in the result",
        },
        Argument {
            name: "project",
            about: "who brings what crosses the link to the ego's frame, told in the result",
        },
        Argument {
            name: "set",
            about: "arguments changed by hand, told in the result",
        },
    ];
    const INPUTS: &'static [Port] = &[
        Port::new("boxes", &[PayloadType::Boxes], "the final boxes"),
        Port::new("truth", &[PayloadType::GroundTruth], "one for every sweep of the ego").optional(),
        report("evaluation", "topic `evaluation`, of the evaluator"),
        report("bank", "topic `bank`, of the feature bank"),
        report("fusion", "topic `fusion`, of the fusion"),
        report("link", "topic `link`, of the link that carries data"),
        report("link_state", "topic `link`, of the link that carries EgoState"),
    ];
    const OUTPUTS: &'static [Port] = &[];
}

impl Sink for Results {
    fn new(config: Config) -> Result<Self, Error> {
        if config.out.as_os_str().is_empty() {
            return Err("argument `out`: expected a folder, found nothing".into());
        }
        claim(&config.out)?;
        let settings = Settings {
            graph: config.graph.clone(),
            mode: config.mode.clone(),
            coop: config.coop.clone(),
            ego: config.ego.clone(),
            link: config.link.clone(),
            compute: config.compute.clone(),
            seed: config.seed.clone(),
            isa: config.isa.clone(),
            model: config.model.clone(),
            project: config.project.clone(),
            set: config.set.clone(),
        };
        Ok(Results {
            config,
            result: RunResult::new(settings),
            samples: Samples::default(),
            timing: TimingSamples::default(),
            ledger: Ledger::default(),
            channels: Vec::new(),
            boxes: Pace::default(),
            truth: Pace::default(),
            realtime: false,
        })
    }

    fn accept(&mut self, port: PortId, message: Message) -> Result<(), Error> {
        match port {
            BOXES => {
                let (header, _): (Header, Boxes) = message.into_parts().map_err(unexpected)?;
                self.take_boxes(&header);
            }
            TRUTH => {
                let (header, truth): (Header, GroundTruth) = message.into_parts().map_err(unexpected)?;
                self.take_truth(&header, &truth);
            }
            EVALUATION => {
                let report: EvaluationReport = document(message, TOPIC)?;
                self.take_evaluation(report)?;
            }
            BANK => self.ledger.bank(document(message, "bank")?),
            FUSION => self.ledger.fusion(document(message, "fusion")?),
            LINK | LINK_STATE => {
                let report: LinkReport = document(message, "link")?;
                self.channels.extend(report.channels);
            }
            _ => return Err(wrong_port(Self::INPUTS, port)),
        }
        Ok(())
    }

    fn finish(&mut self, books: &Books) -> Result<(), Error> {
        let run = self.close(books);
        Ok(write_run(&self.config.out, &run)?)
    }
}

/// The document of a report, which must be of the port's topic.
fn document<T: DeserializeOwned>(message: Message, topic: &str) -> Result<T, Error> {
    let (header, report): (Header, Report) = message.into_parts().map_err(unexpected)?;
    if &*report.topic != topic {
        return Err(format!(
            "expected a report of topic `{topic}`, found `{}` ({header})",
            report.topic
        )
        .into());
    }
    Ok(from_report::<T>(&report)?)
}

impl Results {
    fn take_boxes(&mut self, header: &Header) {
        self.boxes.add(header.stamp);
        self.realtime |= header.clock.is_some();
        self.timing.add_way(header);
        add_name(&mut self.result.egos, &header.agent);
    }

    fn take_truth(&mut self, header: &Header, truth: &GroundTruth) {
        self.truth.add(header.stamp);
        self.realtime |= header.clock.is_some();
        self.result.frames.key += u64::from(truth.key);
        add_name(&mut self.result.egos, &header.agent);
        truth
            .agents
            .iter()
            .for_each(|agent| add_name(&mut self.result.agents, agent));
    }

    fn take_evaluation(&mut self, report: EvaluationReport) -> Result<(), Error> {
        if self.samples.evaluation.is_some() {
            return Err("a second report of topic `evaluation`; a graph has one evaluator".into());
        }
        let mut evaluation = report.evaluation;
        for scene in &mut evaluation.scenes {
            scene.name.clone_from(&self.config.log);
        }
        self.samples.evaluation = Some(evaluation);
        Ok(())
    }

    /// All that is known at the end.
    fn close(&mut self, books: &Books) -> Run {
        let mut result = self.result.clone();
        let settings = &mut result.settings;
        if settings.mode.is_empty() {
            settings.mode = if self.realtime { "realtime" } else { "virtual" }.into();
        }
        if settings.ego.is_empty() {
            settings.ego = result.egos.join(", ");
        }
        add_name(&mut result.egos, &settings.ego);
        add_name(&mut result.logs, &self.config.log);
        let sweeps = if self.truth.count > 0 { self.truth } else { self.boxes };
        result.frames.processed = self.boxes.count;
        result.frames.total = sweeps.count;
        result.frames.skipped = sweeps.count.saturating_sub(self.boxes.count);
        self.close_links(&mut result, books);
        take_books(&mut result, books);
        result.conclude(&self.samples);
        let mut timing = std::mem::take(&mut self.timing);
        timing.add_books(books);
        timing.processed = self.boxes.count;
        timing.duration_ns = sweeps.duration();
        Run {
            result,
            timing: Timing::of(timing),
            samples: std::mem::take(&mut self.samples),
        }
    }

    fn close_links(&mut self, result: &mut RunResult, books: &Books) {
        let (fates, ages) = std::mem::take(&mut self.ledger).close();
        self.samples.ages_ns = ages;
        let own = books.nodes.values().find(|node| node.name == Self::NAME);
        let wired = |port: &str| own.is_some_and(|own| own.inputs.contains_key(port));
        let fates = (wired("bank") && wired("fusion")).then_some(&fates);
        let ego = result.egos.first().map(String::as_str).unwrap_or_default();
        result.links = link_books(&self.channels, ego, fates, books);
    }
}

/// What the nodes counted, and what dora did between them.
fn take_books(result: &mut RunResult, books: &Books) {
    for (id, node) in &books.nodes {
        let mut summary = NodeSummary {
            operator: node.name.clone(),
            errors: node.errors,
            counters: node.counters.clone(),
            ..NodeSummary::default()
        };
        for (port, input) in &node.inputs {
            summary.skipped += input.skipped.total();
            summary.unjoined += input.unjoined.total();
            let edge = EdgeBooks {
                lost: input.transport_lost,
                repeated: input.transport_repeated,
                reordered: input.transport_reordered,
            };
            result.transport.add(&format!("{id}.{port}"), &edge);
        }
        result.nodes.insert(id.clone(), summary);
    }
}

#[cfg(test)]
mod tests;

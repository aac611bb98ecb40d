//! Whether a protocol can score an ego of a log.

use eyre::{Result, bail};
use realo_logs::{AgentKind, Log, Stream};
use realo_results::scoring::{EgoKind, Labels, Protocol};

/// Refuses a protocol for another kind of ego, or for labels that the log does not have.
pub fn protocol_fits(protocol: &Protocol, log: &Log, ego: &str) -> Result<()> {
    log.need_agent(ego)?;
    let (name, path) = (&protocol.name, log.path().display());
    let agents = &log.info().agents;
    let kind_of = |kind: AgentKind| match kind {
        AgentKind::Vehicle => EgoKind::Vehicle,
        AgentKind::Roadside => EgoKind::Roadside,
    };
    let found = agents
        .iter()
        .find(|agent| agent.name == ego)
        .map(|agent| kind_of(agent.kind));
    if let (Some(asked), Some(found)) = (protocol.ego, found)
        && asked != found
    {
        let fitting = agents.iter().filter(|agent| kind_of(agent.kind) == asked);
        let fitting = one_of(fitting.map(|agent| agent.name.as_str()));
        bail!(
            "protocol `{name}` scores a {}, and `{ego}` is a {}: {}",
            in_words(asked),
            in_words(found),
            fitting.map_or("the log has none; choose another --protocol".into(), |fitting| format!(
                "run it with --ego {fitting}, or choose another --protocol"
            ))
        );
    }
    if protocol.labels == Labels::Own && !log.has(ego, Stream::OwnLabels) {
        let having = agents.iter().map(|agent| agent.name.as_str());
        let having = one_of(having.filter(|agent| log.has(agent, Stream::OwnLabels)));
        bail!(
            "protocol `{name}` scores what the ego's own side labelled (`labels: own`), and {path} has no topic {}: {}",
            Stream::OwnLabels.topic(ego),
            having.map_or("choose a protocol with `labels: all`".into(), |having| format!(
                "run it with --ego {having}"
            ))
        );
    }
    Ok(())
}

fn in_words(kind: EgoKind) -> &'static str {
    match kind {
        EgoKind::Vehicle => "vehicle",
        EgoKind::Roadside => "roadside unit",
    }
}

fn one_of<'a>(names: impl Iterator<Item = &'a str>) -> Option<String> {
    let names: Vec<&str> = names.collect();
    (!names.is_empty()).then(|| names.join(" or "))
}

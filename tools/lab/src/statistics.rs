//! `realo-lab simulate --statistics`: what clouds are like, real or simulated, in the figures of `docs/reference/world.md`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use eyre::{Result, WrapErr, bail};
use realo_cli::Outcome;
use realo_logs::{AgentKind, Attitudes, Log, Stream, levelled_while_played};
use realo_schemas::{Box3, Nanos, PointCloud};
use realo_simulator::Sensor;
use realo_simulator::statistics::{Observed, ROADSIDE_SECTOR, Row, Statistics, VEHICLE_SECTOR};

/// Prints the figures of every agent over all logs; `like` thins spinning sensors to the beams of another.
pub fn print(logs: &[PathBuf], like: Option<&str>) -> Result<Outcome> {
    let beams = match like {
        Some(name) => Sensor::named(name)?.elevations(),
        None => Vec::new(),
    };
    let (mut agents, mut outcome) = (BTreeMap::new(), Outcome::Complete);
    for path in logs {
        let log = Log::open(path)?;
        add(&mut agents, &log, &beams).wrap_err_with(|| format!("{}", path.display()))?;
        if let Some(cut) = log.truncation() {
            eprintln!("realo-lab: {}: {cut}", path.display());
            outcome = Outcome::Partial;
        }
    }
    if agents.is_empty() {
        bail!("no agent of these logs has points; simulate without --no-clouds");
    }
    println!("{}", table(&agents));
    for (agent, statistics) in &agents {
        if let whole @ 1.. = statistics.whole_sweeps() {
            eprintln!("realo-lab: {whole} sweeps of {agent} do not lie on rings: --like leaves nothing of them out");
        }
    }
    Ok(outcome)
}

fn add(agents: &mut BTreeMap<String, Statistics>, log: &Log, beams: &[f64]) -> Result<()> {
    for agent in &log.info().agents {
        if !log.has(&agent.name, Stream::Points) {
            continue;
        }
        let Some(sensor) = agent.sensor_position else {
            bail!(
                "agent `{}`: expected its `sensor_position`, where its LiDAR sits in the body frame, [x, y, z] in m, found none; \
                 add it where the log is made",
                agent.name
            );
        };
        let sector = match agent.kind {
            AgentKind::Vehicle => VEHICLE_SECTOR,
            AgentKind::Roadside => ROADSIDE_SECTOR,
        };
        let statistics = agents.entry(agent.name.clone()).or_default();
        each_sweep(log, &agent.name, |cloud, objects| {
            statistics.add(&Observed {
                cloud,
                sensor,
                sector,
                objects,
                beams,
            });
        })?;
    }
    Ok(())
}

/// Points and labels of each sweep of an agent. Labels are the ground truth that the agent has points on, where the log
/// counts them; else the recorded detections, which in imported data are the labels of the agent's own side. All is level, as it
/// is played.
fn each_sweep(log: &Log, agent: &str, mut visit: impl FnMut(&PointCloud, &[Box3])) -> Result<()> {
    let streams = [
        Stream::Points,
        Stream::GroundTruth,
        Stream::GroundTruthInfo,
        Stream::Detections,
    ];
    let wanted: Vec<(&str, Stream)> = streams
        .into_iter()
        .filter(|stream| log.has(agent, *stream))
        .map(|stream| (agent, stream))
        .collect();
    let tilts = levelled_while_played(log)?.contains_key(agent);
    let level = tilts.then(|| Attitudes::read(log, agent, Stream::Pose)).transpose()?;
    let mut reader = log.read_all(&wanted)?;
    let mut sweep = Sweep::default();
    while let Some(entry) = reader.next()? {
        let stamp = entry.stamp();
        if stamp != sweep.stamp {
            sweep.finish(&mut visit);
            sweep.stamp = stamp;
        }
        match entry.stream {
            Stream::Points => {
                let cloud = entry.cloud()?;
                sweep.cloud = Some(match &level {
                    Some(level) => level.sweeps.cloud(stamp, cloud),
                    None => cloud,
                });
            }
            Stream::GroundTruth => {
                let mut boxes = entry.boxes()?;
                if let Some(level) = &level {
                    level.truth.boxes(stamp, &mut boxes.0);
                }
                sweep.truth = Some(boxes);
            }
            Stream::GroundTruthInfo => {
                if let Some(truth) = &mut sweep.truth {
                    let info = entry.info(truth)?;
                    let own = info.agents.iter().position(|counted| &**counted == agent);
                    sweep.points = info.points.zip(own).map(|(points, own)| {
                        let each = info.agents.len();
                        points.iter().skip(own).step_by(each).copied().collect()
                    });
                }
            }
            _ => {
                sweep.detections = entry.boxes()?.0;
                if let Some(level) = &level {
                    level.sweeps.boxes(stamp, &mut sweep.detections);
                }
            }
        }
    }
    sweep.finish(&mut visit);
    Ok(())
}

/// What is known of one stamp.
#[derive(Default)]
struct Sweep {
    stamp: Nanos,
    cloud: Option<PointCloud>,
    truth: Option<realo_schemas::Boxes>,
    points: Option<Vec<u32>>,
    detections: Vec<Box3>,
}

impl Sweep {
    fn finish(&mut self, visit: &mut impl FnMut(&PointCloud, &[Box3])) {
        let Sweep {
            cloud,
            truth,
            points,
            detections,
            ..
        } = std::mem::take(self);
        let Some(cloud) = cloud else { return };
        let objects = match (truth, points) {
            (Some(truth), Some(points)) => {
                let seen = truth.0.into_iter().zip(points).filter(|(_, points)| *points > 0);
                seen.map(|(object, _)| object).collect()
            }
            _ => detections,
        };
        visit(&cloud, &objects);
    }
}

/// A row for each figure, a column for each agent.
fn table(agents: &BTreeMap<String, Statistics>) -> String {
    let columns: Vec<(&String, Vec<Row>)> = agents.iter().map(|(name, all)| (name, all.rows())).collect();
    let names = columns
        .iter()
        .flat_map(|(_, rows)| rows)
        .map(|row| row.name.chars().count());
    let first = names.max().unwrap_or(0);
    let widths: Vec<usize> = columns
        .iter()
        .map(|(name, rows)| {
            let values = rows.iter().map(|row| row.figures().chars().count());
            values.chain([name.chars().count()]).max().unwrap_or(0)
        })
        .collect();
    let mut lines = vec![" ".repeat(first)];
    for ((name, _), width) in columns.iter().zip(&widths) {
        lines[0] += &format!("  {name:>width$}");
    }
    for index in 0..columns[0].1.len() {
        let mut line = format!("{:<first$}", columns[0].1[index].name);
        for ((_, rows), width) in columns.iter().zip(&widths) {
            line += &format!("  {:>width$}", rows[index].figures());
        }
        lines.push(line);
    }
    lines.join("\n")
}

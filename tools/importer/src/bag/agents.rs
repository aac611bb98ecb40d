//! The agents of the map file, with their topics found in the bags.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use realo_bags::map_file::{AgentMap, MapFile, PoseSource};
use realo_bags::messages::Kind;
use realo_bags::{Bag, Encoding, Together, shortest};
use realo_logs::shell;

/// An agent with its topics.
pub struct Agent {
    /// Name in the log.
    pub name: String,
    /// What the map file says.
    pub map: AgentMap,
    /// Its bag, which several files may be together.
    pub bag: usize,
    /// Topics of clouds, the first one's stamps are the sweeps'.
    pub clouds: Vec<Topic>,
    /// Where its poses come from, if that is a topic.
    pub pose: Option<Topic>,
    /// Attitudes.
    pub imu: Option<Topic>,
    /// Positions beside the poses.
    pub fix: Option<Topic>,
    /// The speed of its wheels.
    pub wheels: Option<Topic>,
    /// All objects.
    pub truth: Option<Topic>,
    /// Recorded detections.
    pub detections: Option<Topic>,
}

impl Agent {
    /// Its topics besides clouds.
    pub fn small(&self) -> impl Iterator<Item = &Topic> {
        [
            &self.pose,
            &self.imu,
            &self.fix,
            &self.wheels,
            &self.truth,
            &self.detections,
        ]
        .into_iter()
        .flatten()
    }

    /// The topic of its satellite receiver: that of its positions, or that of its poses.
    pub fn receiver(&self) -> Option<&Topic> {
        let of_poses = self.pose.as_ref().filter(|topic| topic.kind == Kind::NavSatFix);
        self.fix.as_ref().or(of_poses)
    }
}

/// A topic of a bag.
#[derive(Clone, Debug)]
pub struct Topic {
    /// Its name.
    pub name: String,
    /// Place among the connections of its bag.
    pub connection: usize,
    /// What its messages are.
    pub kind: Kind,
}

/// Bags as agents see them.
#[derive(Default)]
pub struct Joined {
    /// Each is a file, or several that are read as one.
    pub bags: Vec<Rc<dyn Bag>>,
    /// The files of each, rising.
    pub files: Vec<Vec<usize>>,
    /// Of each, the connections that another of them has too, as both have the file.
    pub shared: Vec<BTreeSet<usize>>,
    /// Files of which no agent takes anything.
    pub unused: Vec<usize>,
}

impl Joined {
    /// Of files, with those of each agent. Files of no agent are bags, too: what they heard compares clocks.
    fn of(files: &[Rc<dyn Bag>], of_agents: &[Vec<usize>]) -> Self {
        let used: BTreeSet<usize> = of_agents.iter().flatten().copied().collect();
        let unused: Vec<usize> = (0..files.len()).filter(|file| !used.contains(file)).collect();
        let all = of_agents.iter().cloned().chain(unused.iter().map(|file| vec![*file]));
        let lists: Vec<Vec<usize>> = all.collect::<BTreeSet<_>>().into_iter().collect();
        let bag = |list: &Vec<usize>| match list[..] {
            [only] => files[only].clone(),
            _ => Rc::new(Together::new(list.iter().map(|file| files[*file].clone()).collect())),
        };
        let bags: Vec<Rc<dyn Bag>> = lists.iter().map(bag).collect();
        let is_shared = |file: &usize| lists.iter().filter(|list| list.contains(file)).count() > 1;
        let shared = bags.iter().zip(&lists).map(|(bag, list)| {
            let files: Vec<&Rc<dyn Bag>> = list
                .iter()
                .filter(|file| is_shared(file))
                .map(|file| &files[*file])
                .collect();
            let connections = bag.connections().iter().enumerate();
            let held = connections.filter(|(_, own)| files.iter().any(|file| has(file.as_ref(), &own.topic)));
            held.map(|(place, _)| place).collect()
        });
        Joined {
            shared: shared.collect(),
            bags,
            files: lists,
            unused,
        }
    }
}

fn has(bag: &dyn Bag, topic: &str) -> bool {
    bag.connections().iter().any(|connection| connection.topic == topic)
}

/// Finds the bags and the topics of all agents.
///
/// # Errors
/// A bag or a topic that is not there, or holds something else.
pub fn found(files: &[Rc<dyn Bag>], map: &MapFile) -> Result<(Joined, Vec<Agent>), String> {
    let named = |name: &str, reason: String| format!("agents.{name}.{reason}");
    let mut of_agents = Vec::new();
    for (name, agent) in &map.agents {
        of_agents.push(files_of(files, agent).map_err(|reason| named(name, reason))?);
    }
    let joined = Joined::of(files, &of_agents);
    let mut agents: Vec<Agent> = Vec::new();
    for ((name, map), own) in map.agents.iter().zip(&of_agents) {
        let source = Source {
            files,
            joined: &joined,
            bag: joined
                .files
                .iter()
                .position(|list| list == own)
                .expect("it is one of them"),
        };
        let agent = one(&source, name, map).map_err(|reason| named(name, reason))?;
        for other in &agents {
            if let Some(cloud) = agent
                .clouds
                .iter()
                .find(|cloud| is_others(files, &joined, cloud, &agent, other))
            {
                return Err(format!(
                    "agents.{name}.clouds: `{}` is the topic of `{}` already; expected a topic for each agent",
                    cloud.name, other.name
                ));
            }
        }
        agents.push(agent);
    }
    Ok((joined, agents))
}

/// Whether another agent has the clouds of a topic, of a file that both have.
fn is_others(files: &[Rc<dyn Bag>], joined: &Joined, cloud: &Topic, agent: &Agent, other: &Agent) -> bool {
    let [own, its] = [agent, other].map(|agent| &joined.files[agent.bag]);
    let mut both = own.iter().filter(|file| its.contains(file));
    other.clouds.iter().any(|topic| topic.name == cloud.name)
        && both.any(|file| has(files[*file].as_ref(), &cloud.name))
}

/// Where an agent's topics are looked for.
struct Source<'a> {
    files: &'a [Rc<dyn Bag>],
    joined: &'a Joined,
    bag: usize,
}

fn one(source: &Source, name: &str, map: &AgentMap) -> Result<Agent, String> {
    let clouds = map.clouds.iter().map(|cloud| {
        topic(source, "clouds", cloud, "a PointCloud2", |kind| {
            kind == Kind::PointCloud2
        })
    });
    let clouds: Vec<Topic> = clouds.collect::<Result<_, _>>()?;
    let optional = |field, wanted: &Option<String>, what, fits: fn(Kind) -> bool| {
        wanted
            .as_ref()
            .map(|wanted| topic(source, field, wanted, what, fits))
            .transpose()
    };
    let pose = match &map.pose {
        PoseSource::Topic(wanted) => Some(topic(
            source,
            "pose",
            wanted,
            "`tf`, or a topic of Odometry, PoseStamped, PoseWithCovarianceStamped or NavSatFix",
            Kind::is_pose,
        )?),
        PoseSource::Tf | PoseSource::Fixed(_) => None,
    };
    Ok(Agent {
        name: name.into(),
        bag: source.bag,
        clouds,
        pose,
        imu: optional("imu", &map.imu, "an Imu", |kind| kind == Kind::Imu)?,
        fix: optional("fix", &map.fix, "a NavSatFix", |kind| kind == Kind::NavSatFix)?,
        wheels: optional(
            "wheels",
            &map.wheels,
            "a TwistStamped, TwistWithCovarianceStamped or Odometry",
            Kind::is_speed,
        )?,
        truth: optional(
            "truth",
            &map.truth,
            "a Detection3DArray or MarkerArray",
            Kind::is_objects,
        )?,
        detections: optional(
            "detections",
            &map.detections,
            "a Detection3DArray or MarkerArray",
            Kind::is_objects,
        )?,
        map: map.clone(),
    })
}

/// The files of an agent, rising.
fn files_of(files: &[Rc<dyn Bag>], map: &AgentMap) -> Result<Vec<usize>, String> {
    let paths: Vec<&Path> = files.iter().map(|bag| bag.path()).collect();
    if !map.bag.is_empty() {
        let mut found = BTreeSet::new();
        for wanted in &map.bag {
            if !found.insert(named(&paths, wanted)?) {
                return Err(format!(
                    "bag: `{}` is there twice; expected each bag once",
                    wanted.display()
                ));
            }
        }
        return Ok(found.into_iter().collect());
    }
    let clouds = &map.clouds[0];
    let holders = (0..files.len()).filter(|file| files.len() == 1 || has(files[*file].as_ref(), clouds));
    let holders: Vec<usize> = holders.collect();
    match holders.len() {
        1 => Ok(holders),
        number => Err(format!(
            "bag: {number} of the bags have the topic `{}`; name one of {}",
            clouds.escape_debug(),
            listed(paths.into_iter())
        )),
    }
}

fn listed<'a>(paths: impl Iterator<Item = &'a Path>) -> String {
    let paths: Vec<String> = paths.map(|path| format!("`{}`", path.display())).collect();
    paths.join(", ")
}

/// The only bag that a path names: it is the bag's, or its end, or else the bag's name with or without its ending.
fn named(bags: &[&Path], wanted: &Path) -> Result<usize, String> {
    if let Some(exact) = bags.iter().position(|bag| *bag == wanted) {
        return Ok(exact);
    }
    let all = |is: &dyn Fn(&Path) -> bool| (0..bags.len()).filter(|bag| is(bags[*bag])).collect::<Vec<usize>>();
    let mut fitting = all(&|bag: &Path| bag.ends_with(wanted));
    if fitting.is_empty() {
        fitting =
            all(&|bag: &Path| bag.file_name() == wanted.file_name() || bag.file_stem() == Some(wanted.as_os_str()));
    }
    match fitting[..] {
        [only] => Ok(only),
        [] => Err(format!(
            "bag: expected one of {}, found `{}`",
            listed(bags.iter().copied()),
            wanted.display()
        )),
        _ => {
            let unique: Vec<PathBuf> = fitting.iter().map(|bag| shortest(bags, bags[*bag])).collect();
            Err(format!(
                "bag: `{}` fits {}; write one of {}",
                wanted.display(),
                listed(fitting.iter().map(|bag| bags[*bag])),
                listed(unique.iter().map(PathBuf::as_path))
            ))
        }
    }
}

/// What to write so that files of no other agent are read as one with those of a bag, where a file fits.
pub fn with_others(
    files: &[Rc<dyn Bag>],
    joined: &Joined,
    bag: usize,
    fits: impl Fn(&dyn Bag) -> bool,
) -> Option<String> {
    let paths: Vec<&Path> = files.iter().map(|bag| bag.path()).collect();
    let other = joined.unused.iter().find(|file| fits(files[**file].as_ref()))?;
    let short = |file: &usize| shortest(&paths, paths[*file]).display().to_string();
    let list: Vec<String> = joined.files[bag].iter().chain([other]).map(short).collect();
    Some(format!(
        "`{}` has such: if both are of this agent and of one clock, write `bag: [{}]`",
        paths[*other].display(),
        list.join(", ")
    ))
}

fn topic(source: &Source, field: &str, wanted: &str, what: &str, fits: impl Fn(Kind) -> bool) -> Result<Topic, String> {
    let Source { files, joined, bag } = source;
    let whole = joined.bags[*bag].as_ref();
    let bare = |topic: &str| topic.trim_start_matches('/').to_string();
    let is_wanted = |topic: &str| bare(topic) == bare(wanted);
    let found = whole.connections().iter().enumerate();
    let mut named = found.filter(|(_, connection)| is_wanted(&connection.topic)).peekable();
    let shown = wanted.escape_debug();
    if named.peek().is_none() {
        let paths: Vec<&Path> = joined.files[*bag].iter().map(|file| files[*file].path()).collect();
        let other = |bag: &dyn Bag| bag.connections().iter().any(|found| is_wanted(&found.topic));
        let other = with_others(files, joined, *bag, other).map_or(String::new(), |other| format!("; {other}"));
        let commands = shell::words(&paths);
        return Err(format!(
            "{field}: {} has no topic `{shown}`{other}; of the right type it has {}; `realo info {commands}` lists all",
            listed(paths.iter().copied()),
            of_type(whole, &fits),
        ));
    }
    let mut types = Vec::new();
    for (connection, found) in named {
        match Kind::named(&found.kind).filter(|kind| fits(*kind)) {
            Some(kind) => {
                if let Encoding::Other(encoding) = &found.encoding {
                    return Err(format!(
                        "{field}: `{shown}` is serialised as `{}`, expected cdr or ros1; convert the bag with `ros2 bag convert`",
                        encoding.escape_debug()
                    ));
                }
                return Ok(Topic {
                    name: found.topic.clone(),
                    connection,
                    kind,
                });
            }
            None => types.push(found.kind.escape_debug().to_string()),
        }
    }
    Err(format!(
        "{field}: expected {what}, found `{shown}` of type {}",
        types.join(" and ")
    ))
}

/// Topics of a bag whose type fits, in words.
fn of_type(bag: &dyn Bag, fits: impl Fn(Kind) -> bool) -> String {
    let fitting = bag
        .connections()
        .iter()
        .filter(|found| Kind::named(&found.kind).is_some_and(&fits));
    let mut names: Vec<String> = fitting
        .map(|found| format!("`{}`", found.topic.escape_debug()))
        .collect();
    names.sort();
    names.truncate(12);
    match names.is_empty() {
        true => "none".into(),
        false => names.join(", "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_fits_several_bags_is_refused() {
        let bags = ["/x/a/one.bag", "/x/b/one.bag", "/x/two.bag", "/x/two"].map(Path::new);
        for (wanted, expected) in [
            ("/x/a/one.bag", 0),
            ("b/one.bag", 1),
            ("two.bag", 2),
            ("two", 3),
            ("elsewhere/two.bag", 2),
        ] {
            assert_eq!(named(&bags, Path::new(wanted)), Ok(expected), "{wanted}");
        }
        for wanted in ["one.bag", "one"] {
            let error = named(&bags, Path::new(wanted)).unwrap_err();
            let both = "fits `/x/a/one.bag`, `/x/b/one.bag`; write one of `a/one.bag`, `b/one.bag`";
            assert!(error.contains(both), "{error}");
        }
        let error = named(&bags, Path::new("three")).unwrap_err();
        assert!(error.contains("expected one of `/x/a/one.bag`"), "{error}");
    }
}

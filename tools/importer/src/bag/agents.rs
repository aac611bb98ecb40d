//! The agents of the map file, with their topics found in the bags.

use std::path::{Path, PathBuf};

use realo_bags::map_file::{AgentMap, MapFile, PoseSource};
use realo_bags::messages::Kind;
use realo_bags::{Bag, Encoding, shortest};

/// An agent with its topics.
pub struct Agent {
    /// Name in the log.
    pub name: String,
    /// What the map file says.
    pub map: AgentMap,
    /// Its bag.
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

/// Finds the topics of all agents.
///
/// # Errors
/// A bag or a topic that is not there, or holds something else.
pub fn found(bags: &[Box<dyn Bag>], map: &MapFile) -> Result<Vec<Agent>, String> {
    let agent = |(name, agent): (&String, &AgentMap)| {
        one(bags, name, agent).map_err(|reason| format!("agents.{name}.{reason}"))
    };
    let agents: Vec<Agent> = map.agents.iter().map(agent).collect::<Result<_, _>>()?;
    for (place, agent) in agents.iter().enumerate() {
        for other in &agents[..place] {
            let is_others = |cloud: &&Topic| {
                let mut topics = other.clouds.iter();
                other.bag == agent.bag && topics.any(|topic| topic.connection == cloud.connection)
            };
            if let Some(cloud) = agent.clouds.iter().find(is_others) {
                return Err(format!(
                    "agents.{}.clouds: `{}` is the topic of `{}` already; expected a topic for each agent",
                    agent.name, cloud.name, other.name
                ));
            }
        }
    }
    Ok(agents)
}

fn one(bags: &[Box<dyn Bag>], name: &str, map: &AgentMap) -> Result<Agent, String> {
    let place = bag_of(bags, map)?;
    let bag = bags[place].as_ref();
    let clouds = map
        .clouds
        .iter()
        .map(|cloud| topic(bag, "clouds", cloud, "a PointCloud2", |kind| kind == Kind::PointCloud2));
    let clouds: Vec<Topic> = clouds.collect::<Result<_, _>>()?;
    let optional = |field, wanted: &Option<String>, what, fits: fn(Kind) -> bool| {
        wanted
            .as_ref()
            .map(|wanted| topic(bag, field, wanted, what, fits))
            .transpose()
    };
    let pose = match &map.pose {
        PoseSource::Topic(wanted) => Some(topic(
            bag,
            "pose",
            wanted,
            "`tf`, or a topic of Odometry, PoseStamped, PoseWithCovarianceStamped or NavSatFix",
            Kind::is_pose,
        )?),
        PoseSource::Tf | PoseSource::Fixed(_) => None,
    };
    Ok(Agent {
        name: name.into(),
        bag: place,
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

fn bag_of(bags: &[Box<dyn Bag>], map: &AgentMap) -> Result<usize, String> {
    let has = || listed(bags.iter().map(|bag| bag.path()));
    match (&map.bag, bags) {
        (None, [_]) => Ok(0),
        (None, _) => {
            let holds = |bag: &dyn Bag| bag.connections().iter().any(|c| c.topic == map.clouds[0]);
            let holders: Vec<usize> = (0..bags.len()).filter(|place| holds(bags[*place].as_ref())).collect();
            match holders[..] {
                [only] => Ok(only),
                _ => Err(format!(
                    "bag: {} of the bags have the topic `{}`; name one of {}",
                    holders.len(),
                    map.clouds[0].escape_debug(),
                    has()
                )),
            }
        }
        (Some(wanted), _) => {
            let paths: Vec<&Path> = bags.iter().map(|bag| bag.path()).collect();
            named(&paths, wanted)
        }
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

fn topic(bag: &dyn Bag, field: &str, wanted: &str, what: &str, fits: impl Fn(Kind) -> bool) -> Result<Topic, String> {
    let bare = |topic: &str| topic.trim_start_matches('/').to_string();
    let found = bag.connections().iter().enumerate();
    let mut named = found
        .filter(|(_, connection)| bare(&connection.topic) == bare(wanted))
        .peekable();
    let wanted = wanted.escape_debug();
    if named.peek().is_none() {
        let mut has: Vec<String> = bag
            .connections()
            .iter()
            .filter(|connection| Kind::named(&connection.kind).is_some_and(&fits))
            .map(|connection| format!("`{}`", connection.topic.escape_debug()))
            .collect();
        has.sort();
        has.truncate(12);
        let has = if has.is_empty() { "none".into() } else { has.join(", ") };
        let path = bag.path().display();
        return Err(format!(
            "{field}: `{path}` has no topic `{wanted}`; of the right type it has {has}; `realo info {path}` lists all"
        ));
    }
    let mut types = Vec::new();
    for (connection, found) in named {
        match Kind::named(&found.kind).filter(|kind| fits(*kind)) {
            Some(kind) => {
                if let Encoding::Other(encoding) = &found.encoding {
                    return Err(format!(
                        "{field}: `{wanted}` is serialised as `{}`, expected cdr or ros1; convert the bag with `ros2 bag convert`",
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
        "{field}: expected {what}, found `{wanted}` of type {}",
        types.join(" and ")
    ))
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

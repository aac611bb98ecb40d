//! What is probably not as it should be in bags that were joined all the same.

use realo_bags::printable;
use realo_logs::bare;

use super::Import;
use super::small::Small;
use super::sweeps::Sweeps;
use super::track::Track;

/// Poses that begin so near to 0 begin there, m.
const AT_ZERO: f64 = 0.1;

/// A line for each.
pub fn warnings(import: &Import, small: &Small, tracks: &[Track], readers: &[Sweeps]) -> Vec<String> {
    let mut lines: Vec<String> = worlds(import, tracks).into_iter().collect();
    lines.extend(unused(import));
    for (agent, track) in import.agents.iter().zip(tracks) {
        let (count, metres) = track.contradicted;
        if count > 0 {
            lines.push(format!(
                "poses of `{}`: {count} differ from an earlier one of the same stamp, by {metres:.2} m at most; the first counts. Are two \
                 sources on its topic?",
                agent.name
            ));
        }
    }
    let of_clouds = import.agents.iter().zip(readers).flat_map(|(agent, reader)| {
        let topics = agent.clouds.iter().map(|topic| topic.name.clone());
        topics.zip(reader.unstamped.iter().copied())
    });
    let unstamped = small.unstamped.iter().map(|(topic, count)| (topic.clone(), *count));
    for (topic, count) in of_clouds.chain(unstamped).filter(|(_, count)| *count > 0) {
        lines.push(format!(
            "stamps of {count} messages of `{}` are 0: for them the time counts when they were recorded; `clock: log` in the map file takes \
             that time for all topics",
            printable(&topic)
        ));
    }
    for (agent, reader) in import.agents.iter().zip(readers) {
        for (topic, lacking) in agent
            .clouds
            .iter()
            .zip(&reader.lacking)
            .filter(|(_, lacking)| **lacking > 0)
        {
            lines.push(format!(
                "{lacking} of {} sweeps of `{}` have no cloud of `{}` within 60 ms: it ends early, starts late, or its stamps are of another \
                 clock",
                reader.joined,
                agent.name,
                printable(&topic.name)
            ));
        }
    }
    lines
}

/// Files of which no agent takes anything; of an import of all agents.
fn unused(import: &Import) -> Vec<String> {
    let unused = import.joined.unused.iter().filter(|_| import.is_whole);
    let line = |file: &usize| {
        format!(
            "no agent takes anything of `{}`; `bag: [A, B]` of an agent in the map file reads it as one with its own bag",
            import.files[*file].path().display()
        )
    };
    unused.map(line).collect()
}

/// Agents whose poses count from where each of them was switched on are in no common world.
fn worlds(import: &Import, tracks: &[Track]) -> Option<String> {
    let world = bare(&import.map.world);
    let moving = import.agents.iter().zip(tracks).filter(|(_, track)| !track.is_fixed);
    let is_odom = realo_bags::counts_from_start(world);
    let starts_at_zero = |track: &Track| {
        let first = track.poses.first();
        first.is_some_and(|(.., pose)| pose.translation.vector.norm() < AT_ZERO)
    };
    let names: Vec<String> = moving
        .filter(|(_, track)| is_odom || starts_at_zero(track))
        .map(|(agent, _)| format!("`{}`", agent.name))
        .collect();
    if names.len() < 2 {
        return None;
    }
    let why = match is_odom {
        true => format!("are in `{world}`, and such a frame mostly begins at 0 where its own vehicle was switched on"),
        false => format!("each begin at 0 in `{world}`"),
    };
    Some(format!(
        "poses of {} {why}: are they in one world? If not, take `pose` and `world` of a common frame (a map, or positions of satellites), or \
         record a transform from it to each vehicle's frame",
        names.join(" and ")
    ))
}

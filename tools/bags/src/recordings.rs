//! Which bags are of one recorder: of two bags of a vehicle, one may have its clouds and the other its poses.

use std::path::Path;

use nalgebra::Isometry3;
use realo_logs::Frames;

use crate::messages::Kind;
use crate::survey::{Survey, TopicSurvey};

/// Bags that are taken as of one recorder.
pub(crate) struct Recording<'a> {
    /// What is in all of them.
    pub survey: Survey,
    /// The bags, that with the clouds first.
    pub bags: Vec<&'a Path>,
    /// Why they are taken together.
    pub why: &'static str,
}

/// Recordings with clouds, each with the bags that probably belong to it; and bags that belong to none.
pub(crate) fn recordings<'a>(surveys: &'a [Survey]) -> (Vec<Recording<'a>>, Vec<&'a Path>) {
    let (with, without): (Vec<&Survey>, Vec<&Survey>) = surveys.iter().partition(|survey| has_clouds(survey));
    let of: Vec<Option<(usize, &'static str)>> = without.iter().map(|other| owner(&with, &other.path)).collect();
    let recording = |(place, survey): (usize, &&'a Survey)| {
        let others = without.iter().zip(&of);
        let others =
            others.filter_map(|(other, of)| of.filter(|(owner, _)| *owner == place).map(|(_, why)| (*other, why)));
        let others: Vec<(&'a Survey, &'static str)> = others.collect();
        Recording {
            bags: std::iter::once(*survey)
                .chain(others.iter().map(|(other, _)| *other))
                .map(|part| part.path.as_path())
                .collect(),
            why: others.first().map_or("", |(_, why)| why),
            survey: together(survey, others.iter().map(|(other, _)| *other)),
        }
    };
    let found = with.iter().enumerate().map(recording).collect();
    let left = without.iter().zip(&of).filter(|(_, of)| of.is_none());
    (found, left.map(|(other, _)| other.path.as_path()).collect())
}

fn has_clouds(survey: &Survey) -> bool {
    survey.of_kind(Kind::PointCloud2).any(|topic| topic.messages > 0)
}

/// The bag with clouds that a bag without belongs to, with why: the only one, the only one of its folder, or the one whose name begins
/// like its own.
fn owner(with: &[&Survey], path: &Path) -> Option<(usize, &'static str)> {
    if let [_] = with {
        return Some((0, "the only bag with clouds"));
    }
    let near: Vec<usize> = (0..with.len())
        .filter(|place| with[*place].path.parent() == path.parent())
        .collect();
    if let [only] = near[..] {
        return Some((only, "they are in one folder"));
    }
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let own = name(path);
    let alike = |place: &usize| {
        let other = name(&with[*place].path);
        own.chars().zip(other.chars()).take_while(|(a, b)| a == b).count()
    };
    let most = near.iter().map(&alike).max().filter(|most| *most > 0)?;
    let mut best = near.iter().filter(|place| alike(place) == most);
    match (best.next(), best.next()) {
        (Some(only), None) => Some((*only, "their names begin alike")),
        _ => None,
    }
}

/// What is in several bags, as of one.
fn together<'a>(first: &Survey, others: impl Iterator<Item = &'a Survey>) -> Survey {
    let mut whole = Survey {
        path: first.path.clone(),
        format: first.format,
        span: first.span,
        notes: first.notes.clone(),
        decoded: first.decoded.clone(),
        topics: first.topics.clone(),
        frames: Frames::default(),
    };
    let others: Vec<&Survey> = others.collect();
    for survey in std::iter::once(first).chain(others.iter().copied()) {
        // A draft asks which frame is in which, and not where.
        for (child, parent, is_fixed) in survey.frames.parents() {
            whole.frames.insert(is_fixed, 0, parent, child, Isometry3::identity());
        }
    }
    for topic in others.iter().flat_map(|survey| &survey.topics) {
        add_topic(&mut whole.topics, topic);
    }
    whole
}

/// Adds a topic, which may be known of another bag.
fn add_topic(topics: &mut Vec<TopicSurvey>, topic: &TopicSurvey) {
    let is_same = |known: &&mut TopicSurvey| known.topic == topic.topic && known.kind == topic.kind;
    match topics.iter_mut().find(is_same) {
        Some(known) => {
            known.messages += topic.messages;
            known.frames.extend(topic.frames.iter().cloned());
            known.children.extend(topic.children.iter().cloned());
        }
        None => topics.push(topic.clone()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(path: &str, kind: &str) -> Survey {
        let topic = TopicSurvey {
            topic: "/topic".into(),
            kind: kind.into(),
            messages: 3,
            ..TopicSurvey::default()
        };
        Survey {
            path: path.into(),
            format: "a bag",
            span: None,
            notes: Vec::new(),
            decoded: Vec::new(),
            topics: vec![topic],
            frames: Frames::default(),
        }
    }

    #[test]
    fn a_bag_without_clouds_is_of_the_bag_that_is_nearest() {
        let (clouds, poses) = ("sensor_msgs/PointCloud2", "nav_msgs/Odometry");
        /// Bags with what they have, those of each recording, and those of none.
        type Case<'a> = (&'a [(&'a str, &'a str)], &'a [&'a [&'a str]], &'a [&'a str]);
        let cases: [Case; 5] = [
            (
                &[("x/gnss.bag", poses), ("y/lidar.bag", clouds)],
                &[&["y/lidar.bag", "x/gnss.bag"]],
                &[],
            ),
            (
                &[("a/lidar.bag", clouds), ("b/lidar.bag", clouds), ("b/gnss.bag", poses)],
                &[&["a/lidar.bag"], &["b/lidar.bag", "b/gnss.bag"]],
                &[],
            ),
            (
                &[
                    ("1_lidar.bag", clouds),
                    ("2_lidar.bag", clouds),
                    ("1_gnss.bag", poses),
                    ("2_gnss.bag", poses),
                ],
                &[&["1_lidar.bag", "1_gnss.bag"], &["2_lidar.bag", "2_gnss.bag"]],
                &[],
            ),
            (
                &[("a.bag", clouds), ("b.bag", clouds), ("truth.bag", poses)],
                &[&["a.bag"], &["b.bag"]],
                &["truth.bag"],
            ),
            (
                &[("a/1.bag", clouds), ("a/2.bag", clouds), ("b/1.bag", poses)],
                &[&["a/1.bag"], &["a/2.bag"]],
                &["b/1.bag"],
            ),
        ];
        for (bags, expected, left) in cases {
            let surveys: Vec<Survey> = bags.iter().map(|(path, kind)| of(path, kind)).collect();
            let (found, others) = recordings(&surveys);
            let found: Vec<&[&Path]> = found.iter().map(|recording| &recording.bags[..]).collect();
            let expected: Vec<Vec<&Path>> = expected
                .iter()
                .map(|bags| bags.iter().map(Path::new).collect())
                .collect();
            assert_eq!(found, expected);
            assert_eq!(others, left.iter().map(Path::new).collect::<Vec<_>>());
        }
    }
}

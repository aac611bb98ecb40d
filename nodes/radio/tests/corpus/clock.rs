//! Questions and answers about time.

use realo_radio::station::Topic;
use realo_schemas::Nanos;

use super::{MALFORMED, MS, REPLAYED, SESSION, Seed, WALL, words};

/// When the peer answered, on its own clock.
const ANSWERED: Nanos = 123_456 * MS;
const PEER: Nanos = SESSION as Nanos;

pub(super) fn seeds() -> Vec<Seed> {
    let taken = [answers(), synchronised(), questions()].concat();
    let mut seeds: Vec<Seed> = taken
        .into_iter()
        .map(|(case, bytes)| Seed::open(Topic::Clock, case, None, bytes))
        .collect();
    let earlier = words([0, PEER - 1]);
    seeds.push(Seed::open(
        Topic::Clock,
        "question_of_an_earlier_session",
        REPLAYED,
        earlier,
    ));
    for bytes in [0, 7, 15, 32, 4_000] {
        seeds.push(Seed::open(
            Topic::Clock,
            &format!("bytes_{bytes}"),
            MALFORMED,
            vec![1; bytes],
        ));
    }
    seeds
}

fn answers() -> Vec<(&'static str, Vec<u8>)> {
    let answers = [
        ("answer", 0, ANSWERED),
        ("answer_max", 0, Nanos::MAX),
        ("answer_min", 0, Nanos::MIN),
        ("answer_to_nothing", Nanos::MAX, 5),
    ];
    let answer = |(case, asked, answered)| (case, words([asked, answered, PEER]));
    answers.map(answer).into()
}

/// Answers of an agent that knows the log's time line.
fn synchronised() -> Vec<(&'static str, Vec<u8>)> {
    let answers = [
        ("synchronised", 40 * MS - WALL, MS / 10),
        ("synchronised_line_max", Nanos::MAX, MS),
        ("synchronised_line_min", Nanos::MIN, 0),
        ("synchronised_error_max", 0, Nanos::MAX),
        ("synchronised_error_negative", 0, Nanos::MIN),
    ];
    let answer = |(case, line, error)| (case, words([0, ANSWERED, PEER, line, error]));
    answers.map(answer).into()
}

fn questions() -> Vec<(&'static str, Vec<u8>)> {
    let questions = [
        ("question_max", Nanos::MAX, PEER),
        ("question_min", Nanos::MIN, PEER),
        ("question_of_a_later_session", 0, Nanos::MAX),
        ("question_of_the_last_session", 0, -1),
    ];
    let question = |(case, asked, session)| (case, words([asked, session]));
    questions.map(question).into()
}

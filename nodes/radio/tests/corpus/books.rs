//! Sheets that tell what became of messages.

use realo_radio::station::Topic;

use super::{MALFORMED, SESSION, Seed};

pub(super) fn seeds() -> Vec<Seed> {
    let seed =
        |expected| move |(case, text): (&str, String)| Seed::open(Topic::Books, case, expected, text.into_bytes());
    let odd = [odd_values(), odd_structure(), huge()].concat();
    let mut seeds: Vec<Seed> = taken().into_iter().map(seed(None)).collect();
    seeds.extend(odd.into_iter().map(seed(MALFORMED)));
    let no_text = sheet(SESSION, 0, "").bytes().map(|byte| byte | 0x80).collect();
    seeds.push(Seed::open(Topic::Books, "no_text", MALFORMED, no_text));
    seeds
}

fn sheet(session: u64, number: u64, lines: &str) -> String {
    format!(r#"{{"session":{session},"number":{number},"lines":[{lines}]}}"#)
}

/// The first sheet of the peer.
fn first(lines: &str) -> String {
    sheet(SESSION, 0, lines)
}

fn lines(count: u64) -> String {
    let lines: Vec<String> = (0..count).map(|seq| format!(r#"["boxes",{seq},9,"sent"]"#)).collect();
    lines.join(",")
}

fn taken() -> Vec<(&'static str, String)> {
    let max = u64::MAX;
    let bytes_max = format!(r#"["boxes",{max},{max},"lost"],["boxes",0,{max},"lost"]"#);
    let twice = r#"["boxes",1,9,"late"],["boxes",1,9,"sent"],["boxes",1,9,"late"]"#;
    vec![
        ("empty", first("")),
        ("session_max", sheet(max, max, &lines(2))),
        ("session_before", sheet(SESSION - 1, 0, &lines(2))),
        ("bytes_max", first(&bytes_max)),
        ("lines_above", first(&lines(1_025))),
        ("reported_twice", first(twice)),
    ]
}

fn odd_values() -> Vec<(&'static str, String)> {
    vec![
        ("session_above", first("").replace(":5,", ":18446744073709551616,")),
        ("negative", first(r#"["boxes",-1,9,"sent"]"#)),
        ("fraction", first(r#"["boxes",1e400,9,"sent"]"#)),
        ("kind_unknown", first(r#"["nothing",1,9,"sent"]"#)),
        ("outcome_unknown", first(r#"["boxes",1,9,"found"]"#)),
    ]
}

fn odd_structure() -> Vec<(&'static str, String)> {
    vec![
        ("line_short", first(r#"["boxes",1,9]"#)),
        ("line_long", first(r#"["boxes",1,9,"sent",1]"#)),
        ("field_unknown", first("").replace("}", r#","more":1}"#)),
        ("field_twice", first("").replace("}", r#","number":1}"#)),
        ("followed", first("") + "{}"),
        ("cut", first(&lines(3)[..40])),
        ("nothing", String::new()),
    ]
}

fn huge() -> Vec<(&'static str, String)> {
    let text = format!(r#"["{}",1,9,"sent"]"#, "x".repeat(8_000));
    let number = format!(r#"["boxes",{},9,"sent"]"#, "9".repeat(8_000));
    vec![
        ("nested_lists", first(&"[".repeat(8_000))),
        ("nested_alone", "[".repeat(16_000)),
        ("nested_objects", r#"{"lines":"#.repeat(2_000)),
        ("nested_unknown", format!(r#"{{"more":{}"#, "[".repeat(8_000))),
        ("long_text", first(&text)),
        ("long_number", first(&number)),
    ]
}

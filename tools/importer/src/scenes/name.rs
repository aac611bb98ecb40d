//! Names of agents and logs.

use realo_logs::AgentKind;

/// Longest part of a name that is taken over.
const LONGEST: usize = 50;

/// The name in a log of the agent in a folder: `cav_1`, `rsu_1`; another number where `taken` has it.
pub fn agent_name(folder: &str, kind: AgentKind, taken: impl Fn(&str) -> bool) -> String {
    let prefix = match kind {
        AgentKind::Vehicle => "cav",
        AgentKind::Roadside => "rsu",
    };
    let own = plain(folder.trim_start_matches('-'));
    let name = match own.starts_with(prefix) {
        true => own,
        false => format!("{prefix}_{own}"),
    };
    let others = (2..).map(|number| format!("{name}_{number}"));
    let free = std::iter::once(name.clone()).chain(others).find(|name| !taken(name));
    free.unwrap_or(name)
}

/// Letters, digits, `_` and `-` of a text, `_` for others.
pub fn plain(text: &str) -> String {
    let letter = |c: char| match c.is_ascii_alphanumeric() || c == '_' || c == '-' {
        true => c,
        false => '_',
    };
    let name: String = text.chars().take(LONGEST).map(letter).collect();
    match name.is_empty() {
        true => "_".into(),
        false => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_that_a_log_allows_and_differ() {
        let free = |_: &str| false;
        assert_eq!(agent_name("641", AgentKind::Vehicle, free), "cav_641");
        assert_eq!(agent_name("-1", AgentKind::Roadside, free), "rsu_1");
        assert_eq!(agent_name("Straße 5", AgentKind::Roadside, free), "rsu_Stra_e_5");
        assert_eq!(agent_name("1", AgentKind::Roadside, |name| name == "rsu_1"), "rsu_1_2");
    }
}

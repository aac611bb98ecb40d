//! The machine that this runs on.

/// The CPU's name and the number of threads it gives us.
pub fn cpu() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info
        .lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    format!("{}, {threads} threads", name.map_or("unknown", |(_, name)| name.trim()))
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_cpu_has_threads() {
        let said = super::cpu();
        let threads = said
            .rsplit_once(", ")
            .and_then(|(_, threads)| threads.strip_suffix(" threads"));
        assert!(
            threads.is_some_and(|threads| threads.parse::<usize>().is_ok_and(|n| n > 0)),
            "{said}"
        );
    }
}

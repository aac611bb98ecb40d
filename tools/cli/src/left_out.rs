use crate::program;
use realo_logs::Log;

/// Reports the topics of a log that its copy leaves out.
pub fn report_left_out(log: &Log) {
    let left: Vec<String> = log
        .not_read()
        .into_iter()
        .map(|(topic, n)| format!("{topic} ({n} messages)"))
        .collect();
    if !left.is_empty() {
        let path = log.path().display();
        eprintln!(
            "{}: {path}: topics that realo does not read were left out: {}",
            program::name(),
            left.join(", ")
        );
    }
}

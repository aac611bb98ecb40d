//! What stands before a table: of each run the few numbers that matter.

use realo_results::{END_TO_END, Run};

use crate::cells::{NONE, age, count, kilobytes};
use crate::columns::{OFFLINE, STATE, has_latency, known_aps, mean_aps, median_age, payload, unscored_boxes};
use crate::text::{Align, one_line, paragraph, width_of, write_row};

/// Between two columns.
const GAP: usize = 2;

/// Of each run accuracy, traffic, age, pace and losses, a line each; then sentences about all of them.
pub fn opening(runs: &[(&str, &Run)], sentences: &[String], width: usize) -> String {
    let names: Vec<String> = runs.iter().map(|(name, _)| one_line(name)).collect();
    let rows: Vec<[String; 5]> = runs.iter().map(|(_, run)| numbers(run)).collect();
    let widths: Vec<usize> = (0..5)
        .map(|at| rows.iter().map(|row| width_of(&row[at])).max().unwrap_or(0))
        .collect();
    let numbers = widths.iter().map(|width| width + GAP).sum::<usize>();
    let longest = names.iter().map(|name| width_of(name)).max().unwrap_or(0);
    let beside = longest + numbers <= width;
    let mut text = String::new();
    for (name, row) in names.iter().zip(&rows) {
        if !beside {
            text.push_str(&paragraph(&format!("{name}: {}", row.join(", ")), width));
            continue;
        }
        let cells: Vec<[String; 1]> = row.iter().map(|cell| [cell.clone()]).collect();
        let cells = cells
            .iter()
            .zip(&widths)
            .map(|(cell, width)| (&cell[..], *width, GAP, Align::Left));
        let name = [name.clone()];
        write_row(
            &mut text,
            std::iter::once((&name[..], longest, 0, Align::Left)).chain(cells),
        );
    }
    for sentence in sentences {
        text.push_str(&paragraph(&one_line(sentence), width));
    }
    text
}

/// The five numbers, each with its unit.
fn numbers(run: &Run) -> [String; 5] {
    let result = &run.result;
    let accuracy = match (mean_aps(run), known_aps(run)) {
        (known, _) if !known.is_empty() => format!("mAP {}", known.join(" / ")),
        // Of one class it is no mean.
        (_, Some((classes, known))) if classes.len() == 1 => format!("AP of {} {}", classes[0], known.join(" / ")),
        (_, Some((classes, known))) => format!("mAP of {} {}", classes.join(", "), known.join(" / ")),
        // Without scores the number of boxes is what is known of them.
        (_, None) => match unscored_boxes(run) {
            Some(boxes) => format!("{:.1} boxes a sweep", boxes.per_frame),
            None => format!("mAP {NONE}"),
        },
    };
    let traffic = payload(result).map_or(NONE.into(), kilobytes);
    let is_offline = result.settings.mode == OFFLINE;
    let old = median_age(run).map_or(NONE.into(), age);
    let old = match is_offline {
        true => format!("stamps {old} ms apart"),
        false => format!("data {old} ms old"),
    };
    let latency = run.timing.latency_ms.get(END_TO_END).and_then(|latency| latency.p50);
    let pace = match (run.timing.rate_hz, latency.filter(|_| has_latency(run))) {
        (Some(rate), Some(latency)) => format!("{rate:.1} Hz after {} ms", age(latency)),
        (Some(rate), None) => format!("{rate:.1} Hz"),
        (None, _) => format!("{NONE} Hz"),
    };
    let channels = result.channels().filter(|(_, kind, _)| *kind != STATE);
    let (mut lost, mut too_old) = (result.transport.total_lost, 0);
    for (.., books) in channels {
        lost += books.lost;
        too_old += books.accounted.as_ref().map_or(0, |accounted| accounted.fates.stale);
    }
    let mut gone = format!("{} lost", count(lost));
    if too_old > 0 {
        gone += &format!(", {} too old", count(too_old));
    }
    match result.frames.key_skipped {
        0 => {}
        1 => gone += ", 1 sweep without boxes",
        skipped => gone += &format!(", {} sweeps without boxes", count(skipped)),
    }
    [accuracy, format!("{traffic} KB a sweep"), old, pace, gone]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::run;

    #[test]
    fn without_objects_of_a_class_the_others_are_named_with_their_ap() {
        let mut one = run("a", "cav1", 1);
        let accuracy = &mut one.result.accuracy.as_mut().unwrap().sorted;
        accuracy.mean_ap.values_mut().for_each(|mean| *mean = None);
        let classes: Vec<String> = accuracy.ap.keys().cloned().collect();
        for (place, class) in classes.iter().enumerate() {
            let known = (place < 1).then_some(0.5);
            accuracy
                .ap
                .get_mut(class)
                .unwrap()
                .values_mut()
                .for_each(|ap| *ap = known);
        }
        assert_eq!(numbers(&one)[0], format!("AP of {} 0.500 / 0.500", classes[0]));
        let accuracy = &mut one.result.accuracy.as_mut().unwrap().sorted;
        let second = accuracy.ap.get_mut(&classes[1]).unwrap();
        second.values_mut().for_each(|ap| *ap = Some(1.0));
        assert!(classes.len() > 2, "one has no objects: {classes:?}");
        assert_eq!(
            numbers(&one)[0],
            format!("mAP of {}, {} 0.750 / 0.750", classes[0], classes[1])
        );
    }

    #[test]
    fn every_run_has_its_five_numbers_in_a_line() {
        let [mut one, mut other] = [run("a", "cav1", 1), run("a", "cav1", 2)];
        // Not every class has objects in it.
        let means = &mut one.result.accuracy.as_mut().unwrap().sorted.mean_ap;
        means.values_mut().for_each(|mean| *mean = Some(0.75));
        other.result.accuracy = None;
        assert_eq!(numbers(&other)[0], "mAP –");
        other.result.boxes = Some(crate::tests::three_boxes());
        assert_eq!(numbers(&other)[0], "1.5 boxes a sweep");
        other.result.boxes = None;
        other.result.frames.key_skipped = 3;
        let said = opening(
            &[("late_fusion", &one), ("other\u{1b}", &other)],
            &["late_fusion is best.".into()],
            120,
        );
        let lines: Vec<&str> = said.lines().collect();
        assert_eq!(lines.len(), 3, "{said}");
        for part in ["late_fusion", "mAP 0.750 / 0.750", "KB a sweep", "ms old", "Hz", "lost"] {
            assert!(lines[0].contains(part), "no `{part}` in {said}");
        }
        assert!(
            lines[1].starts_with("other\u{fffd}") && lines[1].contains("mAP –"),
            "{said}"
        );
        assert!(
            lines[1].contains("3 sweeps without boxes") && lines[2] == "late_fusion is best.",
            "{said}"
        );
        let narrow = opening(&[("late_fusion", &one)], &[], 40);
        assert!(
            narrow.lines().count() > 1 && narrow.lines().all(|line| width_of(line) <= 40),
            "{narrow}"
        );
    }
}

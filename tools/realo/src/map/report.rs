//! What `--poses estimated` says of its poses.

use realo_mapping::{Drive, Errors, MappedDrive, Spread};

use super::estimated::{Driven, Estimated};

/// More of the positions than this contradict the others: GNSS jumps.
const MANY: f64 = 0.3;
/// Fewer sweeps than this share in trouble are not mentioned.
const FEW: f64 = 0.01;

/// Prints to standard error what is wrong with what drives measured.
pub fn print_faults(driven: &[Driven]) {
    for of in driven {
        for words in of_sensors(of).into_iter().chain(of_sweeps(&of.drive)) {
            eprintln!("realo: {}: {words}", of.name);
        }
    }
}

/// Prints poses and errors to standard output, and what is wrong to standard error.
pub fn print(estimated: &Estimated) {
    let Estimated {
        driven,
        mapped,
        summary,
        ..
    } = estimated;
    for (of, mapped) in driven.iter().zip(mapped) {
        for words in faults(of, mapped, summary.is_anchored) {
            eprintln!("realo: {}: {words}", of.name);
        }
    }
    for words in joints(estimated) {
        eprintln!("realo: {words}");
    }
    println!("poses by odometry, loops and GNSS: {} keyframes", summary.keyframes);
    for (of, mapped) in driven.iter().zip(mapped) {
        let [ground, up, heading] = mapped.sigmas;
        println!(
            "  {}: {} keyframes, {} loops, {} of them with GNSS; ± {ground:.3} m on the ground, {up:.3} m up, {:.3}°",
            of.name,
            mapped.keyframes,
            mapped.loops,
            mapped.anchors[0],
            heading.to_degrees()
        );
        if let Some(lean) = of.lean {
            println!(
                "    its sensor leans: a metre ahead looks {:.1} mm too {} (± {:.1}), by the heights of loops; sweeps are levelled{}",
                1e3 * lean.slope.abs(),
                if lean.slope < 0.0 { "low" } else { "high" },
                1e3 * lean.sigma,
                mapped.lean.map_or(String::new(), |left| format!(
                    ", but for {:.1} mm",
                    1e3 * left.slope.abs()
                ))
            );
        }
    }
    if let Some([before, after]) = &estimated.errors {
        println!("  errors of {} poses at sweeps: mean / 95 % / max", after.poses);
        for (what, errors) in [("before loops were closed", before), ("after", after)] {
            println!("    {what}: {}", in_words(&errors.absolute));
            println!(
                "    {what}, aligned as a whole: {}{}",
                in_words(&errors.aligned),
                moved(errors)
            );
        }
    }
}

/// Errors on the ground, up and of the heading.
fn in_words([place, up, heading]: &[Spread; 3]) -> String {
    let of = |spread: &Spread| format!("{:.3} / {:.3} / {:.3}", spread.mean, spread.p95, spread.max);
    format!("{} m, up {} m, {}°", of(place), of(up), of(heading))
}

fn moved(errors: &Errors) -> String {
    format!(" (by {:.3} m and {:.3}°)", errors.offset[0], errors.offset[1])
}

/// What is wrong with a drive.
fn faults(of: &Driven, mapped: &MappedDrive, is_anchored: bool) -> Vec<String> {
    let mut words = Vec::new();
    if mapped.keyframes == 0 {
        words.push(if of.drive.pieces.is_empty() {
            "left out, for no sweep could be followed".into()
        } else if is_anchored {
            "left out, for no position of GNSS says where it is, and loops are looked for only where poses are known"
                .into()
        } else {
            "left out, for no position of GNSS says how the drives are to each other".to_string()
        });
    } else if mapped.pieces[1] > 0 {
        words.push(format!(
            "odometry broke off {} times; {} of {} pieces were left out, for no position of GNSS says where they are",
            mapped.pieces[0] - 1,
            mapped.pieces[1],
            mapped.pieces[0]
        ));
    }
    if mapped.keyframes > 0 && is_anchored && !mapped.has_heading {
        words.push("its way is too short for GNSS to tell its heading".into());
    }
    if !of.has_fixes {
        words.push(format!(
            "expected positions of GNSS on /{}/fix, found no such topic",
            of.agent
        ));
    }
    let [anchors, doubtful] = mapped.anchors;
    if doubtful as f64 > MANY * anchors as f64 {
        words.push(format!(
            "positions of GNSS jump: those of {doubtful} of {anchors} keyframes contradict the others and weigh little; its place is no \
             surer than ± {:.1} m",
            mapped.sigmas[0]
        ));
    } else if doubtful > 0 {
        words.push(format!(
            "positions of GNSS at {doubtful} of {anchors} keyframes contradict the others, as between buildings, and weigh little"
        ));
    }
    if mapped.keyframes > 0 && mapped.loops == 0 {
        words.push("no loop was closed: it passes no place twice, or no sweep fits what was there before".into());
    }
    words.extend(of_sensors(of));
    words.extend(of_sweeps(&of.drive));
    words
}

/// What is wrong with measurements.
fn of_sensors(of: &Driven) -> Vec<String> {
    let mut words = Vec::new();
    if let Some((count, reason)) = &of.unusable {
        words.push(format!(
            "{count} messages of motion sensors cannot be used; the first: {reason}"
        ));
    }
    if of.leans {
        words.push(
            "its sweeps lean with the vehicle and are taken as level: poses are worse on slopes and in bends".into(),
        );
    }
    let found = &of.drive.fix_faults;
    let counts = [
        (
            found.not_finite,
            "are no numbers, or have variances that are not above 0: not used",
        ),
        (found.elsewhere, "are more than 100 km from the map's origin: not used"),
        (
            found.frozen,
            "are the same as the one before to the last digit: not used",
        ),
        (found.no_height, "have a height of exactly 0: the height is not used"),
    ];
    let counted = counts.into_iter().filter(|(count, _)| *count > 0);
    words.extend(counted.map(|(count, what)| format!("{count} positions of GNSS {what}")));
    let all = of.drive.counts.imu + of.drive.counts.wheels + of.drive.counts.sweeps;
    for (fault, count, _) in of.drive.faults.seen() {
        if count as f64 > 1e-3 * all as f64 {
            words.push(format!(
                "`{}` {count} times among IMU, wheels and sweeps (docs/reference/stages.md#localization)",
                fault.name()
            ));
        }
    }
    words
}

/// What is wrong with sweeps.
fn of_sweeps(drive: &Drive) -> Vec<String> {
    let counts = &drive.counts;
    let many = |count: u64| count as f64 > FEW * counts.sweeps as f64;
    let mut words = Vec::new();
    if counts.few_points > 0 {
        words.push(format!(
            "{} of {} sweeps have too few points to be followed by: IMU and wheels carry on",
            counts.few_points, counts.sweeps
        ));
    }
    if many(counts.unfit) {
        words.push(format!(
            "{} of {} sweeps do not fit the ones before: IMU and wheels carry on",
            counts.unfit, counts.sweeps
        ));
    }
    if counts.misdated > 0 {
        words.push(format!(
            "{} of {} sweeps are left out, for their stamps are not after the one before, or the IMU said nothing then: `realo info` compares \
             the clocks of LiDAR and IMU",
            counts.misdated, counts.sweeps
        ));
    }
    if counts.waiting == counts.sweeps && counts.sweeps > 0 {
        words
            .push("nothing was known of its motion at any sweep: does the IMU say anything? `realo info` tells".into());
    }
    words
}

/// What is wrong between drives.
fn joints(estimated: &Estimated) -> Vec<String> {
    let Estimated {
        driven,
        mapped,
        summary,
        ..
    } = estimated;
    let mut words = Vec::new();
    if !summary.is_anchored {
        words.push(
            "no drive has positions of GNSS that can be used: the map begins at (0, 0, 0) with its first sweep, x ahead, and ± are from there"
                .into(),
        );
    }
    if summary.refused > 0 {
        words.push(format!(
            "{} of {} loops contradict the others and weigh little",
            summary.refused,
            summary.refused + summary.loops
        ));
    }
    if !summary.converged {
        words.push("the pose graph did not settle: compare `realo map info`, and build from fewer drives".into());
    }
    let placed: Vec<(&Driven, &MappedDrive)> = driven.iter().zip(mapped).filter(|(_, of)| of.keyframes > 0).collect();
    let mut groups: Vec<usize> = placed.iter().map(|(_, mapped)| mapped.group).collect();
    groups.sort_unstable();
    groups.dedup();
    if groups.len() > 1 {
        let names = |group: &usize| {
            let of = placed.iter().filter(|(_, mapped)| mapped.group == *group);
            of.map(|(driven, _)| driven.name.as_str())
                .collect::<Vec<_>>()
                .join(", ")
        };
        let groups: Vec<String> = groups.iter().map(names).collect();
        words.push(format!(
            "these never meet, so that GNSS alone says how they are to each other: {}",
            groups.join(" | ")
        ));
    }
    words
}

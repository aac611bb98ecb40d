//! Numbers as a table shows them.

use realo_results::Spread;

/// What stands where there is no value.
pub const NONE: &str = "–";

/// A fraction to three places.
pub fn fraction(value: Option<f64>) -> String {
    value.map_or(NONE.into(), |value| format!("{value:.3}"))
}

/// `part / of`, to three places.
pub fn share(part: u64, of: u64) -> String {
    fraction((of > 0).then(|| part as f64 / of as f64))
}

/// p50 / p95 / p99 of a distribution, ms; nothing of an empty one.
pub fn spread(spread: Option<&Spread>) -> Option<String> {
    let spread = spread.filter(|spread| spread.count > 0)?;
    let places = if spread.p99.is_some_and(|p99| p99.abs() < 10.0) {
        2
    } else {
        1
    };
    let value = |value: Option<f64>| value.map_or(NONE.into(), |value| format!("{value:.places$}"));
    Some(values([spread.p50, spread.p95, spread.p99].map(value)))
}

/// An age in whole ms, to one place below 10 ms.
pub fn age(ms: f64) -> String {
    match ms.abs() < 9.95 && ms != 0.0 {
        true => format!("{ms:.1}"),
        false => format!("{:.0}", ms + 0.0),
    }
}

/// A number of KB, with a place behind the point below 100.
pub fn kilobytes(kb: f64) -> String {
    match kb < 99.95 && kb > 0.0 {
        true => format!("{kb:.1}"),
        false => count(kb.round() as u64),
    }
}

/// Values of one cell.
pub fn values(values: impl IntoIterator<Item = String>) -> String {
    values.into_iter().collect::<Vec<_>>().join(" / ")
}

/// A count with separators of thousands.
pub fn count(n: u64) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// A count of what should not be; `!` says so where there is any.
pub fn alarm(n: u64) -> String {
    match n {
        0 => count(n),
        n => format!("! {}", count(n)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writes_numbers_for_readers() {
        let cases = [(0, "0"), (999, "999"), (1000, "1,000"), (1_234_567, "1,234,567")];
        assert!(cases.iter().all(|(n, text)| count(*n) == *text));
        assert_eq!((alarm(0), alarm(1200)), ("0".into(), "! 1,200".into()));
        assert_eq!((share(1, 3), share(0, 0)), ("0.333".into(), NONE.into()));
        let of = |ms| Spread {
            p50: Some(1.0),
            p95: Some(2.0),
            p99: Some(ms),
            max: Some(ms),
            count: 3,
        };
        assert_eq!(spread(Some(&of(9.25))).unwrap(), "1.00 / 2.00 / 9.25");
        assert_eq!(spread(Some(&of(144.2))).unwrap(), "1.0 / 2.0 / 144.2");
        assert_eq!(spread(Some(&Spread::default())), None);
        assert_eq!([0.0, 3.25, 149.6].map(age), ["0", "3.2", "150"]);
        assert_eq!([0.0, 5.44, 1583.4].map(kilobytes), ["0", "5.4", "1,583"]);
    }
}

//! How a value is written in a table.

use eyre::{Result, bail};
use serde::Deserialize;
use serde_json::Value;

/// What stands where there is no value.
pub const NONE: &str = "–";

/// How a value is written.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
pub enum Format {
    /// As it is.
    #[serde(rename = "text")]
    Text,
    /// A whole number.
    #[serde(rename = "0")]
    Whole,
    /// One decimal.
    #[serde(rename = "0.0")]
    One,
    /// Two decimals.
    #[serde(rename = "0.00")]
    Two,
    /// Three decimals.
    #[serde(rename = "0.000")]
    Three,
    /// One decimal below 10, else none.
    #[serde(rename = "short")]
    Short,
}

impl Format {
    fn decimals(self, value: f64) -> usize {
        match self {
            Format::Text | Format::Whole => 0,
            Format::One => 1,
            Format::Two => 2,
            Format::Three => 3,
            Format::Short => usize::from(value != 0.0 && value.abs() < 10.0),
        }
    }
}

/// The values of a cell, `a / b`; [`NONE`] if all are null.
///
/// # Errors
/// A value that the format cannot write.
pub fn cell(values: &[&Value], format: Format, scale: f64) -> Result<String> {
    if values.iter().all(|value| value.is_null()) {
        return Ok(NONE.into());
    }
    let written: Result<Vec<String>> = values.iter().map(|value| one(value, format, scale)).collect();
    Ok(written?.join(" / "))
}

fn one(value: &Value, format: Format, scale: f64) -> Result<String> {
    match (value, format) {
        (Value::Null, _) => Ok(NONE.into()),
        (Value::String(text), Format::Text) => Ok(text.replace('|', "\\|")),
        (Value::Number(_) | Value::Bool(_), Format::Text) => Ok(value.to_string()),
        (Value::Number(number), _) => {
            // Adding 0 takes the sign off a zero.
            let value = number.as_f64().unwrap_or(f64::NAN) * scale + 0.0;
            Ok(grouped(&format!("{value:.*}", format.decimals(value))))
        }
        _ => bail!("{value} is not a number"),
    }
}

/// A number with a comma at every thousand.
fn grouped(number: &str) -> String {
    let (whole, rest) = number.find('.').map_or((number, ""), |dot| number.split_at(dot));
    let (sign, digits) = whole.strip_prefix('-').map_or(("", whole), |digits| ("-", digits));
    let mut grouped = String::from(sign);
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    grouped + rest
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn values_are_written_as_their_format_says() {
        for (value, format, scale, expected) in [
            (json!(0.94812), Format::Three, 1.0, "0.948"),
            (json!(38.1), Format::Three, 0.01, "0.381"),
            (json!(4005.4), Format::Short, 1.0, "4,005"),
            (json!(5.44), Format::Short, 1.0, "5.4"),
            (json!(0), Format::Short, 1.0, "0"),
            (json!(-0.0), Format::Short, 1.0, "0"),
            (json!(1234567), Format::Whole, 1.0, "1,234,567"),
            (json!(-1234.5), Format::One, 1.0, "-1,234.5"),
            (json!(999), Format::Whole, 1.0, "999"),
            (json!("a|b"), Format::Text, 1.0, "a\\|b"),
            (json!(3), Format::Text, 1.0, "3"),
            (json!(null), Format::Three, 1.0, "–"),
        ] {
            assert_eq!(cell(&[&value], format, scale).unwrap(), expected, "{value}");
        }
    }

    #[test]
    fn several_values_share_a_cell() {
        let (a, none) = (json!(0.5), Value::Null);
        assert_eq!(cell(&[&a, &a], Format::Two, 1.0).unwrap(), "0.50 / 0.50");
        assert_eq!(cell(&[&a, &none], Format::Two, 1.0).unwrap(), "0.50 / –");
        assert_eq!(cell(&[&none, &none], Format::Two, 1.0).unwrap(), "–");
        assert!(cell(&[&json!({})], Format::Two, 1.0).is_err());
    }
}

//! Where to serve.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

/// Why a text names no place to serve at.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error(
    "expected PORT, IP or IP:PORT, as 8800, 127.0.0.1:8800 or 0.0.0.0:8800, found `{0}`; a graph goes before this option, or write \
     OPTION=ADDR"
)]
pub struct AddressError(String);

/// The address that a text names: nothing, a port, an IP, or both. Without an IP it is this machine alone; without a port the system
/// chooses one.
///
/// # Errors
/// A text that is none of these.
pub fn address(text: &str) -> Result<SocketAddr, AddressError> {
    address_at(text, 0)
}

/// As [`address`]; without a port it is this one.
///
/// # Errors
/// As [`address`].
pub fn address_at(text: &str, usual: u16) -> Result<SocketAddr, AddressError> {
    let here = IpAddr::V4(Ipv4Addr::LOCALHOST);
    let text = text.trim();
    let named = match text.strip_prefix("localhost") {
        Some("") => Some(SocketAddr::new(here, usual)),
        Some(rest) => port(rest.strip_prefix(':').unwrap_or("?")).map(|port| SocketAddr::new(here, port)),
        None if text.is_empty() => Some(SocketAddr::new(here, usual)),
        None => port(text.strip_prefix(':').unwrap_or(text)).map(|port| SocketAddr::new(here, port)),
    };
    let ip = || text.parse().ok().map(|ip: IpAddr| SocketAddr::new(ip, usual));
    let found = named.or_else(|| text.parse().ok()).or_else(ip);
    found.ok_or_else(|| AddressError(text.chars().take(80).collect()))
}

fn port(text: &str) -> Option<u16> {
    text.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_people_write_is_understood() {
        for (text, expected) in [
            ("", "127.0.0.1:0"),
            ("8800", "127.0.0.1:8800"),
            (":8800", "127.0.0.1:8800"),
            ("localhost", "127.0.0.1:0"),
            ("localhost:8800", "127.0.0.1:8800"),
            ("0.0.0.0", "0.0.0.0:0"),
            ("0.0.0.0:8800", "0.0.0.0:8800"),
            ("[::1]:8800", "[::1]:8800"),
            ("::", "[::]:0"),
        ] {
            assert_eq!(address(text).unwrap().to_string(), expected, "{text}");
        }
        for (text, expected) in [
            ("", "127.0.0.1:8765"),
            ("localhost", "127.0.0.1:8765"),
            ("0.0.0.0", "0.0.0.0:8765"),
            ("9000", "127.0.0.1:9000"),
        ] {
            assert_eq!(address_at(text, 8765).unwrap().to_string(), expected, "{text}");
        }
        for text in [
            "dataflows/early_fusion.yml",
            "99999",
            "1.2.3:4",
            "localhost:x",
            "localhosts",
        ] {
            assert!(address(text).unwrap_err().to_string().contains(text), "{text}");
        }
    }
}

//! Addresses of agents: `tcp/HOST:PORT` or `tls/HOST:PORT`, where the port behind it is taken too.

use std::fmt;
use std::net::IpAddr;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// What carries Zenoh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Protocol {
    Tcp,
    /// Needs certificates, in a file of settings.
    Tls,
}

impl Protocol {
    fn as_str(self) -> &'static str {
        match self {
            Protocol::Tcp => "tcp",
            Protocol::Tls => "tls",
        }
    }
}

/// An address.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Endpoint {
    protocol: Protocol,
    host: String,
    port: u16,
}

/// No address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "expected an address tcp/HOST:PORT or tls/HOST:PORT with a port from 1 to 65534, such as tcp/0.0.0.0:7447, found `{0}`"
)]
pub struct NoEndpoint(String);

impl Endpoint {
    /// As zenoh writes it, so many ports behind.
    pub fn text(&self, after: u16) -> String {
        format!(
            "{}/{}:{}",
            self.protocol.as_str(),
            self.host,
            self.port.saturating_add(after)
        )
    }

    /// Whether only programs of the same machine reach it.
    pub fn is_loopback(&self) -> bool {
        let host = self.host.trim_matches(['[', ']']);
        host == "localhost"
            || host
                .parse::<IpAddr>()
                .is_ok_and(|host| host.to_canonical().is_loopback())
    }

    /// Whether one machine cannot listen at both: each takes two ports.
    pub fn collides(&self, other: &Endpoint) -> bool {
        let is_any = |host: &str| matches!(host, "0.0.0.0" | "[::]");
        let one_host = self.host == other.host || is_any(&self.host) || is_any(&other.host);
        one_host && self.port.abs_diff(other.port) < 2
    }
}

impl FromStr for Endpoint {
    type Err = NoEndpoint;

    fn from_str(text: &str) -> Result<Self, NoEndpoint> {
        let wrong = || NoEndpoint(text.into());
        let (protocol, rest) = text.split_once('/').ok_or_else(wrong)?;
        let protocol = [Protocol::Tcp, Protocol::Tls]
            .into_iter()
            .find(|known| known.as_str() == protocol)
            .ok_or_else(wrong)?;
        let (host, port) = rest.rsplit_once(':').ok_or_else(wrong)?;
        let port: u16 = port.parse().map_err(|_| wrong())?;
        let bare = host.starts_with('[') == host.ends_with(']');
        if host.is_empty() || !bare || !(1..u16::MAX).contains(&port) || host.contains(['/', '#', '?']) {
            return Err(wrong());
        }
        Ok(Endpoint {
            protocol,
            host: host.into(),
            port,
        })
    }
}

impl TryFrom<String> for Endpoint {
    type Error = NoEndpoint;

    fn try_from(text: String) -> Result<Self, NoEndpoint> {
        text.parse()
    }
}

impl From<Endpoint> for String {
    fn from(endpoint: Endpoint) -> String {
        endpoint.text(0)
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.text(0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_and_the_port_behind_it() {
        for text in ["tcp/0.0.0.0:7447", "tls/rsu1.local:1", "tcp/[::1]:65534"] {
            let endpoint: Endpoint = text.parse().unwrap();
            assert_eq!(endpoint.to_string(), text);
        }
        let endpoint: Endpoint = "tcp/[::1]:7447".parse().unwrap();
        assert_eq!(endpoint.text(1), "tcp/[::1]:7448");
    }

    #[test]
    fn addresses_of_the_machine_itself_are_known() {
        for (text, expected) in [
            ("tcp/127.0.0.1:7447", true),
            ("tcp/127.8.0.1:7447", true),
            ("tcp/[::1]:7447", true),
            ("tls/localhost:7447", true),
            ("tcp/[::ffff:127.0.0.1]:7447", true),
            ("tcp/0.0.0.0:7447", false),
            ("tcp/[::]:7447", false),
            ("tcp/192.168.1.7:7447", false),
            ("tcp/car.local:7447", false),
        ] {
            assert_eq!(text.parse::<Endpoint>().unwrap().is_loopback(), expected, "{text}");
        }
    }

    #[test]
    fn addresses_collide_where_they_share_a_port() {
        for (one, other, expected) in [
            ("tcp/10.0.0.1:7447", "tcp/10.0.0.1:7447", true),
            ("tcp/10.0.0.1:7447", "tls/10.0.0.1:7448", true),
            ("tcp/10.0.0.1:7447", "tcp/10.0.0.1:7449", false),
            ("tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447", false),
            ("tcp/0.0.0.0:7447", "tcp/10.0.0.2:7448", true),
            ("tcp/10.0.0.2:7448", "tcp/[::]:7447", true),
        ] {
            let [a, b]: [Endpoint; 2] = [one, other].map(|text| text.parse().unwrap());
            assert_eq!([a.collides(&b), b.collides(&a)], [expected; 2], "{one} {other}");
        }
    }

    #[test]
    fn what_is_no_address_is_shown() {
        for text in [
            "",
            "tcp/",
            "10.0.0.1:7447",
            "udp/10.0.0.1:7447",
            "tcp/10.0.0.1",
            "tcp/10.0.0.1:0",
            "tcp/10.0.0.1:65535",
            "tcp/:7447",
            "tcp/[::1:7447",
            "tcp/a#iface=eth0:7447",
        ] {
            let error = text.parse::<Endpoint>().unwrap_err().to_string();
            assert!(error.contains(&format!("found `{text}`")), "{error}");
        }
    }
}

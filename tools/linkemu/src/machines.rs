//! The namespaces, and what else machines have of their own.

use std::ffi::OsStr;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use crate::clock::WallClock;
use crate::link::carry;
use crate::tun::Tun;
use crate::{Ground, Link};

/// Addresses of the two machines.
pub const ADDRESSES: [&str; 2] = ["10.9.0.1", "10.9.0.2"];

/// Why there are no two machines.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No TUN device.
    #[error("/dev/net/tun: {0}; it needs Linux and root (CAP_NET_ADMIN)")]
    Tun(#[from] std::io::Error),
    /// No user namespace.
    #[error("{0}; a user namespace is made by a process of one thread, where the system allows it to its users")]
    User(std::io::Error),
    /// What failed in a user namespace.
    #[error("{0}")]
    Child(String),
    /// Neither beside everybody's nor in a user namespace.
    #[error("no network namespaces here: {system}; in a user namespace: {user}")]
    Nowhere {
        /// What failed where the process is.
        system: String,
        /// What failed there.
        user: String,
    },
    /// A program would not notice that the wall clock of its machine is set.
    #[error("the wall clock of `{machine}`: {reason}")]
    Clock {
        /// The machine.
        machine: String,
        /// What is in the way.
        reason: String,
    },
    /// A name that no machine can have.
    #[error("a machine's name: expected {expected}, found `{found}`")]
    Name {
        /// What can be one.
        expected: &'static str,
        /// What is none.
        found: String,
    },
    /// A namespace of the name is there.
    #[error(
        "a network namespace `{0}` is there already; `ip netns del {0}` if it is left of a run that was killed, or choose another name"
    )]
    Taken(String),
    /// `ip` failed.
    #[error("`{command}`: {reason}{mend}")]
    Ip {
        /// What was called.
        command: String,
        /// What it said.
        reason: String,
        /// What helps.
        mend: &'static str,
    },
}

/// Two network namespaces, and a wall clock of each, which go with it.
pub struct Machines {
    /// Those whose namespaces are made.
    names: Vec<String>,
    clocks: [WallClock; 2],
}

impl Machines {
    /// Makes namespaces of these names and joins them, on the [`Ground`] that is found.
    ///
    /// # Errors
    /// [`Error`], where there is no ground for example, or where a namespace of the name exists.
    pub fn join(first: &str, second: &str, link: Arc<Link>) -> Result<Machines, Error> {
        check_names(first, second)?;
        Ground::find()?;
        let (machines, tuns) = Machines::make(first, second)?;
        carry(&link, tuns)?;
        Ok(machines)
    }

    /// Whether they can be made here: makes some and takes them away.
    pub(crate) fn try_out() -> Result<(), Error> {
        let id = std::process::id();
        Machines::make(&format!("linkemu{id}a"), &format!("linkemu{id}b")).map(drop)
    }

    fn make(first: &str, second: &str) -> Result<(Machines, [Tun; 2]), Error> {
        let clock = |machine: &str| {
            WallClock::new().map_err(|error| Error::Clock {
                machine: machine.into(),
                reason: format!("{}: {error}", std::env::temp_dir().display()),
            })
        };
        let clocks = [clock(first)?, clock(second)?];
        let devices = [0, 1].map(|end| format!("tun{}{end}", std::process::id()));
        let tuns = [Tun::new(&devices[0])?, Tun::new(&devices[1])?];
        add_namespace(first)?;
        // From here on, what was made goes with it.
        let mut machines = Machines {
            names: vec![first.into()],
            clocks,
        };
        add_namespace(second)?;
        machines.names.push(second.into());
        for end in [0, 1] {
            let (name, device) = (&*machines.names[end], &*devices[end]);
            ip(&["link", "set", device, "netns", name])?;
            ip(&["-n", name, "link", "set", "lo", "up"])?;
            let (own, peer) = (ADDRESSES[end], ADDRESSES[1 - end]);
            ip(&["-n", name, "addr", "add", own, "peer", peer, "dev", device])?;
            // A short queue of the device, so that packets wait in the link, where they are counted.
            ip(&[
                "-n",
                name,
                "link",
                "set",
                device,
                "mtu",
                "1500",
                "txqueuelen",
                "100",
                "up",
            ])?;
        }
        Ok((machines, tuns))
    }

    /// A program on one of the machines.
    pub fn command(&self, machine: usize, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new("ip");
        let clock = &self.clocks[machine];
        // Each has a mount namespace of its own.
        command.args(["netns", "exec", &self.names[machine], "sh", "-c", &clock.within()]);
        clock.give(command.arg(program));
        command
    }

    /// Sets the wall clock of a machine so many milliseconds ahead of the true one, under the programs that run there.
    ///
    /// # Errors
    /// [`Error::Clock`], where a program of the machine does not read its clock.
    pub fn set_clock(&self, machine: usize, ms: f64) -> Result<(), Error> {
        let clock = &self.clocks[machine];
        let failed = |reason: String| Error::Clock {
            machine: self.names[machine].clone(),
            reason,
        };
        for process in self.processes(machine)? {
            let is_there = || Path::new("/proc").join(&process).join("exe").exists();
            if !clock.is_read_by(&process) && is_there() {
                return Err(failed(format!(
                    "process {process} does not read it; expected programs that are linked to glibc, on a system that mounts overlays"
                )));
            }
        }
        clock.set(ms).map_err(|error| failed(error.to_string()))
    }

    /// Kills all that runs on a machine, as a power cut would.
    ///
    /// # Errors
    /// Where the machine's processes is unknown.
    pub fn kill(&self, machine: usize) -> Result<(), Error> {
        for process in self.processes(machine)? {
            // One that has ended meanwhile is as dead.
            let _ = Command::new("kill").args(["-KILL", &process]).output();
        }
        Ok(())
    }

    /// Resident memory of the process of a machine that has this word in its command line, bytes; 0 where none has.
    pub fn memory_of(&self, machine: usize, word: &str) -> u64 {
        let read = |process: &String, file: &str| std::fs::read(format!("/proc/{process}/{file}")).unwrap_or_default();
        let has_word = |process: &String| {
            read(process, "cmdline")
                .split(|byte| *byte == 0)
                .any(|part| part == word.as_bytes())
        };
        let found = self.processes(machine).unwrap_or_default().into_iter().find(has_word);
        let status = found.map(|process| String::from_utf8_lossy(&read(&process, "status")).into_owned());
        let resident = status.as_deref().and_then(|status| status.split("VmRSS:").nth(1));
        let kilobytes = resident.and_then(|rest| rest.split_whitespace().next()?.parse::<u64>().ok());
        kilobytes.map_or(0, |kilobytes| kilobytes << 10)
    }

    fn processes(&self, machine: usize) -> Result<Vec<String>, Error> {
        let listed = ip(&["netns", "pids", &self.names[machine]])?;
        Ok(listed.split_whitespace().map(String::from).collect())
    }

    /// How TCP of a machine to the other one finds its rate: `cubic`, `bbr` or what the kernel has.
    ///
    /// # Errors
    /// A name that the kernel does not know.
    pub fn set_congestion_control(&self, machine: usize, name: &str) -> Result<(), Error> {
        let (own, peer) = (ADDRESSES[machine], ADDRESSES[1 - machine]);
        let device = format!("tun{}{machine}", std::process::id());
        let of = &*self.names[machine];
        ip(&[
            "-n", of, "route", "replace", peer, "dev", &device, "src", own, "congctl", name,
        ])
        .map(drop)
    }
}

impl Drop for Machines {
    fn drop(&mut self) {
        for name in &self.names {
            let _ = ip(&["netns", "del", name]);
        }
    }
}

/// Names of namespaces are names of files.
fn check_names(first: &str, second: &str) -> Result<(), Error> {
    let wrong = |expected, found: &str| Error::Name {
        expected,
        found: found.into(),
    };
    for name in [first, second] {
        let is_one = !name.is_empty() && name.len() <= 200 && !name.starts_with(['.', '-']);
        if !is_one || name.chars().any(|c| c == '/' || c.is_whitespace() || c.is_control()) {
            let expected = "up to 200 bytes without blanks and /, and neither . nor - at the beginning";
            return Err(wrong(expected, name));
        }
    }
    match first == second {
        true => Err(wrong("another than the first one's", second)),
        false => Ok(()),
    }
}

fn add_namespace(name: &str) -> Result<(), Error> {
    ip(&["netns", "add", name]).map(drop).map_err(|error| match error {
        Error::Ip { reason, .. } if reason.contains("File exists") => Error::Taken(name.into()),
        other => other,
    })
}

/// What `ip` says.
fn ip(arguments: &[&str]) -> Result<String, Error> {
    let failed = |reason: String, mend| Error::Ip {
        command: format!("ip {}", arguments.join(" ")),
        reason,
        mend,
    };
    let output = Command::new("ip").args(arguments).output();
    let output = output.map_err(|error| failed(error.to_string(), "; it needs iproute2"))?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let reason = String::from_utf8_lossy(&output.stderr).trim().to_string();
    let is_refused = ["not permitted", "ermission denied"]
        .iter()
        .any(|word| reason.contains(word));
    Err(failed(reason, if is_refused { "; it needs root" } else { "" }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_cannot_be_are_reported() {
        for (names, expected) in [
            (
                ["a/b", "car"],
                "without blanks and /, and neither . nor - at the beginning, found `a/b`",
            ),
            (["car", ""], "found ``"),
            (["car", "a b"], "found `a b`"),
            (["..", "car"], "found `..`"),
            (["-all", "car"], "found `-all`"),
            (["car", "car"], "expected another than the first one's, found `car`"),
        ] {
            let error = check_names(names[0], names[1]).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
        check_names("car", "roadside").unwrap();
    }

    #[test]
    fn what_ip_refuses_is_reported_as_it_says_it() {
        let error = ip(&["netns", "exec"]).unwrap_err().to_string();
        assert!(
            error.starts_with("`ip netns exec`: ") && !error.contains("root"),
            "{error}"
        );
    }
}

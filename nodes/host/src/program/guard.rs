//! Ends a program with the one that started it, however that one ends.

use std::io;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};

use rustix::process::{Pid, Signal, kill_process_group};

/// Waits until nobody can write to its standard input any more, and kills its process group.
const SCRIPT: &str = "read -r _; kill -s KILL 0";

/// Leads the process group of a program, such as a plug-in, and of all that the program starts. The group ends with this value.
/// A process that is killed closes the leader's standard input, and the leader ends the group.
pub struct Guard(Child);

impl Guard {
    /// A leader without followers.
    ///
    /// # Errors
    /// A system without `sh`.
    pub fn start() -> io::Result<Guard> {
        let mut command = Command::new("sh");
        // The last argument is the name under which `ps` shows it.
        command
            .args(["-c", SCRIPT, "realo-guard"])
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        command.spawn().map(Guard)
    }

    /// Has a program start as a member of the group.
    pub fn lead(&self, command: &mut Command) {
        command.process_group(self.0.id().cast_signed());
    }

    /// Kills all members.
    pub fn kill(&self) {
        // A group without members needs no end.
        let _ = kill_process_group(Pid::from_child(&self.0), Signal::KILL);
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        self.kill();
        let _ = self.0.wait();
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::time::{Duration, Instant};

    use super::*;

    /// A member that ignores signals, has a child, and holds its standard output open as long as one of both lives.
    fn member(guard: &Guard) -> Child {
        let mut command = Command::new("sh");
        command
            .args(["-c", "trap '' TERM HUP INT; sleep 1000 & echo ready; wait; wait"])
            .stdout(Stdio::piped());
        guard.lead(&mut command);
        let mut member = command.spawn().unwrap();
        let mut ready = [0; 6];
        member.stdout.as_mut().unwrap().read_exact(&mut ready).unwrap();
        member
    }

    fn ends(mut member: Child) {
        let begun = Instant::now();
        let mut rest = String::new();
        member.stdout.take().unwrap().read_to_string(&mut rest).unwrap();
        member.wait().unwrap();
        assert!(begun.elapsed() < Duration::from_secs(500), "it ended by itself");
    }

    #[test]
    fn a_group_ends_with_its_guard() {
        let guard = Guard::start().unwrap();
        let member = member(&guard);
        drop(guard);
        ends(member);
    }

    #[test]
    fn a_group_ends_when_its_driver_is_gone() {
        let mut guard = Guard::start().unwrap();
        let member = member(&guard);
        // What the system does with the pipes of a process that is killed.
        drop(guard.0.stdin.take());
        ends(member);
    }
}

//! The driver's side: one running program.

mod boxes;
mod relay;
mod words;

use std::process::{Child as Process, ChildStdin, ChildStdout, Command};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use arrow::buffer::Buffer;
use realo_schemas::{Message, Nanos};

use realo_engine::Gone;
use realo_operator::pipe::hello::{self, Hello, NoHello};
use realo_operator::pipe::memory::Memory;
use realo_operator::pipe::words::{Call, Reply};
use realo_operator::pipe::{FrameError, frame};
use realo_operator::{AnyOperator, Counts, Error, Made, Outputs, PortId, Registration};

use super::guard::Guard;
use crate::virtual_time::is_ending;
use relay::Relay;
use words::{listen, missing_module};

/// How long a program may take to exit once it has nothing left to do, and to say why it failed.
const FAREWELL: Duration = Duration::from_secs(10);
/// How often a program that is silent is looked after.
const LOOK: Duration = Duration::from_millis(200);
/// After so long a person reads who is waited for.
const NOTICE: Duration = Duration::from_secs(10);
/// How long the last frame of a program that has exited may take.
const ON_ITS_WAY: Duration = Duration::from_millis(500);
/// Why a program is not waited for any longer.
const ENDED: &str = "the run was ended";
/// What is quoted of its standard error, bytes from the end.
const QUOTED: usize = 2048;

/// A program that hosts an operator, ready for the next call.
pub struct Child {
    /// Its node's id.
    node: String,
    /// Its command line.
    program: String,
    process: Process,
    /// Ends the process, and all that it starts.
    guard: Guard,
    calls: Option<SyncSender<Frame>>,
    written: Receiver<Result<(), FrameError>>,
    replies: Receiver<Result<Buffer, FrameError>>,
    said: Arc<Mutex<Vec<u8>>>,
    silence: Silence,
    /// Whether this side ended it.
    was_stopped: bool,
    /// Whether it has answered a call.
    answered: bool,
    /// Whether a person knows that it is waited for.
    noticed: bool,
    /// Whether it reads shared memory.
    shares: bool,
    listener: JoinHandle<()>,
    registration: &'static Registration,
}

/// Why a call was not answered.
enum Failure {
    /// Nothing comes through standard output any more.
    Closed,
    /// Anything else, in words.
    Other(String),
}

impl From<String> for Failure {
    fn from(reason: String) -> Self {
        Failure::Other(reason)
    }
}

/// A frame's parts, and whether it may go through shared memory.
type Frame = (Vec<Buffer>, bool);

/// Reads what a program answers. One reply is asked for at a time; a program that says more has to wait.
fn replies_on(mut stdout: ChildStdout, memory: Arc<Memory>) -> Receiver<Result<Buffer, FrameError>> {
    let (sender, replies) = sync_channel(1);
    std::thread::spawn(move || {
        let mut frame = frame::read_first(&mut stdout).transpose();
        while let Some(next) = frame {
            if sender.send(next).is_err() {
                return;
            }
            frame = frame::read(&mut stdout, &memory).transpose();
        }
    });
    replies
}

/// Writes calls, and says how that went; on a thread, because a program that does not read would hold up whoever writes.
fn calls_on(mut stdin: ChildStdin, memory: Arc<Memory>) -> (SyncSender<Frame>, Receiver<Result<(), FrameError>>) {
    let (calls, asked) = sync_channel::<Frame>(1);
    let (reports, written) = sync_channel(1);
    std::thread::spawn(move || {
        while let Ok((call, shared)) = asked.recv() {
            if reports.send(frame::write(&mut stdin, &call, &memory, shared)).is_err() {
                return;
            }
        }
    });
    (calls, written)
}

/// How long a call may take; a program that is silent for longer hangs.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Silence {
    /// The first one, for which many a program still prepares.
    pub first: Duration,
    /// Any other.
    pub later: Duration,
}

impl Child {
    /// Starts a program with piped standard streams and waits for its hello.
    ///
    /// # Errors
    /// Why it is no host of an operator, by the node's id.
    pub fn start(node: &str, mut command: Command, patience: Duration) -> Result<Child, String> {
        let program = words::command_line(&command);
        if is_ending() {
            return Err(format!("node `{node}`: {ENDED}"));
        }
        let guard = Guard::start();
        let guard = guard.map_err(|error| format!("node `{node}`: cannot start sh, which ends plug-ins: {error}"))?;
        guard.lead(&mut command);
        let spawned = command.spawn();
        let mut process = spawned.map_err(|error| {
            format!(
                "node `{node}`: cannot start `{program}`: {error}; build it, or correct the path, which is seen from the graph's folder"
            )
        })?;
        let (Some(stdin), Some(stdout), Some(stderr)) =
            (process.stdin.take(), process.stdout.take(), process.stderr.take())
        else {
            return Err(format!("node `{node}`: `{program}` has no pipes"));
        };
        let memory = Arc::new(Memory::default());
        let replies = replies_on(stdout, memory.clone());
        let (calls, written) = calls_on(stdin, memory);
        let said = Arc::new(Mutex::new(Vec::new()));
        let listener = std::thread::spawn({
            let (said, node) = (said.clone(), node.to_string());
            move || listen(stderr, &said, Relay::to(std::io::stderr(), &node))
        });
        let mut child = Child {
            node: node.into(),
            program,
            process,
            guard,
            calls: Some(calls),
            written,
            silence: Silence {
                first: patience,
                later: patience,
            },
            was_stopped: false,
            answered: false,
            noticed: false,
            shares: false,
            replies,
            said,
            listener,
            registration: &NOBODY,
        };
        let hello = child.wait_for_hello(patience);
        let Hello { registration, shares } = hello.map_err(|reason| format!("node `{node}`: {reason}"))?;
        (child.registration, child.shares) = (registration, shares);
        Ok(child)
    }

    /// Sets how long calls may take.
    pub(crate) fn limit_silence(&mut self, silence: Silence) {
        self.silence = silence;
    }

    /// What the program declares of itself.
    pub fn registration(&self) -> &'static Registration {
        self.registration
    }

    fn wait_for_hello(&mut self, patience: Duration) -> Result<Hello, String> {
        const MEND: &str = "a plug-in is a program whose main is `realo_operator::run`, or that uses the Python module \
                            `realo_operator`";
        let found = match self.wait_for_reply(patience) {
            Ok(Ok(bytes)) => match hello::read(bytes) {
                Ok(hello) => return Ok(hello),
                Err(NoHello::Refused(reason)) => return Err(self.refused(&reason)),
                Err(NoHello::Wrong(reason)) => reason,
            },
            // It printed before it called `run`: it is a plug-in perhaps.
            Ok(Err(error @ FrameError::Text { .. })) => return Err(self.last_words(&error.to_string())),
            Ok(Err(error)) => error.to_string(),
            Err(RecvTimeoutError::Timeout) if is_ending() => return Err(ENDED.into()),
            Err(RecvTimeoutError::Timeout) if self.exited(Duration::ZERO).is_some() => {
                "it ended, and a program that it started holds its standard output open".into()
            }
            Err(RecvTimeoutError::Timeout) => format!("nothing within {} s", patience.as_secs()),
            Err(RecvTimeoutError::Disconnected) => {
                let reason = self.farewell("before it declared its ports");
                let mend = missing_module(&reason).unwrap_or(MEND.into());
                return Err(format!("{reason}; {mend}"));
            }
        };
        let reason = self.last_words(&format!("not the first frame of realo's pipe protocol: {found}"));
        Err(format!("{reason}; {MEND}"))
    }

    /// One call, and what came of it.
    fn ask(&mut self, call: &Call, out: &mut Outputs) -> Result<(), Error> {
        let parts = call.to_parts(out.now())?;
        let answered = self.exchange(parts).and_then(|reply| self.take(reply, out));
        match answered {
            Ok(None) => Ok(()),
            Ok(Some(error)) => Err(error.into()),
            Err(reason) => {
                let reason = match reason {
                    Failure::Closed => self.farewell("before it answered a call"),
                    Failure::Other(reason) => self.last_words(&reason),
                };
                let ended = self.exited(Duration::ZERO).filter(|_| !self.was_stopped);
                let advice = ended.map_or(words::TABLE, words::advice);
                Err(Box::new(Gone(format!("{reason}\n{advice}"))))
            }
        }
    }

    fn exchange(&mut self, call: Vec<Buffer>) -> Result<Reply, Failure> {
        let silence = if self.answered {
            self.silence.later
        } else {
            self.silence.first
        };
        let calls = self.calls.as_ref();
        let calls = calls.ok_or_else(|| "it was called after its end".to_string())?;
        calls
            .send((call, self.shares))
            .map_err(|_| "nobody writes to it any more".to_string())?;
        // Whether the program has gone, and how, its answer shows better than the pipe to it.
        let reply = match self.wait_for_reply(silence) {
            Ok(reply) => reply.map_err(|error| format!("no reply: {error}"))?,
            Err(RecvTimeoutError::Timeout) if self.exited(Duration::ZERO).is_some() => {
                let reason = "no reply, and a program that it started holds its standard output open";
                return Err(Failure::Other(reason.into()));
            }
            Err(RecvTimeoutError::Timeout) if is_ending() => return Err(Failure::Other(ENDED.into())),
            Err(RecvTimeoutError::Timeout) => {
                return Err(Failure::Other(format!(
                    "no reply within {} s: do less in a call, and what takes long, as loading a model, before `run`",
                    silence.as_secs()
                )));
            }
            Err(RecvTimeoutError::Disconnected) => return Err(Failure::Closed),
        };
        self.answered = true;
        let written = self.written.recv_timeout(silence);
        written
            .map_err(|error| error.to_string())?
            .map_err(|error| error.to_string())?;
        Ok(Reply::from_bytes(reply).map_err(|error| format!("no reply: {error}"))?)
    }

    /// The next frame. Of a program that has exited none is awaited for longer than it may still be on its way, and the end of
    /// all runs ends the wait.
    fn wait_for_reply(&mut self, silence: Duration) -> Result<Result<Buffer, FrameError>, RecvTimeoutError> {
        let begun = Instant::now();
        loop {
            let left = silence.saturating_sub(begun.elapsed());
            match self.replies.recv_timeout(left.min(LOOK)) {
                Err(RecvTimeoutError::Timeout) if left > LOOK && !is_ending() => {}
                found => return found,
            }
            if self.exited(Duration::ZERO).is_some() {
                return self.replies.recv_timeout(ON_ITS_WAY);
            }
            if let Some(notice) = self.notice(begun.elapsed(), silence) {
                eprintln!("realo: {notice}");
            }
        }
    }

    /// Says once, after some time, who is waited for.
    fn notice(&mut self, waited: Duration, silence: Duration) -> Option<String> {
        if self.noticed || waited < NOTICE {
            return None;
        }
        self.noticed = true;
        let what = match std::ptr::eq(self.registration, &NOBODY) {
            true => "declare its ports",
            false => "answer a call",
        };
        Some(format!(
            "waiting for node `{}`: for {} s its program did not {what}; the run fails after {} s",
            self.node,
            waited.as_secs(),
            silence.as_secs()
        ))
    }

    /// Hands a reply on; gives the operator's error.
    fn take(&self, reply: Reply, out: &mut Outputs) -> Result<Option<String>, Failure> {
        let sent = reply.sent.into_iter().map(|(name, mut message)| {
            let port = self.output(&name, &message)?;
            boxes::take_out(&mut message, out);
            Ok((port, message))
        });
        let sent = sent.collect::<Result<_, String>>()?;
        out.take_over(Made {
            sent,
            wakes: reply.wakes.into_iter().collect(),
            counts: Counts {
                counters: reply.counts.into_iter().map(|(name, n)| (name.into(), n)).collect(),
                losses: reply
                    .reported
                    .losses
                    .into_iter()
                    .map(|(name, loss)| (name.into(), loss))
                    .collect(),
                ..Counts::default()
            },
            explained: reply.reported.explained,
            fates: reply.reported.fates,
            traffic: reply.reported.traffic,
            steps: Vec::new(),
        });
        Ok(reply.error)
    }

    fn output(&self, name: &str, message: &Message) -> Result<PortId, String> {
        let known = self.registration.output(name);
        let (id, port) = known.ok_or_else(|| format!("it sent on `{name}`, an output that it did not declare"))?;
        let found = message.payload.payload_type();
        if !port.types.contains(&found) {
            let expected: Vec<_> = port.types.iter().map(|name| name.as_str()).collect();
            let expected = expected.join(" or ");
            return Err(format!(
                "it sent a {found} on `{name}`, which it declared to carry {expected}"
            ));
        }
        Ok(id)
    }

    /// Lets the program exit; a code other than 0 is an error.
    fn dismiss(&mut self) -> Result<(), Gone> {
        self.calls = None;
        match self.exited(FAREWELL) {
            Some(status) if status.success() => Ok(()),
            Some(_) => Err(Gone(self.last_words("it failed after its end"))),
            None => {
                let reason = format!("it did not exit within {} s of its end", FAREWELL.as_secs());
                Err(Gone(self.last_words(&reason)))
            }
        }
    }

    fn stop(&mut self) {
        self.was_stopped = true;
        self.guard.kill();
        let _ = self.process.wait();
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.calls = None;
        if self.exited(Duration::from_millis(500)).is_none() {
            self.stop();
        }
    }
}

impl AnyOperator for Child {
    fn on_input(&mut self, PortId(port): PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        let port = self.registration.inputs[port].name.to_string();
        let message = Box::new(message);
        self.ask(&Call::Input { port, message }, out)
    }

    fn on_wake(&mut self, _now: Nanos, out: &mut Outputs) -> Result<(), Error> {
        self.ask(&Call::Wake, out)
    }

    fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error> {
        let ended = self.ask(&Call::End, out);
        if ended.as_ref().is_err_and(|error| error.is::<Gone>()) {
            return ended;
        }
        self.dismiss()?;
        ended
    }
}

/// Stands for a program that has not said hello.
static NOBODY: Registration = Registration {
    name: "",
    about: "",
    role: realo_operator::Role::Operator,
    inputs: &[],
    outputs: &[],
    settings: &[],
    counters: &[],
    defaults: serde_json::Map::new,
    check: |_| Ok(()),
    examine: |_| Ok(()),
    maps: |_| Vec::new(),
    build: |_| Err("a program that has not said hello".into()),
};

#[cfg(test)]
mod tests {
    use std::process::Stdio;

    use realo_schemas::{Header, Kind, PayloadType, PointCloud};

    use super::*;
    use realo_operator::Port;

    fn shell(script: &str, patience: Duration) -> Result<Child, String> {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        Child::start("fusion", command, patience)
    }

    /// What some scripts declare.
    static SCRIPTED: Registration = Registration {
        name: "scripted",
        inputs: &[Port::new("clouds", &[PayloadType::PointCloud], "sweeps")],
        ..NOBODY
    };

    /// A program that says hello and then does something else.
    fn greeting(script: &str) -> Child {
        let hello = tempfile::NamedTempFile::new().unwrap();
        let words = hello::write(&SCRIPTED, &[], false).unwrap();
        frame::write_first(&mut hello.as_file(), &words).unwrap();
        let script = format!("cat '{}'; {script}", hello.path().display());
        shell(&script, Duration::from_secs(60)).unwrap()
    }

    fn start(script: &str, patience: Duration) -> String {
        let started = shell(script, patience);
        started.map(|_| ()).expect_err("it speaks no protocol")
    }

    #[test]
    fn a_program_that_stops_reading_is_stopped_and_named() {
        let mut child = greeting("exec sleep 60");
        child.limit_silence(Silence {
            first: Duration::from_millis(100),
            later: Duration::from_secs(60),
        });
        // More than a pipe holds.
        const POINTS: usize = 100_000;
        let axis = || vec![0.0; POINTS];
        let cloud = PointCloud::new(
            axis(),
            axis(),
            axis(),
            vec![0; POINTS],
            vec![0; POINTS],
            vec![0; POINTS],
        );
        let cloud = cloud.expect("the columns are as long as each other");
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Points, 0, 0, 0);
        let asked = child.on_input(PortId(0), Message::new(header, cloud), &mut Outputs::at(0));
        let error = asked.unwrap_err().to_string();
        assert!(
            error.contains("no reply within") && error.contains("it was stopped"),
            "{error}"
        );
    }

    #[test]
    fn a_program_that_ends_is_noticed_while_another_holds_its_output_open() {
        let mut child = greeting("sleep 20 2>/dev/null & exit 4");
        let begun = Instant::now();
        let error = child.on_wake(0, &mut Outputs::at(0)).unwrap_err().to_string();
        assert!(
            error.contains("holds its standard output open") && error.contains("exit status: 4"),
            "{error}"
        );
        assert!(begun.elapsed() < Duration::from_secs(18));
    }

    #[test]
    fn a_program_that_refuses_its_settings_is_quoted_alone() {
        let refusal = tempfile::NamedTempFile::new().unwrap();
        let words = hello::write_refusal("mine", "setting `model`: expected an ONNX file, found a folder").unwrap();
        frame::write_first(&mut refusal.as_file(), &words).unwrap();
        let error = start(
            &format!("cat '{}'; exit 1", refusal.path().display()),
            Duration::from_secs(60),
        );
        let expected = "setting `model`: expected an ONNX file, found a folder (it ended with exit status: 1)";
        assert!(
            error.starts_with("node `fusion`: program `") && error.ends_with(expected),
            "{error}"
        );
        assert!(!error.contains("a plug-in is a program"), "{error}");
    }

    #[test]
    fn a_program_that_stays_silent_is_stopped_and_named() {
        let begun = Instant::now();
        let error = start("exec sleep 60", Duration::from_millis(50));
        assert!(
            error.contains("node `fusion`") && error.contains("nothing within 0 s"),
            "{error}"
        );
        assert!(error.contains("it was stopped"), "{error}");
        assert!(begun.elapsed() < Duration::from_secs(30));
    }

    #[test]
    fn who_is_waited_for_is_said_once() {
        let mut child = greeting("exec sleep 60");
        let mut notice = |seconds| child.notice(Duration::from_secs(seconds), Duration::from_secs(600));
        assert_eq!(notice(9), None);
        let said = notice(10).unwrap();
        assert_eq!(
            said,
            "waiting for node `fusion`: for 10 s its program did not answer a call; the run fails after 600 s"
        );
        assert_eq!(notice(11), None);
    }

    #[test]
    fn a_failure_in_a_call_says_which_program_its_last_lines_and_what_to_try() {
        let many = "for line in 1 2 3 4 5 6 7 8 9 10 11 12 13 14; do echo \"line $line\" >&2; done";
        for (script, named) in [
            (
                format!("{many}; echo 'ValueError: no boxes' >&2; exit 1"),
                &[
                    "program `sh -c",
                    "it ended with exit status: 1 before it answered a call",
                    "at last:\n    line 4\n    line 5\n",
                    "\n    ValueError: no boxes\nmend what its last lines name",
                ][..],
            ),
            (
                "kill -s KILL $$".into(),
                &[
                    "before it answered a call; it said nothing",
                    "\nit was killed: if the system did it",
                ],
            ),
            (
                "kill -s SEGV $$".into(),
                &["\nit crashed in compiled code: PYTHONFAULTHANDLER=1"],
            ),
            (
                "exec sleep 60 >&-".into(),
                &[
                    "it closed its standard output",
                    "\ndocs/reference/plugins.md, \"When something stops you\"",
                ],
            ),
        ] {
            let mut child = greeting(&script);
            let error = child.on_wake(0, &mut Outputs::at(0)).unwrap_err().to_string();
            for part in named {
                assert!(error.contains(part), "{part}: {error}");
            }
            assert!(!error.contains("line 3\n"), "{error}");
        }
    }

    #[test]
    fn a_program_that_exits_is_quoted_from_the_end_of_what_it_said() {
        let script = "head -c 9000 /dev/zero | tr '\\0' . >&2; echo 'the last word' >&2; exit 4";
        let error = start(script, Duration::from_secs(60));
        assert!(
            error.contains("exit status: 4") && error.contains("the last word"),
            "{error}"
        );
        assert!(error.len() < QUOTED + 1000, "{}", error.len());
    }
}

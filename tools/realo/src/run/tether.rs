//! What ties dora and its nodes to this process: see `realo_host::dora`.

use std::io::{PipeWriter, Write};
use std::os::fd::AsRawFd;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use eyre::{Result, WrapErr, bail};
use realo_cli::Outcome;
use realo_host::dora::{TETHER_VARIABLE, tether_of};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::{FdFlags, fcntl_setfd};
use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal};

/// Runs a program that ends with the process that started it (`realo run` starts dora so)
#[derive(clap::Args)]
pub struct TetheredArgs {
    /// Who starts it
    parent: i32,
    /// The program
    program: PathBuf,
    /// What it is given
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    args: Vec<String>,
}

/// Becomes the program.
pub fn tethered(args: &TetheredArgs) -> Result<Outcome> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    // It may have died before.
    if getppid().map(Pid::as_raw_pid) != Some(args.parent) {
        bail!("the `realo run` that started this process has ended, so nothing is started");
    }
    let error = Command::new(&args.program).args(&args.args).exec();
    Err(error).wrap_err_with(|| format!("{}", args.program.display()))
}

/// The writing end: the processes of a run read from the other.
pub struct Tether(PipeWriter);

impl Tether {
    /// Starts a program in a process group of its own, so that Ctrl-C reaches this process alone; it and all that it starts
    /// end with this process.
    ///
    /// # Errors
    /// What the system refuses.
    pub fn start(program: &std::path::Path, prepare: impl FnOnce(&mut Command)) -> Result<(Tether, Child)> {
        let (reader, writer) = std::io::pipe()?;
        fcntl_setfd(&reader, FdFlags::empty())?;
        let mut command = Command::new(std::env::current_exe()?);
        command
            .arg("tethered")
            .arg(std::process::id().to_string())
            .arg(program)
            .env(TETHER_VARIABLE, tether_of(reader.as_raw_fd())?)
            .process_group(0);
        prepare(&mut command);
        let child = command.spawn().wrap_err_with(|| format!("{}", program.display()))?;
        Ok((Tether(writer), child))
    }

    /// Asks sources to end their streams.
    pub fn end(&mut self) {
        // Where nobody reads any more, nobody has to end.
        let _ = self.0.write_all(&[0]);
    }

    /// Ends all that is left, dora first, and waits until nothing is left.
    pub fn kill(mut self, dora: &mut Child) {
        let _ = dora.kill();
        let _ = dora.wait();
        let _ = self.0.write_all(&[0, 0]);
        let begun = Instant::now();
        while !self.is_alone() && begun.elapsed() < Duration::from_secs(2) {
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Whether no process of the run is left.
    fn is_alone(&self) -> bool {
        let mut polled = [PollFd::new(&self.0, PollFlags::empty())];
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut polled, Some(&now)).is_ok() && polled[0].revents().contains(PollFlags::ERR)
    }
}

//! Where network namespaces can be made: where the process is, or in a user namespace of its own.
#![allow(unsafe_code)]

use std::ffi::CString;
use std::io::{self, Read, Write};
use std::path::Path;
use std::sync::OnceLock;

use crate::machines::{Error, Machines};

/// Where the machines' namespaces are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ground {
    /// Beside everybody's: `ip netns` of root knows them.
    System,
    /// In a user namespace, and a mount namespace, that this process has entered: it, and what it starts, knows them.
    User,
}

impl Ground {
    /// Finds it, once in a process, and enters it. A user namespace can be entered while the process has one thread.
    ///
    /// # Errors
    /// [`Error::Nowhere`], with what failed on each.
    pub fn find() -> Result<Ground, Error> {
        static FOUND: OnceLock<Result<Ground, [String; 2]>> = OnceLock::new();
        let found = FOUND.get_or_init(|| {
            let Err(system) = Machines::try_out() else {
                return Ok(Ground::System);
            };
            let entered = entered_by_a_child().and_then(|()| enter_user_namespace().map_err(Error::User));
            match entered {
                Ok(()) => Ok(Ground::User),
                Err(user) => Err([system, user].map(|error| error.to_string())),
            }
        });
        found.clone().map_err(|[system, user]| Error::Nowhere { system, user })
    }
}

/// Whether machines can be made in a user namespace: a child tries, for there is no way back out of one.
fn entered_by_a_child() -> Result<(), Error> {
    let (mut hear, mut tell) = io::pipe().map_err(Error::User)?;
    // SAFETY: the child goes on alone with what it needs, and ends below.
    let child = unsafe { libc::fork() };
    if child < 0 {
        return Err(Error::User(io::Error::last_os_error()));
    }
    if child == 0 {
        let tried = enter_user_namespace()
            .map_err(Error::User)
            .and_then(|()| Machines::try_out());
        if let Err(error) = &tried {
            let _ = write!(tell, "{error}");
        }
        // SAFETY: what the parent has to tidy up is left to it.
        unsafe { libc::_exit(i32::from(tried.is_err())) };
    }
    drop(tell);
    let (mut said, mut status) = (String::new(), 0);
    let _ = hear.read_to_string(&mut said);
    // SAFETY: the status is written while the call lasts.
    unsafe { libc::waitpid(child, &mut status, 0) };
    match status {
        0 => Ok(()),
        _ => Err(Error::Child(said)),
    }
}

/// Makes this process root of a user namespace, with network and mounts of its own.
fn enter_user_namespace() -> io::Result<()> {
    // SAFETY: the calls read no memory of ours.
    let (user, group) = unsafe { (libc::geteuid(), libc::getegid()) };
    // SAFETY: as above.
    check(unsafe { libc::unshare(libc::CLONE_NEWUSER | libc::CLONE_NEWNET | libc::CLONE_NEWNS) })?;
    std::fs::write("/proc/self/uid_map", format!("0 {user} 1"))?;
    // A group may be mapped once groups can no longer be dropped.
    std::fs::write("/proc/self/setgroups", "deny")?;
    std::fs::write("/proc/self/gid_map", format!("0 {group} 1"))?;
    // `ip netns` keeps its names there, where only root writes.
    let folder = Path::new("/var/run").canonicalize()?;
    let folder = CString::new(folder.as_os_str().as_encoded_bytes())?;
    // SAFETY: the texts end with a zero and outlive the call; tmpfs needs no data.
    check(unsafe {
        libc::mount(
            c"tmpfs".as_ptr(),
            folder.as_ptr(),
            c"tmpfs".as_ptr(),
            0,
            std::ptr::null(),
        )
    })
}

fn check(result: libc::c_int) -> io::Result<()> {
    match result {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

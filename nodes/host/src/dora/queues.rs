//! Room for messages between processes.

use std::fs::File;
use std::io::Write;
use std::os::fd::{AsRawFd, OwnedFd};

use rustix::fs::{MemfdFlags, memfd_create};

/// Names a file with what dora's own settings of Zenoh are changed by.
pub const OVERLAY_VARIABLE: &str = "DORA_ZENOH_CONFIG_OVERLAY";
/// Lets dora's publishers wait for room instead of dropping at once.
pub const OVERLAY: &str = include_str!("../../../../dataflows/zenoh.json5");

/// Gives this process the queues that `realo run` gives to all, unless somebody has chosen others.
pub(super) fn widen() {
    if std::env::var_os(OVERLAY_VARIABLE).is_some() {
        return;
    }
    // Where the system has no such files, dora's own queues have to do.
    let Ok(file) = written() else { return };
    #[allow(unsafe_code)]
    // SAFETY: called before this process starts a thread that could read its environment.
    unsafe {
        std::env::set_var(OVERLAY_VARIABLE, format!("/proc/self/fd/{}", file.as_raw_fd()));
    }
    // dora reads it when the process joins.
    std::mem::forget(file);
}

/// A file without a place in a folder: the graph's may be read-only.
fn written() -> std::io::Result<File> {
    let file: OwnedFd = memfd_create("realo-zenoh.json5", MemfdFlags::CLOEXEC)?;
    let mut file = File::from(file);
    file.write_all(OVERLAY.as_bytes())?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_dora_reads_is_there() {
        let file = written().unwrap();
        let read = std::fs::read_to_string(format!("/proc/self/fd/{}", file.as_raw_fd())).unwrap();
        assert_eq!(read, OVERLAY);
    }
}

//! A TUN device: packets as a file.
#![allow(unsafe_code)]

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::os::fd::AsRawFd;

/// Of `linux/if_tun.h`.
const TUNSETIFF: libc::c_ulong = 0x4004_54ca;
const IFF_TUN: i16 = 1;
const IFF_NO_PI: i16 = 0x1000;
/// Bytes of a device's name, with the zero behind it.
const NAME: usize = 16;

pub(crate) struct Tun(File);

impl Tun {
    /// A device of this name, which stays until the last handle goes.
    pub fn new(name: &str) -> std::io::Result<Tun> {
        if name.len() >= NAME {
            return Err(std::io::Error::other(format!(
                "the name `{name}` has more than 15 bytes"
            )));
        }
        let file = OpenOptions::new().read(true).write(true).open("/dev/net/tun")?;
        // struct ifreq: name, flags, rest unused.
        let mut request = [0u8; 40];
        request[..name.len()].copy_from_slice(name.as_bytes());
        request[NAME..NAME + 2].copy_from_slice(&(IFF_TUN | IFF_NO_PI).to_ne_bytes());
        // SAFETY: the kernel reads and writes a struct ifreq, which is not longer than the array.
        let done = unsafe { libc::ioctl(file.as_raw_fd(), TUNSETIFF as _, request.as_mut_ptr()) };
        match done {
            0 => Ok(Tun(file)),
            _ => Err(std::io::Error::last_os_error()),
        }
    }

    pub fn share(&self) -> std::io::Result<Tun> {
        Ok(Tun(self.0.try_clone()?))
    }

    /// The length of the next packet; `None` while there is no way for any.
    pub fn read(&self, buffer: &mut [u8]) -> Option<usize> {
        (&self.0).read(buffer).ok().filter(|length| *length > 0)
    }

    /// Lets a packet out; one that the device does not take is lost.
    pub fn write(&self, packet: &[u8]) {
        let _ = (&self.0).write_all(packet);
    }
}

//! The wall clock of an emulated machine: a library that the machine's programs load before their own, so that the wall clock
//! they read is off by what a file says at that moment.
//!
//! `build.rs` builds it; the crate carries it along and has programs load it (`src/clock.rs`).
#![no_std]

use core::ffi::{CStr, c_char, c_int, c_long, c_void};
use core::ptr::{null, null_mut};
use core::sync::atomic::{AtomicI64, AtomicPtr, Ordering::Relaxed};

/// Of `linux/time.h`.
const CLOCK_REALTIME: c_int = 0;
const CLOCK_REALTIME_COARSE: c_int = 5;
/// Of `bits/dlfcn.h`: the next library that has a symbol.
const NEXT: *mut c_void = usize::MAX as *mut c_void;
/// Of `asm-generic/fcntl.h` and `mman-common.h`: read only, shared.
const O_RDONLY: c_int = 0;
const PROT_READ: c_int = 1;
const MAP_SHARED: c_int = 1;

/// Names the file: by how many nanoseconds the clock is ahead, eight bytes.
const FILE: &CStr = c"LINKEMU_WALL_CLOCK";
const SECOND: i64 = 1_000_000_000;

#[repr(C)]
pub struct Timespec {
    seconds: i64,
    nanoseconds: c_long,
}

type Read = unsafe extern "C" fn(c_int, *mut Timespec) -> c_int;

unsafe extern "C" {
    fn dlsym(handle: *mut c_void, name: *const c_char) -> *mut c_void;
    fn getenv(name: *const c_char) -> *const c_char;
    fn open(path: *const c_char, flags: c_int, ...) -> c_int;
    fn close(file: c_int) -> c_int;
    fn mmap(at: *mut c_void, length: usize, protection: c_int, flags: c_int, file: c_int, offset: i64) -> *mut c_void;
}

/// Reads a clock, as the C library does.
///
/// # Safety
/// As there: `time` leads to a `struct timespec`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn clock_gettime(clock: c_int, time: *mut Timespec) -> c_int {
    static READ: AtomicPtr<c_void> = AtomicPtr::new(null_mut());
    let mut read = READ.load(Relaxed);
    if read.is_null() {
        // SAFETY: the name ends with a zero.
        read = unsafe { dlsym(NEXT, c"clock_gettime".as_ptr()) };
        if read.is_null() {
            return -1;
        }
        READ.store(read, Relaxed);
    }
    // SAFETY: the C library has it with this signature.
    let read: Read = unsafe { core::mem::transmute(read) };
    // SAFETY: as the caller promises.
    let result = unsafe { read(clock, time) };
    if result == 0 && matches!(clock, CLOCK_REALTIME | CLOCK_REALTIME_COARSE) {
        // SAFETY: it was written just now.
        let time = unsafe { &mut *time };
        let ahead = ahead().load(Relaxed);
        let nanoseconds = time.nanoseconds + ahead.rem_euclid(SECOND);
        time.seconds += ahead.div_euclid(SECOND) + nanoseconds.div_euclid(SECOND);
        time.nanoseconds = nanoseconds.rem_euclid(SECOND);
    }
    result
}

/// By how much the clock is ahead now; by nothing where no file says it.
fn ahead() -> &'static AtomicI64 {
    static RIGHT: AtomicI64 = AtomicI64::new(0);
    static FOUND: AtomicPtr<AtomicI64> = AtomicPtr::new(null_mut());
    let mut found = FOUND.load(Relaxed);
    if found.is_null() {
        found = mapped().unwrap_or((&raw const RIGHT).cast_mut());
        FOUND.store(found, Relaxed);
    }
    // SAFETY: a map is never taken away, and the file has as many bytes.
    unsafe { &*found }
}

fn mapped() -> Option<*mut AtomicI64> {
    // SAFETY: the texts end with a zero; the map is of the file's own bytes.
    unsafe {
        let path = getenv(FILE.as_ptr());
        if path == null() {
            return None;
        }
        let file = open(path, O_RDONLY);
        if file < 0 {
            return None;
        }
        let map = mmap(null_mut(), size_of::<AtomicI64>(), PROT_READ, MAP_SHARED, file, 0);
        close(file);
        (map as usize != usize::MAX).then_some(map.cast())
    }
}

#[panic_handler]
fn panicked(_: &core::panic::PanicInfo) -> ! {
    loop {}
}

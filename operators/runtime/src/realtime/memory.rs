/// Blocks of memory up to this size are kept for the next one when they are freed, bytes; malloc allows no more.
const KEPT_BLOCK: libc::c_int = 32 << 20;
/// Free memory that is kept at most, bytes.
const KEPT: libc::c_int = 128 << 20;

/// Keeps freed memory in the process: a sweep of 5 MB comes every 100 ms, and to have its pages made anew each time
/// costs more than all that is computed on it.
pub(super) fn keep_freed_pages() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[allow(unsafe_code)]
    // SAFETY: mallopt takes integers and is called before this process starts another thread.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, KEPT_BLOCK);
        libc::mallopt(libc::M_TRIM_THRESHOLD, KEPT);
    }
}

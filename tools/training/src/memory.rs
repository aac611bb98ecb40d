//! Memory of a training.

/// Keeps freed memory in the process for as long as it lives: a step makes and drops maps of up to 50 MB, and to have their pages
/// made anew each time takes an eighth of it.
pub(crate) fn keep_freed_pages() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[allow(unsafe_code)]
    // SAFETY: mallopt takes integers, and malloc's lock while it sets them.
    unsafe {
        // Blocks of any size come from the heap, which never shrinks and grows in pieces of 256 MB.
        libc::mallopt(libc::M_MMAP_MAX, 0);
        libc::mallopt(libc::M_TRIM_THRESHOLD, libc::c_int::MAX);
        libc::mallopt(libc::M_TOP_PAD, 256 << 20);
    }
}

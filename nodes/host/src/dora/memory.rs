//! Memory of a process.

use realo_schemas::PayloadType;

use crate::Stages;

/// Blocks of memory up to this size are kept for the next one when they are freed, bytes; malloc allows no more.
const KEPT_BLOCK: libc::c_int = 32 << 20;
/// Free memory that is kept at most, bytes.
const KEPT: libc::c_int = 128 << 20;

/// Heaps at most: a heap for each thread would keep what it freed for itself.
const HEAPS: libc::c_int = 2;
/// Shared memory of a process that sends clouds or maps, bytes: some of them are under way at the same time, and what does
/// not fit takes another way and overtakes the rest.
pub const POOL: usize = 32 << 20;
/// Where dora looks for the size of the pool, unless the graph says one.
pub const POOL_VARIABLE: &str = "DORA_NODE_SHM_POOL_SIZE";

/// Asks dora for shared memory that holds what these stages send.
pub(super) fn size_pool(stages: &Stages) {
    let big = [PayloadType::PointCloud, PayloadType::FeatureMap, PayloadType::Packet];
    let sends_big = stages.exits.values().any(|(stage, port)| {
        let types = stages.wiring.stages[*stage].registration.outputs[port.0].types;
        types.iter().any(|sent| big.contains(sent))
    });
    if sends_big && std::env::var_os(POOL_VARIABLE).is_none() {
        #[allow(unsafe_code)]
        // SAFETY: called before this process starts a thread that could read its environment.
        unsafe {
            std::env::set_var(POOL_VARIABLE, POOL.to_string());
        }
    }
}

/// Keeps freed memory in the process: a sweep of 5 MB comes every 100 ms, and to have its pages made anew each time
/// costs more than all that is computed on it.
pub(super) fn keep_freed_pages() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[allow(unsafe_code)]
    // SAFETY: mallopt takes integers and is called before this process starts another thread.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, KEPT_BLOCK);
        libc::mallopt(libc::M_TRIM_THRESHOLD, KEPT);
        libc::mallopt(libc::M_ARENA_MAX, HEAPS);
    }
}

//! Whether tiles are there for this process.

#![allow(unsafe_code)]

#[cfg(target_os = "linux")]
use std::arch::asm;
use std::arch::x86_64::{__cpuid_count, CpuidResult};
use std::sync::LazyLock;

/// Whether the CPU has tiles with products of bf16 and bytes and the system has given them to this process.
pub fn is_available() -> bool {
    static AVAILABLE: LazyLock<bool> =
        LazyLock::new(|| is_x86_feature_detected!("avx512vnni") && has_tiles() && ask_for_tiles());
    *AVAILABLE
}

fn has_tiles() -> bool {
    const BF16: u32 = 1 << 22;
    const TILES: u32 = 1 << 24;
    const BYTES: u32 = 1 << 25;
    let CpuidResult { edx, .. } = __cpuid_count(7, 0);
    edx & (BF16 | TILES | BYTES) == BF16 | TILES | BYTES
}

#[cfg(target_os = "linux")]
/// Asks Linux for the state of the tiles, which it keeps for processes that want it only.
fn ask_for_tiles() -> bool {
    const ARCH_PRCTL: i64 = 158;
    const ARCH_REQ_XCOMP_PERM: i64 = 0x1023;
    const TILE_DATA: i64 = 18;
    let result: i64;
    // SAFETY: the call reads and writes no memory of the process; the kernel changes rcx and r11 besides the result.
    unsafe {
        asm!(
            "syscall",
            inlateout("rax") ARCH_PRCTL => result,
            in("rdi") ARCH_REQ_XCOMP_PERM,
            in("rsi") TILE_DATA,
            lateout("rcx") _,
            lateout("r11") _,
            options(nostack),
        );
    }
    result == 0
}

#[cfg(not(target_os = "linux"))]
fn ask_for_tiles() -> bool {
    false
}

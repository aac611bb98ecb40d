//! Builds the library by which machines have wall clocks of their own.

use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=wall_clock.rs");
    let var = |name: &str| std::env::var(name).unwrap_or_default();
    let library = Path::new(&var("OUT_DIR")).join("wall_clock.so");
    let is_known =
        ["OS", "ENV", "POINTER_WIDTH"].map(|what| var(&format!("CARGO_CFG_TARGET_{what}"))) == ["linux", "gnu", "64"];
    if !is_known {
        // Elsewhere there is none, and machines say so when their clock is to be set.
        std::fs::write(library, []).expect("OUT_DIR can be written");
        return;
    }
    let mut rustc = Command::new(var("RUSTC"));
    rustc.args(["--edition=2024", "--crate-type=cdylib", "--crate-name=wall_clock"]);
    rustc.args(["-Cpanic=abort", "-Copt-level=s", "-Clto", "-Cstrip=symbols"]);
    rustc.args(["--target", &var("TARGET")]);
    if let Ok(linker) = std::env::var("RUSTC_LINKER") {
        rustc.arg(format!("-Clinker={linker}"));
    }
    let status = rustc.arg("-o").arg(library).arg("wall_clock.rs").status();
    let status = status.expect("cargo says where rustc is");
    assert!(status.success(), "{rustc:?}: {status}");
}

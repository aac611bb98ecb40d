//! Hosts the operator on dora and in virtual time.

fn main() -> std::process::ExitCode {
    realo_runtime::run::<fusion_nearest::FusionNearest>()
}

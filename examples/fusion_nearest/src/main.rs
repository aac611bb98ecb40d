//! Hosts the operator on dora and in virtual time.

fn main() -> std::process::ExitCode {
    realo_operator::run::<fusion_nearest::FusionNearest>()
}

//! Serves the operator to the host that starts it.

fn main() -> std::process::ExitCode {
    realo_operator::run::<fusion_mean::FusionMean>()
}

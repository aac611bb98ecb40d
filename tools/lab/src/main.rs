//! `realo-lab`: see `realo-lab --help`.

fn main() -> std::process::ExitCode {
    realo_lab::main()
}

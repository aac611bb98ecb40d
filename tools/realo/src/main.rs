//! `realo`: see `realo --help`.

fn main() -> std::process::ExitCode {
    realo::main_with(&[])
}

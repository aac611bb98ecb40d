//! `realo-onnx role=encoder|fusion|head|detector model=FILE.onnx …`: a stage that runs an ONNX file, which a graph starts.

use std::process::ExitCode;

use realo_onnx::{Detector, Encoder, Fusion, Head, Role};

fn main() -> ExitCode {
    match Role::of_args(std::env::args().skip(1)) {
        Ok(Role::Encoder) => realo_operator::run::<Encoder>(),
        Ok(Role::Fusion) => realo_operator::run::<Fusion>(),
        Ok(Role::Head) => realo_operator::run::<Head>(),
        Ok(Role::Detector) => realo_operator::run::<Detector>(),
        Err(reason) => {
            eprintln!("realo-onnx: {reason}");
            ExitCode::FAILURE
        }
    }
}

//! A name for a network that changes with it.

use std::fs::File;
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::network::NetworkError;
use crate::whole::others;

/// The name of a file of these bytes; files beside it that hold some of its numbers count as well.
///
/// # Errors
/// A file beside it that cannot be read.
pub fn identity(path: &Path, bytes: &[u8]) -> Result<String, NetworkError> {
    let mut digest = Sha256::new();
    digest.update(bytes);
    for name in others(bytes) {
        let other = path.with_file_name(&name);
        digest.update(name.as_bytes());
        let read = File::open(&other).and_then(|mut file| std::io::copy(&mut file, &mut digest));
        read.map_err(|error| NetworkError::File {
            reason: format!("cannot be read: {error}; `{}` keeps weights in it", path.display()),
            path: other,
        })?;
    }
    let digits = digest
        .finalize()
        .iter()
        .take(6)
        .map(|byte| format!("{byte:02x}"))
        .collect::<String>();
    Ok(format!("onnx-{digits}"))
}

use std::path::Path;

use crate::drawing::Drawing;
use crate::{RenderError, png, svg};

/// What a picture is written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Shapes.
    Svg,
    /// Pixels.
    Png,
}

impl Format {
    /// The format of a file's ending.
    ///
    /// # Errors
    /// [`RenderError::Ending`] for another one.
    pub fn of(file: &Path) -> Result<Self, RenderError> {
        let ending = file.extension().map(|ending| ending.to_string_lossy().to_lowercase());
        match ending.as_deref() {
            Some("svg") => Ok(Format::Svg),
            Some("png") => Ok(Format::Png),
            other => Err(RenderError::Ending {
                file: file.into(),
                found: other.map_or("no ending".into(), |ending| format!(".{ending}")),
            }),
        }
    }
}

/// Writes a drawing in the format of the file's ending.
///
/// # Errors
/// [`RenderError::Ending`]; [`RenderError::Write`] where the system refuses.
pub fn write(file: &Path, drawing: &Drawing) -> Result<(), RenderError> {
    let bytes = match Format::of(file)? {
        Format::Svg => svg(drawing).into_bytes(),
        Format::Png => png(drawing),
    };
    let partial = file.with_added_extension("partial");
    let written = std::fs::write(&partial, bytes).and_then(|()| std::fs::rename(&partial, file));
    written.map_err(|reason| {
        let _ = std::fs::remove_file(&partial);
        RenderError::Write {
            file: file.into(),
            reason,
        }
    })
}

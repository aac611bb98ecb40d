//! Which kind of data set a folder is.

use std::fmt;
use std::path::Path;

use super::{Importer, KINDS};
use crate::ImportError;

/// Which kinds a folder is, with why, and why it is not each of the others.
pub struct Seen {
    /// Kinds that fit.
    pub fits: Vec<(&'static dyn Importer, String)>,
    /// Others.
    pub others: Vec<(&'static dyn Importer, String)>,
}

/// Looks at a folder.
pub fn look_at(dir: &Path) -> Seen {
    let mut seen = Seen {
        fits: Vec::new(),
        others: Vec::new(),
    };
    for importer in KINDS {
        match importer.recognise(dir) {
            Ok(why) => seen.fits.push((*importer, why)),
            Err(why) => seen.others.push((*importer, why)),
        }
    }
    seen
}

impl Seen {
    /// The only kind that fits.
    ///
    /// # Errors
    /// None or several, with why.
    pub fn only(&self, dir: &Path) -> Result<&'static dyn Importer, ImportError> {
        match self.fits[..] {
            [(importer, _)] => Ok(importer),
            _ => Err(ImportError::content(
                dir,
                format!(
                    "expected a data set of one kind, found {}:\n{self}\nname the kind: `import KIND`",
                    self.fits.len()
                ),
            )),
        }
    }
}

impl fmt::Display for Seen {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let line = |is: &str, (importer, why): &(&'static dyn Importer, String)| {
            format!("{is} `{}`: {why}", importer.kind().name)
        };
        let fits = self.fits.iter().map(|found| line("it is", found));
        let others = self.others.iter().map(|found| line("it is not", found));
        f.write_str(&fits.chain(others).collect::<Vec<_>>().join("\n"))
    }
}

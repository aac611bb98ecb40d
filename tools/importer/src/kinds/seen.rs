//! Which kind of data set a folder is, and where its root is if it is near.

use std::fmt;
use std::path::{Path, PathBuf};

use realo_logs::shell;

use super::folders::list;
use super::{FolderMemory, Importer, KINDS, Kind};
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
    let _memory = FolderMemory::new(|_| {});
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
    /// None or several, with why, and the data sets that are near.
    pub fn only(&self, dir: &Path) -> Result<&'static dyn Importer, ImportError> {
        if !dir.exists() {
            let reason = "expected a data set or a bag, found nothing; correct the path";
            return Err(ImportError::content(dir, reason));
        }
        let next = match &self.fits[..] {
            [(importer, _)] => return Ok(*importer),
            [] => hint(&near(dir)).unwrap_or_else(|| {
                "give the folder that `realo-lab import --list` says of its kind; unpack archives first".into()
            }),
            several => {
                let commands: Vec<String> = several
                    .iter()
                    .map(|(importer, _)| command(importer.kind(), dir))
                    .collect();
                format!("name the kind: {}", commands.join(" or "))
            }
        };
        let found = match dir.is_file() {
            // Of all kinds only bags are files.
            true => self.said_of("bag").unwrap_or_default(),
            false => self.to_string(),
        };
        Err(ImportError::content(
            dir,
            format!(
                "expected a data set of one kind, found {}:\n{found}\n{next}",
                self.fits.len()
            ),
        ))
    }

    /// How to import what was seen, and which data sets of other kinds are in the folder beside it.
    pub fn next(&self, dir: &Path) -> String {
        let names: Vec<&str> = self.fits.iter().map(|(importer, _)| importer.kind().name).collect();
        let commands = self.fits.iter().map(|(importer, _)| command(importer.kind(), dir));
        let mut lines: Vec<String> = commands.map(|command| format!("import it: {command}")).collect();
        let mut besides = below(dir);
        besides.retain(|near| !names.contains(&near.kind.name));
        lines.extend(hint(&besides).map(|hint| format!("besides, {hint}")));
        lines.join("\n")
    }

    fn said_of(&self, kind: &str) -> Option<String> {
        let of = self.others.iter().find(|(importer, _)| importer.kind().name == kind)?;
        Some(format!("it is not `{kind}`: {}", of.1))
    }
}

/// A data set that is near a folder.
struct Near {
    path: PathBuf,
    kind: &'static Kind,
    why: String,
}

/// Refuses a folder that `kind` does not know, with why not, and that another kind knows. Gives what to say if the folder cannot be
/// imported: where a data set of this kind is.
///
/// # Errors
/// Another kind, here or near, with why and how it is imported.
pub fn refuse_others(kind: &Kind, dir: &Path, why_not: &str) -> Result<Option<String>, ImportError> {
    let here = fits(dir);
    // What lies around a file says nothing of it.
    let near = match here.is_empty() && dir.is_dir() {
        true => near(dir),
        false => Vec::new(),
    };
    let has_own = near.iter().any(|near| near.kind.name == kind.name);
    let refused = match (&here[..], has_own) {
        ([], true) => return Ok(hint(&near)),
        ([], false) => hint(&near),
        _ => Some(looks_like(&here)),
    };
    match refused {
        None => Ok(None),
        Some(hint) => {
            let reason = format!("{why_not}; expected {}; {hint}", kind.needs);
            Err(ImportError::content(dir, reason))
        }
    }
}

/// The kinds that know a path.
fn fits(path: &Path) -> Vec<Near> {
    fits_of(path, |_| true)
}

/// Those of some kinds that know a path.
fn fits_of(path: &Path, is_asked: impl Fn(&Kind) -> bool) -> Vec<Near> {
    let asked = KINDS.iter().filter(|importer| is_asked(importer.kind()));
    let known = asked.filter_map(|importer| {
        let why = importer.recognise(path).ok()?;
        Some(Near {
            path: path.into(),
            kind: importer.kind(),
            why,
        })
    });
    known.collect()
}

fn looks_like(here: &[Near]) -> String {
    let lines: Vec<String> = here
        .iter()
        .map(|Near { path, kind, why }| {
            format!(
                "this looks like `{}`, because {why}; try {}",
                kind.name,
                command(kind, path)
            )
        })
        .collect();
    lines.join("; or ")
}

fn hint(near: &[Near]) -> Option<String> {
    let lines = near.iter().map(|Near { path, kind, why }| {
        let name = kind.name;
        format!(
            "`{}` looks like `{name}`, because {why}; try {}",
            path.display(),
            command(kind, path)
        )
    });
    let lines: Vec<String> = lines.collect();
    (!lines.is_empty()).then(|| lines.join("\n"))
}

fn command(kind: &Kind, path: &Path) -> String {
    format!("`realo-lab import {} {} -o LOG`", kind.name, shell::word(path))
}

/// Folders in a folder that are looked at, and data sets that are named.
const LOOKED_AT: usize = 20;
const NAMED: usize = 4;
/// How names of files end that may be bags.
const BAGS: [&str; 5] = ["bag", "mcap", "db3", "pcap", "zst"];
/// How names of files end that are a part of a sweep.
const PARTS: [&str; 7] = ["yaml", "pcd", "bin", "npz", "npy", "json", "txt"];

/// Data sets in a folder, else those that it is a part of.
fn near(dir: &Path) -> Vec<Near> {
    let found = below(dir);
    match found.is_empty() {
        true => above(dir),
        false => found,
    }
}

fn below(dir: &Path) -> Vec<Near> {
    let Ok(listed) = list(dir) else { return Vec::new() };
    let is_bag = |name: &&String| {
        name.rsplit_once('.')
            .is_some_and(|(_, end)| BAGS.contains(&end.to_lowercase().as_str()))
    };
    let bags = listed.files.iter().filter(is_bag).map(|name| dir.join(name));
    let paths = listed.folders.iter().take(LOOKED_AT).cloned();
    let mut found = Vec::new();
    for path in paths.chain(bags.take(LOOKED_AT)) {
        found.extend(fits(&path));
        if found.len() >= NAMED {
            break;
        }
    }
    found.truncate(NAMED);
    found
}

/// The data set that a part of a sweep, or the folder of such parts or of an agent, is in.
fn above(dir: &Path) -> Vec<Near> {
    let Ok(whole) = dir.canonicalize() else {
        return Vec::new();
    };
    let is_part = |name: &String| name.rsplit_once('.').is_some_and(|(_, end)| PARTS.contains(&end));
    let holds_parts = || list(&whole).is_ok_and(|listed| listed.files.iter().any(is_part));
    if !whole.is_file() && !holds_parts() {
        return Vec::new();
    }
    // Kinds that look for scenes anywhere below a folder are asked of one only: a folder farther up may be a whole disk.
    let mut ancestors = whole.ancestors().skip(1).take(2).zip([true, false]);
    let found = ancestors.find_map(|(path, is_next)| {
        let found = fits_of(path, |kind| is_next || kind.is_exact);
        (!found.is_empty()).then_some(found)
    });
    found.unwrap_or_default()
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

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::fs;
    use std::rc::Rc;

    use super::super::importer;
    use super::*;

    /// Folders of a tree with so many scenes of two agents.
    fn tree(root: &Path, scenes: usize) -> u64 {
        for scene in 0..scenes {
            for agent in ["641", "650"] {
                let folder = root.join(format!("train/2021_08_16_22_26_{scene:02}/{agent}"));
                fs::create_dir_all(&folder).unwrap();
                fs::write(
                    folder.join("000068.yaml"),
                    "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n",
                )
                .unwrap();
                fs::write(folder.join("000068.pcd"), "").unwrap();
            }
        }
        2 + 3 * scenes as u64
    }

    #[test]
    fn a_data_set_is_listed_once_by_all_kinds_and_the_import_together() {
        let dir = tempfile::tempdir().unwrap();
        let all = tree(dir.path(), 5);
        let reported = Rc::new(Cell::new(0));
        let look = reported.clone();
        let memory = FolderMemory::new(move |folders| {
            assert_eq!(folders, look.get() + 1);
            look.set(folders);
        });
        let seen = look_at(dir.path());
        assert!(memory.read() <= all, "{}", memory.read());
        assert_eq!(seen.only(dir.path()).unwrap().kind().name, "opv2v");
        let opv2v = importer("opv2v").unwrap();
        opv2v
            .job(dir.path(), &dir.path().join("out"), &opv2v.kind().defaults())
            .unwrap();
        assert_eq!((memory.read(), reported.get()), (all, all));
        // A kind that it is not, too.
        let kitti = importer("kitti").unwrap();
        assert!(
            kitti
                .job(dir.path(), &dir.path().join("out"), &kitti.kind().defaults())
                .is_err()
        );
        assert_eq!(memory.read(), all);
    }

    #[test]
    fn a_tree_that_is_no_data_set_is_listed_once() {
        let dir = tempfile::tempdir().unwrap();
        for folder in ["a/b/c", "d/e", "f"] {
            fs::create_dir_all(dir.path().join(folder)).unwrap();
        }
        let memory = FolderMemory::new(|_| {});
        assert!(look_at(dir.path()).only(dir.path()).is_err());
        let opv2v = importer("opv2v").unwrap();
        assert!(
            opv2v
                .job(dir.path(), &dir.path().join("out"), &opv2v.kind().defaults())
                .is_err()
        );
        assert_eq!(memory.read(), 7);
        drop(memory);
        // Nothing is remembered any more.
        tree(dir.path(), 1);
        assert_eq!(look_at(dir.path()).only(dir.path()).unwrap().kind().name, "opv2v");
    }

    #[test]
    fn commands_quote_their_paths() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join("my data's");
        tree(&root, 1);
        let next = look_at(&root).next(&root);
        let words = shlex::split(next.split('`').nth(1).unwrap()).unwrap();
        assert_eq!(
            words,
            ["realo-lab", "import", "opv2v", root.to_str().unwrap(), "-o", "LOG"]
        );
    }
}

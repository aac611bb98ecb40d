//! Where figures come from: commit, weights, and for times the machine.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;

use eyre::{Result, WrapErr, bail, ensure};
use sha2::{Digest, Sha256};

use super::page::{Kind, Page};

/// What measuring writes itself: changes there are no changes of what is measured.
const WRITTEN: [&str; 2] = [":(exclude)docs/measured", ":(exclude)README.md"];
/// Instructions that kernels of networks are written for, as Linux names them.
const INSTRUCTIONS: [&str; 7] = [
    "avx2",
    "avx512f",
    "avx512_vnni",
    "avx512_bf16",
    "amx_tile",
    "amx_bf16",
    "amx_int8",
];

/// The tree that is measured.
pub struct Tree {
    /// Its folder.
    pub root: PathBuf,
    commit: String,
    is_changed: bool,
}

/// What the head of a page says.
pub struct Provenance {
    /// The commit, and whether the tree had changes.
    pub commit: String,
    /// The command that wrote the page.
    pub command: String,
    /// Each file of weights and its sha256.
    pub weights: Vec<(String, String)>,
    /// Of pages of times.
    pub machine: Option<Machine>,
}

/// The machine that times are of.
#[derive(Clone)]
pub struct Machine {
    /// The name of its processor.
    pub cpu: String,
    /// Threads that a program has here.
    pub threads: usize,
    /// Instructions for networks that the processor has.
    pub instructions: String,
}

fn git(folder: &Path, args: &[&str]) -> Result<String> {
    let output = Command::new("git").args(args).current_dir(folder).output();
    let output = output.wrap_err("git, which names the commit")?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).trim().to_string();
    ensure!(
        output.status.success(),
        "git {}: {}",
        args.join(" "),
        text(&output.stderr)
    );
    Ok(text(&output.stdout))
}

/// The sha256 of a file.
///
/// # Errors
/// A file that cannot be read.
pub fn sha256(path: &Path) -> Result<String> {
    let mut hash = Sha256::new();
    File::open(path)
        .and_then(|mut file| std::io::copy(&mut file, &mut hash))
        .wrap_err_with(|| path.display().to_string())?;
    Ok(hex(&hash.finalize()))
}

/// Bytes as hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

impl Tree {
    /// The tree of a folder.
    ///
    /// # Errors
    /// No git repository there.
    pub fn of(root: PathBuf) -> Result<Self> {
        let commit = git(&root, &["rev-parse", "--short=12", "HEAD"])?;
        let status = ["status", "--porcelain", "--untracked-files=no", "--", "."];
        let changes = git(&root, &[&status[..], &WRITTEN].concat())?;
        Ok(Tree {
            root,
            commit,
            is_changed: !changes.is_empty(),
        })
    }

    /// What git says of it.
    ///
    /// # Errors
    /// What git finds wrong.
    pub fn git(&self, args: &[&str]) -> Result<String> {
        git(&self.root, args)
    }

    /// Its commit, and whether it has changes that are in none.
    pub fn commit(&self) -> String {
        let changed = if self.is_changed { " with changes" } else { "" };
        format!("`{}`{changed}", self.commit)
    }

    /// Refuses a tree with changes, whose commit would not be what was measured.
    ///
    /// # Errors
    /// Changes, unless they are allowed.
    pub fn refuse_changes(&self, allowed: bool) -> Result<()> {
        if self.is_changed && !allowed {
            bail!(
                "the tree has changes that are not committed: commit them, or say --allow-dirty, which the page then says"
            );
        }
        Ok(())
    }

    /// What the head of a page says.
    ///
    /// # Errors
    /// Weights that are not there.
    pub fn provenance(&self, page: &Page, command: String) -> Result<Provenance> {
        let hashed = |file: &String| Ok((file.clone(), sha256(&self.root.join(file))?));
        Ok(Provenance {
            commit: self.commit(),
            command,
            weights: page.weights.iter().map(hashed).collect::<Result<_>>()?,
            machine: (page.kind == Kind::Times).then(machine),
        })
    }
}

/// This machine.
pub fn machine() -> Machine {
    let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let (cpu, instructions) = processor(&info);
    Machine {
        cpu,
        threads: std::thread::available_parallelism().map_or(1, |threads| threads.get()),
        instructions,
    }
}

/// Name and instructions of a processor.
fn processor(info: &str) -> (String, String) {
    let field = |name: &str| {
        let mut lines = info.lines();
        lines.find_map(|line| Some(line.strip_prefix(name)?.split_once(':')?.1.trim()))
    };
    let flags: Vec<&str> = field("flags").unwrap_or_default().split(' ').collect();
    let known = INSTRUCTIONS.into_iter().filter(|name| flags.contains(name));
    let known = known.collect::<Vec<_>>().join(", ");
    (field("model name").unwrap_or("unknown").into(), known)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_processor_is_read() {
        let info = "processor\t: 0\nmodel name\t: AMD EPYC\nflags\t\t: sse avx2 avx512_bf16 rdrand\n";
        assert_eq!(processor(info), ("AMD EPYC".into(), "avx2, avx512_bf16".into()));
        assert_eq!(processor(""), ("unknown".into(), String::new()));
    }

    #[test]
    fn changes_are_refused_unless_measuring_made_them() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let run = |args: &[&str]| {
            git(
                folder.path(),
                &[&["-c", "user.name=a", "-c", "user.email=a@b"], args].concat(),
            )
        };
        run(&["init", "-q"]).unwrap();
        fs::create_dir_all(at("docs/measured")).unwrap();
        for file in ["code.rs", "README.md", "docs/measured/small.md"] {
            fs::write(at(file), "a").unwrap();
        }
        run(&["add", "."]).unwrap();
        run(&["commit", "-q", "-m", "first"]).unwrap();
        let commit = run(&["rev-parse", "HEAD"]).unwrap();
        // A commit has one name, whatever tags are near.
        run(&["tag", "v9"]).unwrap();
        fs::write(at("docs/measured/small.md"), "b").unwrap();
        fs::write(at("README.md"), "b").unwrap();
        fs::write(at("untracked"), "b").unwrap();
        let tree = Tree::of(folder.path().into()).unwrap();
        tree.refuse_changes(false).unwrap();
        assert!(commit.starts_with(&tree.commit), "{commit} {}", tree.commit);
        fs::write(at("code.rs"), "b").unwrap();
        let tree = Tree::of(folder.path().into()).unwrap();
        let error = tree.refuse_changes(false).unwrap_err().to_string();
        assert!(error.contains("--allow-dirty"), "{error}");
        tree.refuse_changes(true).unwrap();
        let page = toml::from_str("title = 'T'\nkind = 'scores'\nabout = 'A'\n").unwrap();
        let provenance = tree.provenance(&page, String::new()).unwrap();
        assert!(provenance.commit.ends_with(" with changes"), "{}", provenance.commit);
        assert!(provenance.machine.is_none());
    }
}

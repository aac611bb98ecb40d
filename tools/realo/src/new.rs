//! `realo new`: a plug-in of one's own that works, with its test.

mod names;

use std::fs;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use eyre::{Result, WrapErr, bail, eyre};

use crate::command::called;
use crate::{Outcome, run};

/// Writes a plug-in that works, with its test, into a new folder
#[derive(clap::Args)]
pub struct Args {
    /// What it does
    #[arg(value_enum)]
    kind: Kind,
    /// Its name, and the new folder
    name: PathBuf,
    /// In Python instead of Rust
    #[arg(long)]
    python: bool,
}

/// What a plug-in does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Fuses the boxes of agents, in the place of `fusion.fusion` of late_fusion.
    Fusion,
    /// Detects in points, in the place of `encoder` and `head`; Python only.
    Detector,
}

/// A shipped example, which the tests of this project run, and the names in it.
struct Template {
    files: &'static [(&'static str, &'static str)],
    name: &'static str,
    module: &'static str,
    class: &'static str,
    places: &'static str,
}

const RUST_FUSION: Template = Template {
    files: &[
        (
            "Cargo.toml",
            include_str!("../../../examples/fusion_nearest/Cargo.toml"),
        ),
        (
            "src/lib.rs",
            include_str!("../../../examples/fusion_nearest/src/lib.rs"),
        ),
        (
            "src/main.rs",
            include_str!("../../../examples/fusion_nearest/src/main.rs"),
        ),
    ],
    name: "fusion-nearest",
    module: "fusion_nearest",
    class: "FusionNearest",
    places: "fusion.fusion",
};

const PYTHON_FUSION: Template = Template {
    files: &[
        ("MODULE.py", include_str!("../../../examples/python/fusion_boxes.py")),
        (
            "test_MODULE.py",
            include_str!("../../../examples/python/test_fusion_boxes.py"),
        ),
    ],
    name: "fusion-boxes-python",
    module: "fusion_boxes",
    class: "FusionBoxes",
    places: "fusion.fusion",
};

const PYTHON_DETECTOR: Template = Template {
    files: &[
        (
            "MODULE.py",
            include_str!("../../../examples/python/detector_clusters.py"),
        ),
        (
            "test_MODULE.py",
            include_str!("../../../examples/python/test_detector_clusters.py"),
        ),
    ],
    name: "detector-clusters",
    module: "detector_clusters",
    class: "DetectorClusters",
    places: "ego.encoder+head,others.encoder+head",
};

impl Template {
    /// A file's path and text for a plug-in of another name.
    fn renamed(&self, file: &str, text: &str, name: &str, checkout: &Path) -> (String, String) {
        let (module, class) = module_and_class(name);
        let checkout = checkout.to_string_lossy();
        let text = text
            .replace(self.name, name)
            .replace(self.module, &module)
            .replace(self.class, &class)
            .replace("path = \"../../", &format!("path = \"{checkout}/"));
        (file.replace("MODULE", &module), text)
    }
}

/// The names of a plug-in's module and of its class.
fn module_and_class(name: &str) -> (String, String) {
    let words = name.split(['-', '_']).map(|word| {
        let (first, rest) = word.split_at(word.len().min(1));
        first.to_uppercase() + rest
    });
    (name.replace('-', "_"), words.collect())
}

/// Writes the plug-in and prints what to do with it.
pub fn main(args: &Args) -> Result<Outcome> {
    let template = match (args.kind, args.python) {
        (Kind::Fusion, false) => &RUST_FUSION,
        (Kind::Fusion, true) => &PYTHON_FUSION,
        (Kind::Detector, true) => &PYTHON_DETECTOR,
        (Kind::Detector, false) => {
            bail!("a detector is written in Python here: add --python (in Rust: docs/reference/plugins.md)")
        }
    };
    let checkout = run::checkout().ok_or_else(|| {
        eyre!(
            "expected the checkout of realo, whose code plug-ins use, above this program, above the current folder, or where this \
             program was built; found none"
        )
    })?;
    let name = args.name.file_name().unwrap_or_default().to_string_lossy();
    check_name(&name)?;
    let (module, class) = module_and_class(&name);
    let texts = template.files.iter().map(|(_, text)| *text);
    names::check(&module, &class, args.python, texts)?;
    write(template, &args.name, &name, &checkout, args.python)?;
    println!("{}: a plug-in that works; it tests and runs by", args.name.display());
    for command in commands(template, &args.name, &name, &checkout, args.python) {
        println!("  {command}");
    }
    if args.python {
        println!(
            "Python needs numpy and pyarrow (`{} -m pip install numpy pyarrow`; `{} doctor` looks)",
            realo_host::python(),
            called()
        );
    }
    Ok(Outcome::Complete)
}

fn check_name(name: &str) -> Result<()> {
    let fits = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '_';
    if !name.starts_with(|c: char| c.is_ascii_lowercase()) || !name.chars().all(fits) {
        bail!("expected a name of small letters, digits, `-` and `_` that begins with a letter, found `{name}`");
    }
    if ["test", "core", "std", "alloc", "realo", "numpy", "pyarrow", "geometry"].contains(&name) {
        bail!("`{name}` is the name of something else: choose another");
    }
    Ok(())
}

fn write(template: &Template, folder: &Path, name: &str, checkout: &Path, python: bool) -> Result<()> {
    if folder.symlink_metadata().is_ok() {
        bail!(
            "{}: it is there already, and is not overwritten: choose another name",
            folder.display()
        );
    }
    let put = |file: &str, text: &str| -> Result<()> {
        let path = folder.join(file);
        let above = path.parent().unwrap_or(folder);
        fs::create_dir_all(above).wrap_err_with(|| format!("{}", above.display()))?;
        fs::write(&path, text).wrap_err_with(|| format!("{}", path.display()))
    };
    for (file, text) in template.files {
        let (file, text) = template.renamed(file, text, name, checkout);
        put(&file, &text)?;
    }
    if !python {
        // The versions that realo was tested with.
        let lock = checkout.join("Cargo.lock");
        let text = fs::read_to_string(&lock).wrap_err_with(|| format!("{}", lock.display()))?;
        put("Cargo.lock", &text)?;
    }
    Ok(())
}

/// How to test and how to run it.
fn commands(template: &Template, folder: &Path, name: &str, checkout: &Path, python: bool) -> [String; 2] {
    let (folder, checkout, places) = (folder.display(), checkout.display(), template.places);
    let run = |program: &str| {
        let realo = called();
        format!("{realo} run late_fusion --mode virtual --replace {places}=\"program {program}\"")
    };
    if python {
        let module = name.replace('-', "_");
        return [
            format!(
                "PYTHONPATH={checkout}/python {} -m unittest discover -s {folder}",
                realo_host::python()
            ),
            run(&format!("{folder}/{module}.py")),
        ];
    }
    [
        format!("cargo test --release --manifest-path {folder}/Cargo.toml"),
        format!(
            "cargo build --release --manifest-path {folder}/Cargo.toml && {}",
            run(&format!("{folder}/target/release/{name}"))
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_it_writes_is_the_example_under_another_name() {
        let folder = tempfile::tempdir().unwrap();
        let checkout = Path::new("/somewhere/realo");
        let lock = tempfile::tempdir().unwrap();
        fs::write(lock.path().join("Cargo.lock"), "# versions").unwrap();
        let rust = folder.path().join("my-fusion");
        write(&RUST_FUSION, &rust, "my-fusion", lock.path(), false).unwrap();
        let main = fs::read_to_string(rust.join("src/main.rs")).unwrap();
        assert!(main.contains("my_fusion::MyFusion"), "{main}");
        let (_, cargo) = RUST_FUSION.renamed("Cargo.toml", RUST_FUSION.files[0].1, "my-fusion", checkout);
        assert!(
            cargo.contains("path = \"/somewhere/realo/operators/operator\""),
            "{cargo}"
        );
        assert!(
            cargo.contains("name = \"my-fusion\"") && !cargo.contains("\"../"),
            "{cargo}"
        );
        let refused = write(&RUST_FUSION, &rust, "my-fusion", lock.path(), false).unwrap_err();
        assert!(refused.to_string().contains("is not overwritten"), "{refused}");
        for template in [&PYTHON_FUSION, &PYTHON_DETECTOR] {
            let (file, test) = template.renamed(template.files[1].0, template.files[1].1, "my-own", checkout);
            assert_eq!(file, "test_my_own.py");
            assert!(
                test.contains("from my_own import MyOwn") && !test.contains(template.class),
                "{test}"
            );
        }
        // The names of the examples are in their own files only, so that renaming leaves nothing behind.
        for template in [&RUST_FUSION, &PYTHON_FUSION, &PYTHON_DETECTOR] {
            for (file, text) in template.files {
                let (_, text) = template.renamed(file, text, "own", checkout);
                let left = [template.name, template.module, template.class];
                assert!(left.iter().all(|name| !text.contains(name)), "{file}");
            }
        }
    }

    #[test]
    fn a_name_is_one_of_a_crate_and_of_a_module() {
        for good in ["fusion", "my-fusion", "wbf_2"] {
            check_name(good).unwrap();
        }
        for bad in ["", "My", "2d", "a b", "a.py", "test", "ä"] {
            assert!(check_name(bad).is_err(), "{bad}");
        }
    }
}

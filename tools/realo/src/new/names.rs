//! Names that a plug-in cannot have, because its language or its code has them.

use eyre::{Result, bail};

/// Modules of Python's standard library (`sys.stdlib_module_names`, Python 3.11).
const PYTHON_MODULES: &str = "\
    abc aifc antigravity argparse array ast asynchat asyncio asyncore atexit audioop base64 bdb binascii bisect builtins \
    bz2 calendar cgi cgitb chunk cmath cmd code codecs codeop collections colorsys compileall concurrent configparser \
    contextlib contextvars copy copyreg crypt csv ctypes curses dataclasses datetime dbm decimal difflib dis distutils \
    doctest email encodings ensurepip enum errno faulthandler fcntl filecmp fileinput fnmatch fractions ftplib functools \
    gc genericpath getopt getpass gettext glob graphlib grp gzip hashlib heapq hmac html http idlelib imaplib imghdr imp \
    importlib inspect io ipaddress itertools json keyword lib2to3 linecache locale logging lzma mailbox mailcap marshal \
    math mimetypes mmap modulefinder msilib msvcrt multiprocessing netrc nis nntplib nt ntpath nturl2path numbers opcode \
    operator optparse os ossaudiodev pathlib pdb pickle pickletools pipes pkgutil platform plistlib poplib posix posixpath \
    pprint profile pstats pty pwd py_compile pyclbr pydoc pydoc_data pyexpat queue quopri random re readline reprlib \
    resource rlcompleter runpy sched secrets select selectors shelve shlex shutil signal site smtpd smtplib sndhdr socket \
    socketserver spwd sqlite3 sre_compile sre_constants sre_parse ssl stat statistics string stringprep struct subprocess \
    sunau symtable sys sysconfig syslog tabnanny tarfile telnetlib tempfile termios textwrap this threading time timeit \
    tkinter token tokenize tomllib trace traceback tracemalloc tty turtle turtledemo types typing unicodedata unittest \
    urllib uu uuid venv warnings wave weakref webbrowser winreg winsound wsgiref xdrlib xml xmlrpc zipapp zipfile \
    zipimport zlib zoneinfo";
/// Words of Python.
const PYTHON_WORDS: &str = "\
    and as assert async await break class continue def del elif else except finally for from global if import in is lambda \
    nonlocal not or pass raise return try while with yield";
/// Classes that would be words of Python.
const PYTHON_CLASSES: &str = "False None True";
/// Words of Rust.
const RUST_WORDS: &str = "\
    abstract as async await become box break const continue crate do dyn else enum extern false final fn for gen if impl \
    in let loop macro match mod move mut override priv pub ref return self static struct super trait true try type typeof \
    unsafe unsized use virtual where while yield";

/// Refuses a module or a class that would hide something else, or that cannot be named; `texts` are the code.
///
/// # Errors
/// What has the name.
pub fn check<'a>(module: &str, class: &str, is_python: bool, texts: impl IntoIterator<Item = &'a str>) -> Result<()> {
    let has = |words: &str, name: &str| words.split_whitespace().any(|word| word == name);
    let owner = match is_python {
        true if has(PYTHON_MODULES, module) => "a module of Python's standard library, which it would hide",
        true if has(PYTHON_WORDS, module) || has(PYTHON_CLASSES, class) => "a word of Python",
        false if has(RUST_WORDS, module) => "a word of Rust",
        _ => "",
    };
    if !owner.is_empty() {
        bail!("expected a name that is free, found `{module}`, {owner}: choose another");
    }
    let is_prose = |line: &&str| {
        ["//", "#", "\"\"\""]
            .iter()
            .any(|begin| line.trim_start().starts_with(begin))
    };
    let lines = texts.into_iter().flat_map(str::lines).filter(|line| !is_prose(line));
    let mut words = lines.flat_map(|line| line.split(|c: char| !c.is_alphanumeric() && c != '_'));
    if words.any(|word| word == class) {
        bail!(
            "expected a name that is free, found `{module}`: its class would be `{class}`, a name that the plug-in's code uses: \
             choose another"
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_the_language_are_refused() {
        let said = |module, class, is_python| {
            let checked = check(module, class, is_python, ["from realo import Boxes, run"]);
            checked.err().map(|error| error.to_string()).unwrap_or_default()
        };
        for (module, class) in [("json", "Json"), ("random", "Random"), ("queue", "Queue")] {
            let said = said(module, class, true);
            assert!(said.contains(&format!("`{module}`, a module of Python's")), "{said}");
        }
        for (module, class) in [("class", "Class"), ("async", "Async"), ("none", "None")] {
            assert!(said(module, class, true).contains("a word of Python"), "{module}");
        }
        assert!(said("match", "Match", false).contains("a word of Rust"));
        assert!(said("boxes", "Boxes", true).contains("`Boxes`, a name that the plug-in's code uses"));
        for (module, class, is_python) in [("my_fusion", "MyFusion", true), ("json", "Json", false)] {
            assert_eq!(said(module, class, is_python), "");
        }
    }
}

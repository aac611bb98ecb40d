//! The format of `torch.save` before PyTorch 1.6: five pickles (a number that marks it, its version, the machine, the object,
//! the names of the storages), then each storage: how many numbers it has, as i64, and the numbers. All is little-endian.

use std::collections::HashMap;
use std::io::{Read, Seek};

use crate::checkpoint::Problem;
use crate::pickle::{Pickle, Value, entry};

/// Where the numbers of each storage begin, bytes from the file's start.
pub(crate) type Places = HashMap<String, u64>;

/// What the first pickle is.
const MAGIC: i128 = 0x1950_a86a_20f9_469c_fc6c;
const VERSION: i128 = 1001;

/// The object of a file, and where its storages are.
pub(crate) fn read(file: &mut (impl Read + Seek)) -> Result<(Pickle, Places), Problem> {
    if !matches!(Pickle::parse(&mut *file)?.root, Value::Int(MAGIC)) {
        return Err(Problem::Unknown(
            "a pickle of something else; save a state dict: torch.save(model.state_dict(), FILE)",
        ));
    }
    if !matches!(Pickle::parse(&mut *file)?.root, Value::Int(VERSION)) {
        return Err(Problem::Legacy("its version is not 1001"));
    }
    let machine = Pickle::parse(&mut *file)?;
    let about = machine.dict(&machine.root).unwrap_or_default();
    if !matches!(entry(about, "little_endian"), Some(Value::Bool(true))) {
        return Err(Problem::ByteOrder);
    }
    let pickle = Pickle::parse(&mut *file)?;
    let names = Pickle::parse(&mut *file)?;
    let places = places(file, &pickle, &names)?;
    Ok((pickle, places))
}

/// From the end of the pickles on.
fn places(file: &mut (impl Read + Seek), pickle: &Pickle, names: &Pickle) -> Result<Places, Problem> {
    let known: HashMap<&str, (usize, usize)> = pickle
        .storages()
        .map(|storage| (&*storage.key, (storage.count, storage.dtype.size())))
        .collect();
    let names = names.list(&names.root);
    let names = names.ok_or(Problem::Legacy("the names of its storages are no list"))?;
    let mut places = Places::new();
    for name in names {
        let Value::Text(name) = name else {
            return Err(Problem::Legacy("the name of a storage is no text"));
        };
        let (expected, size) = *known
            .get(&**name)
            .ok_or(Problem::Legacy("a storage that no tensor lies in"))?;
        let mut count = [0; 8];
        file.read_exact(&mut count)?;
        if i64::from_le_bytes(count) != expected as i64 {
            return Err(Problem::Legacy("a storage of another length than its tensors say"));
        }
        let place = file.stream_position()?;
        let bytes = i64::try_from(expected)
            .ok()
            .and_then(|count| count.checked_mul(size as i64));
        // Whether so many are there is seen when they are read.
        file.seek_relative(bytes.ok_or(Problem::Legacy("a storage longer than any file"))?)?;
        if places.insert(name.to_string(), place).is_some() {
            return Err(Problem::Legacy("a storage is there twice"));
        }
    }
    Ok(places)
}

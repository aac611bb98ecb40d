//! The instructions of Python's pickle that `torch.save` writes, parsed into plain data.
//!
//! Nothing is called: a name outside of [`Global`] is an error, a known one stands for what it would make. Objects lie in
//! one list and name each other by their place in it, so that neither depth nor cycles can exhaust the stack.

mod building;
mod global;
mod machine;
mod reading;

use std::io::{self, Read};
use std::rc::Rc;

use crate::shown;
use crate::view::{Storage, View, ViewError};
pub(crate) use global::Global;
use machine::{Machine, number};

/// Bytes of a pickle, at most; those of the reference's networks with their optimizer have some 200 KB.
pub(crate) const MOST_BYTES: u64 = 1 << 24;
/// Instructions of a pickle, at most; what is kept of each is bounded.
const MOST_STEPS: u64 = 1 << 20;
/// Bytes of a text, at most: names are short, and whole configurations stand beside weights.
const MOST_TEXT: usize = 1 << 20;

/// A value of a pickle.
#[derive(Clone, Debug)]
pub(crate) enum Value {
    None,
    Bool(bool),
    Int(i128),
    Float,
    Text(Rc<str>),
    Global(Global),
    /// Its place among the objects.
    Object(usize),
}

/// What values may consist of.
#[derive(Debug)]
pub(crate) enum Object {
    Tuple(Vec<Value>),
    List(Vec<Value>),
    Dict(Vec<(Value, Value)>),
    Storage(Storage),
    Tensor(View),
    /// What a name that is skipped would make.
    Skipped,
}

/// Why a pickle was not read.
#[derive(Debug, thiserror::Error)]
pub enum PickleError {
    /// The file ends, or cannot be read.
    #[error("its pickle breaks off at byte {at}: {error}; take a whole copy of the file")]
    Io {
        /// Bytes before it.
        at: u64,
        /// What failed.
        error: io::Error,
    },
    /// It names something that no state dict needs.
    #[error(
        "its pickle asks for `{0}`, which no state dict needs; nothing of it was run. If the file is yours, save the state \
         dict alone: torch.save(model.state_dict(), FILE)"
    )]
    Global(String),
    /// An instruction that `torch.save` does not write.
    #[error("its pickle has instruction 0x{code:02x} at byte {at}, which torch.save does not write in protocol 2")]
    Instruction {
        /// The instruction.
        code: u8,
        /// Bytes before it.
        at: u64,
    },
    /// Instructions that do not go together.
    #[error("its pickle makes no sense at byte {at}: {what}")]
    Nonsense {
        /// Bytes before it.
        at: u64,
        /// What is wrong.
        what: &'static str,
    },
    /// A tensor that its storage cannot hold.
    #[error("a tensor of its pickle, at byte {at}: {error}")]
    View {
        /// Bytes before it.
        at: u64,
        /// What is wrong.
        error: ViewError,
    },
    /// More than any checkpoint has.
    #[error(
        "its pickle is longer than {MOST_STEPS} instructions or {MOST_BYTES} bytes, more than any state dict needs"
    )]
    Long,
}

/// What a pickle says.
#[derive(Debug)]
pub(crate) struct Pickle {
    pub root: Value,
    objects: Vec<Object>,
}

impl Pickle {
    /// Parses a pickle up to its end, and no byte further.
    pub fn parse(from: impl Read) -> Result<Pickle, PickleError> {
        let mut machine = Machine::new(from);
        let root = machine.run()?;
        Ok(Pickle {
            root,
            objects: machine.objects,
        })
    }

    /// The object of a value that is one.
    pub fn object(&self, value: &Value) -> Option<&Object> {
        match value {
            Value::Object(place) => Some(&self.objects[*place]),
            _ => None,
        }
    }

    /// The entries of a value that is a dict.
    pub fn dict(&self, value: &Value) -> Option<&[(Value, Value)]> {
        match self.object(value)? {
            Object::Dict(entries) => Some(entries),
            _ => None,
        }
    }

    /// The elements of a value that is a list.
    pub fn list(&self, value: &Value) -> Option<&[Value]> {
        match self.object(value)? {
            Object::List(elements) => Some(elements),
            _ => None,
        }
    }

    /// The tensor that a value is.
    pub fn tensor(&self, value: &Value) -> Option<&View> {
        match self.object(value)? {
            Object::Tensor(view) => Some(view),
            _ => None,
        }
    }

    /// The storages that tensors lie in.
    pub fn storages(&self) -> impl Iterator<Item = &Storage> {
        self.objects.iter().filter_map(|object| match object {
            Object::Storage(storage) => Some(storage),
            _ => None,
        })
    }
}

/// An entry of a dict by its key, the last one as in Python.
pub(crate) fn entry<'a>(dict: &'a [(Value, Value)], name: &str) -> Option<&'a Value> {
    let is_it = |(key, _): &&(Value, Value)| matches!(key, Value::Text(text) if **text == *name);
    dict.iter().rev().find(is_it).map(|(_, value)| value)
}

impl<R: Read> Machine<R> {
    fn global(&mut self) -> Result<Global, PickleError> {
        let (module, name) = (self.line()?, self.line()?);
        Global::named(&module, &name).ok_or_else(|| PickleError::Global(shown(&format!("{module}.{name}"))))
    }

    /// What a known name would make of its arguments.
    fn reduce(&mut self) -> Result<(), PickleError> {
        let (arguments, callee) = (self.pop()?, self.pop()?);
        if matches!(callee, Value::Global(Global::Skipped)) {
            self.push(Object::Skipped);
            return Ok(());
        }
        let Some(arguments) = self.elements(&arguments) else {
            return Err(self.nonsense("arguments that are no tuple"));
        };
        let made = match (callee, arguments) {
            (Value::Global(Global::Dict), []) => None,
            // A copy of a dict: the dict itself will do, since nothing is changed any more.
            (Value::Global(Global::Dict), [Value::Object(place)])
                if matches!(self.objects[*place], Object::Dict(_)) =>
            {
                self.stack.push(Value::Object(*place));
                return Ok(());
            }
            (Value::Global(Global::Tensor), [storage, offset, sizes, strides, ..]) => {
                Some(self.tensor(storage, offset, sizes, strides)?)
            }
            (Value::Global(Global::Parameter), [Value::Object(place), ..])
                if matches!(self.objects[*place], Object::Tensor(_)) =>
            {
                self.stack.push(Value::Object(*place));
                return Ok(());
            }
            _ => return Err(self.nonsense("a name of torch with arguments that do not belong to it")),
        };
        self.push(made.map_or_else(|| Object::Dict(Vec::new()), Object::Tensor));
        Ok(())
    }

    /// An object of a class, which only what is skipped has here.
    fn new_object(&mut self) -> Result<(), PickleError> {
        match (self.pop()?, self.pop()?) {
            (_, Value::Global(Global::Skipped)) => self.push(Object::Skipped),
            _ => return Err(self.nonsense("an object of what no state dict needs")),
        }
        Ok(())
    }

    fn tensor(&self, storage: &Value, offset: &Value, sizes: &Value, strides: &Value) -> Result<View, PickleError> {
        let storage = match storage {
            Value::Object(place) => match &self.objects[*place] {
                Object::Storage(storage) => Some(storage.clone()),
                _ => None,
            },
            _ => None,
        };
        let numbers = |value: &Value| self.elements(value)?.iter().map(number).collect::<Option<Vec<usize>>>();
        let (Some(storage), Some(offset), Some(sizes), Some(strides)) =
            (storage, number(offset), numbers(sizes), numbers(strides))
        else {
            return Err(self.nonsense("a tensor without storage, offset, sizes or strides"));
        };
        View::new(storage, offset, sizes, strides).map_err(|error| PickleError::View { at: self.at, error })
    }

    /// Sets attributes of an object, of which none matter here (`_metadata` of a state dict).
    fn build(&mut self) -> Result<(), PickleError> {
        self.pop()?;
        match self.top()? {
            Object::Dict(_) | Object::Skipped => Ok(()),
            _ => Err(self.nonsense("attributes of what has none")),
        }
    }

    /// A storage by what the pickle says of it; a view of another storage is nothing that is written any more.
    fn storage(&mut self) -> Result<(), PickleError> {
        let id = self.pop()?;
        let storage = match self.elements(&id) {
            Some(
                [
                    Value::Text(kind),
                    Value::Global(Global::Storage(dtype)),
                    Value::Text(key),
                    Value::Text(_),
                    count,
                    rest @ ..,
                ],
            ) if **kind == *"storage" && matches!(rest, [] | [Value::None]) => number(count).map(|count| Storage {
                key: key.clone(),
                dtype: *dtype,
                count,
            }),
            _ => None,
        };
        let storage = storage.ok_or_else(|| self.nonsense("a storage that is not declared as torch.save does"))?;
        self.push(Object::Storage(storage));
        Ok(())
    }
}

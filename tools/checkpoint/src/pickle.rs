//! The instructions of Python's pickle that `torch.save` writes, parsed into plain data.
//!
//! Nothing is called: a name outside of [`Global`] is an error, a known one stands for what it would make. Objects lie in
//! one list and name each other by their place in it, so that neither depth nor cycles can exhaust the stack.

use std::collections::HashMap;
use std::io::{self, Read};
use std::rc::Rc;

use crate::dtype::Dtype;
use crate::shown;
use crate::view::{Storage, View, ViewError};

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

/// The names that a checkpoint may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Global {
    /// `collections.OrderedDict`, and `collections.Counter` of a learning-rate schedule.
    Dict,
    /// `torch._utils._rebuild_tensor_v2`.
    Tensor,
    /// `torch._utils._rebuild_parameter`.
    Parameter,
    /// A storage class.
    Storage(Dtype),
    /// A name of what scripts save beside weights. Nothing of it is run, and what it would make is skipped.
    Skipped,
}

/// What makes plain data that stands beside weights: whole modules, and names of others.
const SKIPPED_MODULES: [&str; 13] = [
    "numpy",
    "datetime",
    "pathlib",
    "decimal",
    "fractions",
    "omegaconf",
    "easydict",
    "yacs",
    "addict",
    "munch",
    "pytorch_lightning",
    "lightning",
    "lightning_fabric",
];
const SKIPPED: [(&str, &[&str]); 8] = [
    ("argparse", &["Namespace"]),
    ("types", &["SimpleNamespace"]),
    ("collections", &["defaultdict", "deque"]),
    ("_codecs", &["encode"]),
    ("copyreg", &["_reconstructor"]),
    ("copy_reg", &["_reconstructor"]),
    ("typing", &["Any"]),
    (
        "torch",
        &[
            "Size", "device", "float16", "float32", "float64", "bfloat16", "int8", "uint8", "int32", "int64", "bool",
        ],
    ),
];
const SKIPPED_BUILTINS: [&str; 14] = [
    "set",
    "frozenset",
    "bytearray",
    "complex",
    "slice",
    "range",
    "object",
    "list",
    "dict",
    "tuple",
    "int",
    "float",
    "str",
    "bool",
];

impl Global {
    fn named(module: &str, name: &str) -> Option<Global> {
        match (module, name) {
            ("collections", "OrderedDict" | "Counter") => Some(Global::Dict),
            ("torch._utils", "_rebuild_tensor_v2") => Some(Global::Tensor),
            ("torch._utils", "_rebuild_parameter") => Some(Global::Parameter),
            ("torch", class) if Dtype::of_storage(class).is_some() => Dtype::of_storage(class).map(Global::Storage),
            _ => Self::is_skipped(module, name).then_some(Global::Skipped),
        }
    }

    fn is_skipped(module: &str, name: &str) -> bool {
        let top = module.split('.').next().unwrap_or_default();
        match module {
            "builtins" | "__builtin__" => SKIPPED_BUILTINS.contains(&name),
            _ => {
                let named = |(known, names): &(&str, &[&str])| *known == module && names.contains(&name);
                SKIPPED_MODULES.contains(&top) || SKIPPED.iter().any(named)
            }
        }
    }
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

/// The machine that a pickle is written for.
struct Machine<R> {
    from: R,
    at: u64,
    objects: Vec<Object>,
    stack: Vec<Value>,
    marks: Vec<usize>,
    memo: HashMap<u32, Value>,
}

/// The instructions, by Python's names for them.
mod code {
    pub const PROTO: u8 = 0x80;
    pub const STOP: u8 = b'.';
    pub const MARK: u8 = b'(';
    pub const NONE: u8 = b'N';
    pub const NEWTRUE: u8 = 0x88;
    pub const NEWFALSE: u8 = 0x89;
    pub const BININT: u8 = b'J';
    pub const BININT1: u8 = b'K';
    pub const BININT2: u8 = b'M';
    pub const LONG1: u8 = 0x8a;
    pub const BINFLOAT: u8 = b'G';
    pub const BINUNICODE: u8 = b'X';
    pub const EMPTY_DICT: u8 = b'}';
    pub const EMPTY_LIST: u8 = b']';
    pub const EMPTY_TUPLE: u8 = b')';
    pub const TUPLE: u8 = b't';
    pub const TUPLE1: u8 = 0x85;
    pub const TUPLE2: u8 = 0x86;
    pub const TUPLE3: u8 = 0x87;
    pub const APPEND: u8 = b'a';
    pub const APPENDS: u8 = b'e';
    pub const SETITEM: u8 = b's';
    pub const SETITEMS: u8 = b'u';
    pub const BINPUT: u8 = b'q';
    pub const LONG_BINPUT: u8 = b'r';
    pub const BINGET: u8 = b'h';
    pub const LONG_BINGET: u8 = b'j';
    pub const GLOBAL: u8 = b'c';
    pub const REDUCE: u8 = b'R';
    pub const NEWOBJ: u8 = 0x81;
    pub const BUILD: u8 = b'b';
    pub const BINPERSID: u8 = b'Q';
}

impl<R: Read> Machine<R> {
    fn new(from: R) -> Self {
        Machine {
            from,
            at: 0,
            objects: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
        }
    }

    fn run(&mut self) -> Result<Value, PickleError> {
        for _ in 0..MOST_STEPS {
            let instruction = self.byte()?;
            if instruction == code::STOP {
                return self.pop();
            }
            self.step(instruction)?;
        }
        Err(PickleError::Long)
    }

    fn step(&mut self, instruction: u8) -> Result<(), PickleError> {
        match instruction {
            code::PROTO => return self.protocol(),
            code::MARK => self.marks.push(self.stack.len()),
            code::NONE => self.stack.push(Value::None),
            code::NEWTRUE => self.stack.push(Value::Bool(true)),
            code::NEWFALSE => self.stack.push(Value::Bool(false)),
            code::BININT => {
                let number = i32::from_le_bytes(self.bytes()?);
                self.stack.push(Value::Int(number.into()));
            }
            code::BININT1 => {
                let number = self.byte()?;
                self.stack.push(Value::Int(number.into()));
            }
            code::BININT2 => {
                let number = u16::from_le_bytes(self.bytes()?);
                self.stack.push(Value::Int(number.into()));
            }
            code::LONG1 => {
                let number = self.long()?;
                self.stack.push(Value::Int(number));
            }
            code::BINFLOAT => {
                self.bytes::<8>()?;
                self.stack.push(Value::Float);
            }
            code::BINUNICODE => {
                let text = self.unicode()?;
                self.stack.push(Value::Text(text));
            }
            code::EMPTY_DICT => self.push(Object::Dict(Vec::new())),
            code::EMPTY_LIST => self.push(Object::List(Vec::new())),
            code::EMPTY_TUPLE => self.push(Object::Tuple(Vec::new())),
            code::TUPLE => {
                let elements = self.marked()?;
                self.push(Object::Tuple(elements));
            }
            code::TUPLE1 => self.tuple::<1>()?,
            code::TUPLE2 => self.tuple::<2>()?,
            code::TUPLE3 => self.tuple::<3>()?,
            code::APPEND => {
                let element = self.pop()?;
                self.append(vec![element])?;
            }
            code::APPENDS => {
                let elements = self.marked()?;
                self.append(elements)?;
            }
            code::SETITEM => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set(vec![key, value])?;
            }
            code::SETITEMS => {
                let entries = self.marked()?;
                self.set(entries)?;
            }
            code::BINPUT => {
                let place = self.byte()?;
                self.put(place.into())?;
            }
            code::LONG_BINPUT => {
                let place = u32::from_le_bytes(self.bytes()?);
                self.put(place)?;
            }
            code::BINGET => {
                let place = self.byte()?;
                self.get(place.into())?;
            }
            code::LONG_BINGET => {
                let place = u32::from_le_bytes(self.bytes()?);
                self.get(place)?;
            }
            code::GLOBAL => {
                let global = self.global()?;
                self.stack.push(Value::Global(global));
            }
            code::REDUCE => return self.reduce(),
            code::NEWOBJ => return self.new_object(),
            code::BUILD => return self.build(),
            code::BINPERSID => return self.storage(),
            code => {
                let at = self.at - 1;
                return Err(PickleError::Instruction { code, at });
            }
        }
        Ok(())
    }

    fn protocol(&mut self) -> Result<(), PickleError> {
        match self.byte()? {
            2 => Ok(()),
            _ => {
                Err(self
                    .nonsense("its protocol is not 2, the one that torch.save writes unless it is reported another"))
            }
        }
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
        let mut bytes = [0; N];
        if self.at + N as u64 > MOST_BYTES {
            return Err(PickleError::Long);
        }
        let at = self.at;
        self.from
            .read_exact(&mut bytes)
            .map_err(|error| PickleError::Io { at, error })?;
        self.at += N as u64;
        Ok(bytes)
    }

    fn byte(&mut self) -> Result<u8, PickleError> {
        let [byte] = self.bytes()?;
        Ok(byte)
    }

    fn long(&mut self) -> Result<i128, PickleError> {
        let length = usize::from(self.byte()?);
        let mut bytes = [0; 16];
        if length > bytes.len() {
            return Err(self.nonsense("an integer of more than 16 bytes"));
        }
        for byte in &mut bytes[..length] {
            *byte = self.byte()?;
        }
        let unused = 8 * (bytes.len() - length) as u32;
        // The highest bit that is there is the sign.
        Ok(i128::from_le_bytes(bytes)
            .checked_shl(unused)
            .map_or(0, |number| number >> unused))
    }

    fn unicode(&mut self) -> Result<Rc<str>, PickleError> {
        let length = u32::from_le_bytes(self.bytes()?) as usize;
        if length > MOST_TEXT {
            return Err(self.nonsense("a text longer than any name"));
        }
        // Memory is taken for what comes.
        let mut bytes = Vec::new();
        for _ in 0..length {
            bytes.push(self.byte()?);
        }
        let text = String::from_utf8(bytes).map_err(|_| self.nonsense("a text that is not UTF-8"))?;
        Ok(text.into())
    }

    /// A line without its end.
    fn line(&mut self) -> Result<String, PickleError> {
        let mut line = Vec::new();
        loop {
            match self.byte()? {
                b'\n' => break,
                _ if line.len() == 256 => return Err(self.nonsense("a name without end")),
                byte => line.push(byte),
            }
        }
        String::from_utf8(line).map_err(|_| self.nonsense("a name that is not UTF-8"))
    }

    fn global(&mut self) -> Result<Global, PickleError> {
        let (module, name) = (self.line()?, self.line()?);
        Global::named(&module, &name).ok_or_else(|| PickleError::Global(shown(&format!("{module}.{name}"))))
    }

    fn push(&mut self, object: Object) {
        self.stack.push(Value::Object(self.objects.len()));
        self.objects.push(object);
    }

    fn pop(&mut self) -> Result<Value, PickleError> {
        let bottom = self.marks.last().copied().unwrap_or(0);
        match self.stack.len() > bottom {
            true => Ok(self.stack.pop().expect("it is not empty")),
            false => Err(self.nonsense("there is no value")),
        }
    }

    /// All values above the last mark.
    fn marked(&mut self) -> Result<Vec<Value>, PickleError> {
        let mark = self.marks.pop().ok_or_else(|| self.nonsense("there is no mark"))?;
        Ok(self.stack.split_off(mark))
    }

    fn tuple<const N: usize>(&mut self) -> Result<(), PickleError> {
        let mut elements = Vec::with_capacity(N);
        for _ in 0..N {
            elements.push(self.pop()?);
        }
        elements.reverse();
        self.push(Object::Tuple(elements));
        Ok(())
    }

    /// The object on top of the stack, which stays there.
    fn top(&mut self) -> Result<&mut Object, PickleError> {
        let value = self.pop()?;
        self.stack.push(value.clone());
        let Value::Object(place) = value else {
            return Err(self.nonsense("there is no list and no dict"));
        };
        Ok(&mut self.objects[place])
    }

    fn append(&mut self, elements: Vec<Value>) -> Result<(), PickleError> {
        match self.top()? {
            Object::List(list) => list.extend(elements),
            Object::Skipped => {}
            _ => return Err(self.nonsense("there is no list")),
        }
        Ok(())
    }

    fn set(&mut self, entries: Vec<Value>) -> Result<(), PickleError> {
        if !entries.len().is_multiple_of(2) {
            return Err(self.nonsense("a key without a value"));
        }
        let mut entries = entries.into_iter();
        let pairs = std::iter::from_fn(|| entries.next().zip(entries.next()));
        match self.top()? {
            Object::Dict(dict) => dict.extend(pairs),
            Object::Skipped => {}
            _ => return Err(self.nonsense("there is no dict")),
        }
        Ok(())
    }

    fn put(&mut self, place: u32) -> Result<(), PickleError> {
        let value = self.pop()?;
        self.stack.push(value.clone());
        self.memo.insert(place, value);
        Ok(())
    }

    fn get(&mut self, place: u32) -> Result<(), PickleError> {
        let value = self.memo.get(&place).cloned();
        let value = value.ok_or_else(|| self.nonsense("a value that was not kept is asked for"))?;
        self.stack.push(value);
        Ok(())
    }

    fn elements(&self, value: &Value) -> Option<&[Value]> {
        match value {
            Value::Object(place) => match &self.objects[*place] {
                Object::Tuple(elements) => Some(elements),
                _ => None,
            },
            _ => None,
        }
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
        let storage = storage.ok_or_else(|| self.nonsense("a storage that is not reported as torch.save does"))?;
        self.push(Object::Storage(storage));
        Ok(())
    }

    fn nonsense(&self, what: &'static str) -> PickleError {
        PickleError::Nonsense { at: self.at, what }
    }
}

fn number(value: &Value) -> Option<usize> {
    match value {
        Value::Int(number) => usize::try_from(*number).ok(),
        _ => None,
    }
}

//! The machine that reads a pickle.

use std::collections::HashMap;
use std::io::Read;

use super::{MOST_STEPS, Object, PickleError, Value};

/// The machine that a pickle is written for.
pub(super) struct Machine<R> {
    pub from: R,
    pub at: u64,
    pub objects: Vec<Object>,
    pub stack: Vec<Value>,
    pub marks: Vec<usize>,
    pub memo: HashMap<u32, Value>,
}

/// The instructions, by Python's names for them.
pub(super) mod code {
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
    pub(super) fn new(from: R) -> Self {
        Machine {
            from,
            at: 0,
            objects: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
        }
    }

    pub(super) fn run(&mut self) -> Result<Value, PickleError> {
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
            code::PROTO => self.protocol(),
            code::REDUCE => self.reduce(),
            code::NEWOBJ => self.new_object(),
            code::BUILD => self.build(),
            code::BINPERSID => self.storage(),
            code::APPEND | code::APPENDS | code::SETITEM | code::SETITEMS => self.fill(instruction),
            code::BINPUT | code::LONG_BINPUT | code::BINGET | code::LONG_BINGET => self.remember(instruction),
            code::MARK | code::EMPTY_DICT | code::EMPTY_LIST | code::EMPTY_TUPLE => self.begin(instruction),
            code::TUPLE | code::TUPLE1 | code::TUPLE2 | code::TUPLE3 => self.close_tuple(instruction),
            _ => {
                let value = self.literal(instruction)?;
                self.stack.push(value);
                Ok(())
            }
        }
    }

    /// A value that an instruction says itself.
    fn literal(&mut self, instruction: u8) -> Result<Value, PickleError> {
        Ok(match instruction {
            code::NONE => Value::None,
            code::NEWTRUE => Value::Bool(true),
            code::NEWFALSE => Value::Bool(false),
            code::BININT => Value::Int(i32::from_le_bytes(self.bytes()?).into()),
            code::BININT1 => Value::Int(self.byte()?.into()),
            code::BININT2 => Value::Int(u16::from_le_bytes(self.bytes()?).into()),
            code::LONG1 => Value::Int(self.long()?),
            code::BINFLOAT => {
                self.bytes::<8>()?;
                Value::Float
            }
            code::BINUNICODE => Value::Text(self.unicode()?),
            code::GLOBAL => Value::Global(self.global()?),
            code => {
                let at = self.at - 1;
                return Err(PickleError::Instruction { code, at });
            }
        })
    }

    /// Marks a place, or begins an object.
    fn begin(&mut self, instruction: u8) -> Result<(), PickleError> {
        match instruction {
            code::MARK => self.marks.push(self.stack.len()),
            code::EMPTY_DICT => self.push(Object::Dict(Vec::new())),
            code::EMPTY_LIST => self.push(Object::List(Vec::new())),
            _ => self.push(Object::Tuple(Vec::new())),
        }
        Ok(())
    }

    fn close_tuple(&mut self, instruction: u8) -> Result<(), PickleError> {
        match instruction {
            code::TUPLE1 => self.tuple::<1>(),
            code::TUPLE2 => self.tuple::<2>(),
            code::TUPLE3 => self.tuple::<3>(),
            _ => {
                let elements = self.marked()?;
                self.push(Object::Tuple(elements));
                Ok(())
            }
        }
    }

    /// Puts values into the object on top.
    fn fill(&mut self, instruction: u8) -> Result<(), PickleError> {
        match instruction {
            code::APPEND => {
                let element = self.pop()?;
                self.append(vec![element])
            }
            code::APPENDS => {
                let elements = self.marked()?;
                self.append(elements)
            }
            code::SETITEM => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set(vec![key, value])
            }
            _ => {
                let entries = self.marked()?;
                self.set(entries)
            }
        }
    }

    /// Remembers the value on top, or fetches one.
    fn remember(&mut self, instruction: u8) -> Result<(), PickleError> {
        let place = match instruction {
            code::BINPUT | code::BINGET => self.byte()?.into(),
            _ => u32::from_le_bytes(self.bytes()?),
        };
        match instruction {
            code::BINPUT | code::LONG_BINPUT => self.put(place),
            _ => self.get(place),
        }
    }

    pub(super) fn push(&mut self, object: Object) {
        self.stack.push(Value::Object(self.objects.len()));
        self.objects.push(object);
    }

    pub(super) fn pop(&mut self) -> Result<Value, PickleError> {
        let bottom = self.marks.last().copied().unwrap_or(0);
        match self.stack.len() > bottom {
            true => Ok(self.stack.pop().expect("it is not empty")),
            false => Err(self.nonsense("there is no value")),
        }
    }

    /// The object on top of the stack, which stays there.
    pub(super) fn top(&mut self) -> Result<&mut Object, PickleError> {
        let value = self.pop()?;
        self.stack.push(value.clone());
        let Value::Object(place) = value else {
            return Err(self.nonsense("there is no list and no dict"));
        };
        Ok(&mut self.objects[place])
    }

    pub(super) fn elements(&self, value: &Value) -> Option<&[Value]> {
        match value {
            Value::Object(place) => match &self.objects[*place] {
                Object::Tuple(elements) => Some(elements),
                _ => None,
            },
            _ => None,
        }
    }

    pub(super) fn nonsense(&self, what: &'static str) -> PickleError {
        PickleError::Nonsense { at: self.at, what }
    }
}

pub(super) fn number(value: &Value) -> Option<usize> {
    match value {
        Value::Int(number) => usize::try_from(*number).ok(),
        _ => None,
    }
}

//! Objects that a pickle puts together.

use std::io::Read;

use super::machine::Machine;
use super::{Object, PickleError, Value};

impl<R: Read> Machine<R> {
    /// All values above the last mark.
    pub(super) fn marked(&mut self) -> Result<Vec<Value>, PickleError> {
        let mark = self.marks.pop().ok_or_else(|| self.nonsense("there is no mark"))?;
        Ok(self.stack.split_off(mark))
    }

    pub(super) fn tuple<const N: usize>(&mut self) -> Result<(), PickleError> {
        let mut elements = Vec::with_capacity(N);
        for _ in 0..N {
            elements.push(self.pop()?);
        }
        elements.reverse();
        self.push(Object::Tuple(elements));
        Ok(())
    }

    pub(super) fn append(&mut self, elements: Vec<Value>) -> Result<(), PickleError> {
        match self.top()? {
            Object::List(list) => list.extend(elements),
            Object::Skipped => {}
            _ => return Err(self.nonsense("there is no list")),
        }
        Ok(())
    }

    pub(super) fn set(&mut self, entries: Vec<Value>) -> Result<(), PickleError> {
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

    pub(super) fn put(&mut self, place: u32) -> Result<(), PickleError> {
        let value = self.pop()?;
        self.stack.push(value.clone());
        self.memo.insert(place, value);
        Ok(())
    }

    pub(super) fn get(&mut self, place: u32) -> Result<(), PickleError> {
        let value = self.memo.get(&place).cloned();
        let value = value.ok_or_else(|| self.nonsense("a value that was not kept is asked for"))?;
        self.stack.push(value);
        Ok(())
    }
}

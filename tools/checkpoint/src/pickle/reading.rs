//! Operands as their bytes say them.

use std::io::Read;
use std::rc::Rc;

use super::machine::Machine;
use super::{MOST_BYTES, MOST_TEXT, PickleError};

impl<R: Read> Machine<R> {
    pub(super) fn protocol(&mut self) -> Result<(), PickleError> {
        match self.byte()? {
            2 => Ok(()),
            _ => {
                Err(self
                    .nonsense("its protocol is not 2, the one that torch.save writes unless it is asked for another"))
            }
        }
    }

    pub(super) fn bytes<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
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

    pub(super) fn byte(&mut self) -> Result<u8, PickleError> {
        let [byte] = self.bytes()?;
        Ok(byte)
    }

    pub(super) fn long(&mut self) -> Result<i128, PickleError> {
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

    pub(super) fn unicode(&mut self) -> Result<Rc<str>, PickleError> {
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
    pub(super) fn line(&mut self) -> Result<String, PickleError> {
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
}

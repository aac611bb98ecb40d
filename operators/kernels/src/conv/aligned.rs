//! Lists of numbers that begin at a line of the cache.

use std::ops::{Deref, DerefMut};

use super::element::Element;

/// Numbers that begin at a line of the cache, so that no register of them lies across two.
#[derive(Debug)]
pub(super) struct Aligned<E> {
    numbers: Vec<E>,
    start: usize,
}

impl<E: Element> Aligned<E> {
    /// None yet, with room for so many.
    pub fn with_capacity(count: usize) -> Self {
        const LINE: usize = 64;
        let mut numbers: Vec<E> = Vec::with_capacity(count + LINE);
        // Less than a line; filling up to `count` more does not move the list.
        let start = numbers.as_ptr().align_offset(LINE).min(LINE);
        numbers.resize(start, E::default());
        Aligned { numbers, start }
    }

    /// Adds numbers to those that it has; more than it was made for would move it.
    pub fn extend(&mut self, numbers: impl Iterator<Item = E>) {
        self.numbers.extend(numbers);
    }

    /// So many zeros.
    pub fn zeros(count: usize) -> Self {
        let mut zeros = Aligned::with_capacity(count);
        zeros.numbers.resize(zeros.start + count, E::default());
        zeros
    }
}

impl<E> Deref for Aligned<E> {
    type Target = [E];

    fn deref(&self) -> &[E] {
        &self.numbers[self.start..]
    }
}

impl<E> DerefMut for Aligned<E> {
    fn deref_mut(&mut self) -> &mut [E] {
        &mut self.numbers[self.start..]
    }
}

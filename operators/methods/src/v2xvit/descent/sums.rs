//! Sums of weights' gradients.

use std::collections::BTreeMap;

/// Gradients by the keys of what they are of; nothing is there that no gradient led to.
#[derive(Default)]
pub struct Sums(pub BTreeMap<String, Vec<f32>>);

impl Sums {
    /// The sum of a key, of so many numbers.
    pub fn of(&mut self, key: &str, length: usize) -> &mut [f32] {
        if !self.0.contains_key(key) {
            self.0.insert(key.into(), vec![0.0; length]);
        }
        self.0.get_mut(key).expect("a sum that was just made")
    }

    pub fn add(&mut self, key: &str, numbers: &[f32]) {
        let sums = self.of(key, numbers.len()).iter_mut().zip(numbers);
        sums.for_each(|(sum, number)| *sum += number);
    }

    /// Adds all sums of others.
    pub fn add_all(&mut self, others: Sums) {
        for (key, numbers) in others.0 {
            match self.0.contains_key(&key) {
                true => self.add(&key, &numbers),
                false => drop(self.0.insert(key, numbers)),
            }
        }
    }
}

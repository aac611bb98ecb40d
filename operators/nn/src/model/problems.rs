//! What does not fit together.

/// What was found wrong with a model, a line each.
#[derive(Debug, Default)]
pub struct Problems(pub(super) Vec<String>);

impl Problems {
    /// Notes a problem unless something holds.
    pub fn require(&mut self, holds: bool, problem: impl FnOnce() -> String) {
        if !holds {
            self.0.push(problem());
        }
    }

    /// Notes a number that is not between two, both included.
    pub fn within(&mut self, what: &str, found: usize, min: usize, most: usize) {
        self.require((min..=most).contains(&found), || {
            format!("{what}: expected {min} to {most}, found {found}")
        });
    }

    pub(super) fn each_within(&mut self, what: &str, found: &[usize], min: usize, most: usize) {
        for (index, found) in found.iter().enumerate() {
            self.within(&format!("{what}[{index}]"), *found, min, most);
        }
    }
}

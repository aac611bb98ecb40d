//! Parts that hang together.

/// Sets of numbers that grow together.
#[derive(Clone, Debug)]
pub(crate) struct Joined(Vec<usize>);

impl Joined {
    /// Each by itself.
    pub fn new(count: usize) -> Self {
        Joined((0..count).collect())
    }

    /// The smallest number of a set.
    pub fn first(&self, mut at: usize) -> usize {
        while self.0[at] != at {
            at = self.0[at];
        }
        at
    }

    /// Makes two sets one.
    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.first(a), self.first(b));
        self.0[a.max(b)] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_joined_has_one_first() {
        let mut joined = Joined::new(6);
        joined.join(4, 2);
        joined.join(5, 4);
        joined.join(1, 0);
        let firsts: Vec<usize> = (0..6).map(|at| joined.first(at)).collect();
        assert_eq!(firsts, [0, 0, 2, 3, 2, 2]);
    }
}

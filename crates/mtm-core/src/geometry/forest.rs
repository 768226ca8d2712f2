//! Disjoint sets (union-find with path halving): the smallest member of a set is its root.

/// The sets that members 0, 1, … form; each is one of its own at first.
#[derive(Default)]
pub(crate) struct Forest(Vec<u32>);

impl Forest {
    pub fn new(n: usize) -> Self {
        Self((0..n as u32).collect())
    }

    /// Adds members until there are `n`.
    pub fn grow(&mut self, n: usize) {
        self.0.extend(self.0.len() as u32..n as u32);
    }

    /// The smallest member of the set of `i`.
    fn root(&mut self, mut i: usize) -> usize {
        while self.0[i] as usize != i {
            self.0[i] = self.0[self.0[i] as usize];
            i = self.0[i] as usize;
        }
        i
    }

    /// Makes one set of those of `a` and `b`.
    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b) as u32;
    }

    /// Number of the set of each member, in the order of the smallest members.
    pub fn numbered(mut self) -> Vec<u32> {
        let (mut numbers, mut count) = (vec![0; self.0.len()], 0);
        for i in 0..numbers.len() {
            let root = self.root(i);
            if root == i {
                numbers[i] = count;
                count += 1;
            } else {
                numbers[i] = numbers[root];
            }
        }
        numbers
    }
}

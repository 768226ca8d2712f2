//! Hash tables whose keys are positions on a lattice.

use std::hash::Hasher;

/// Hash of positions, packed or not: they are not chosen by an adversary, so only speed matters.
#[derive(Debug, Default)]
pub(crate) struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(4) {
            self.write_u64(chunk.iter().fold(0, |word, &byte| word << 8 | u64::from(byte)));
        }
    }

    fn write_u64(&mut self, key: u64) {
        // Knuth's multiplicative hash with the golden ratio; the table takes its index from both ends of the
        // value.
        let product = (self.0 ^ key).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        self.0 = product ^ product >> 32;
    }
}

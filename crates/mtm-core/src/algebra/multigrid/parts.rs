//! What the parts of a hierarchy's set-up cost, recorded as it is built.

use std::time::Instant;

/// One part of the set-up, over all levels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SetUpPart {
    /// What was computed.
    pub name: &'static str,
    /// Wall time, s.
    pub seconds: f64,
    /// Minimum memory traffic, bytes: every array that is read or written once.
    pub bytes: usize,
    /// Floating-point additions and multiplications; 0 for parts that hardly have any.
    pub flops: usize,
}

/// The parts so far, in the order in which they first occurred.
#[derive(Debug, Default)]
pub(super) struct Parts(Vec<SetUpPart>);

impl Parts {
    /// The result of `work`, whose time counts towards the part `name`; `cost` is the traffic in bytes, and the
    /// number of operations, that follow from the result.
    pub(super) fn timed<T>(
        &mut self,
        name: &'static str,
        work: impl FnOnce() -> T,
        cost: impl FnOnce(&T) -> (usize, usize),
    ) -> T {
        let begin = Instant::now();
        let made = work();
        let seconds = begin.elapsed().as_secs_f64();
        let (bytes, flops) = cost(&made);
        match self.0.iter_mut().find(|part| part.name == name) {
            Some(part) => {
                part.seconds += seconds;
                part.bytes += bytes;
                part.flops += flops;
            }
            None => self.0.push(SetUpPart { name, seconds, bytes, flops }),
        }
        made
    }

    pub(super) fn into_vec(self) -> Vec<SetUpPart> {
        self.0
    }
}

//! Steps that are shortened until an energy, or a merit in its place, decreases enough along them (Armijo 1966).

/// Share of the slope by which a step must decrease the energy.
const DESCENT: f64 = 1e-4;

/// A step along which an energy should decrease.
pub(crate) struct Descent {
    /// Slope of the energy at the start, over the whole step.
    pub slope: f64,
    /// How far the energy may end above what the slope asks for, as by rounding.
    pub slack: f64,
}

impl Descent {
    /// Whether the energy falls far enough between the start and the end of `share` of the step.
    pub fn accepts(&self, share: f64, start: f64, end: f64) -> bool {
        end <= start + DESCENT * share * self.slope + self.slack
    }
}

/// The first of the shares 1, ½, ¼ … of a step, down to `shortest`, for which `at` has a result, after that result.
pub(crate) fn first_of_halves<T>(
    shortest: f64,
    mut at: impl FnMut(f64) -> Option<T>,
) -> Option<(T, f64)> {
    let mut share = 1.0;
    while share >= shortest {
        if let Some(found) = at(share) {
            return Some((found, share));
        }
        share *= 0.5;
    }
    None
}

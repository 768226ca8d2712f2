//! What an iteration reached, and what was asked of it.

/// A quantity that an iteration did not reduce to the required value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shortfall {
    /// The quantity, in words.
    pub quantity: &'static str,
    /// Its final value; infinite if it could not be computed.
    pub value: f64,
    /// The required value.
    pub limit: f64,
    /// Its unit with a space before it; empty if it has none.
    pub unit: &'static str,
}

impl Shortfall {
    pub(crate) fn new(quantity: &'static str, value: f64, limit: f64, unit: &'static str) -> Self {
        Self { quantity, value, limit, unit }
    }
}

impl std::fmt::Display for Shortfall {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { quantity, value, limit, unit } = self;
        if value.is_finite() {
            write!(f, "{quantity} is {value:.3e}{unit}, but {limit:.3e}{unit} was requested")
        } else {
            write!(f, "{quantity} could not be computed ({limit:.3e}{unit} was requested)")
        }
    }
}

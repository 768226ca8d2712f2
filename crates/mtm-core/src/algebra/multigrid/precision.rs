//! The numbers of a cycle: how matrices are stored, and in what the vectors and sums are.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Mul, SubAssign};

/// How short the numbers of a cycle are. The Galerkin products are in double precision in both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CyclePrecision {
    /// Matrices stored in single precision, sums in double: for contrasts of stiffness up to 1e8 and more.
    Double,
    /// Matrices stored in sixteen bits, sums in single precision: half the memory traffic and twice as many
    /// numbers in a vector register, for tissue without such contrasts.
    Single,
}

/// Numbers of the vectors and sums.
pub trait Real:
    Copy
    + Debug
    + Default
    + Send
    + Sync
    + Add<Output = Self>
    + Mul<Output = Self>
    + AddAssign
    + SubAssign
    + PartialEq
    + From<f32>
    + From<i16>
    + Into<f64>
{
    /// The number nearest to `value`.
    fn of(value: f64) -> Self;
}

impl Real for f64 {
    #[inline(always)]
    fn of(value: f64) -> Self {
        value
    }
}

impl Real for f32 {
    #[inline(always)]
    fn of(value: f64) -> Self {
        value as Self
    }
}

/// Numbers of the stored blocks, which count in units of 1/[`ONE`](Self::ONE).
pub trait Stored: Copy + Debug + Default + Send + Sync {
    /// What 1 is stored as.
    const ONE: f64;
    /// Whether no number above 1 can be stored.
    const IS_BOUNDED: bool;
    /// The stored number nearest to `value`.
    fn nearest(value: f64) -> Self;
    /// The stored number, in its unit.
    fn raw<F: Real>(self) -> F;
}

impl Stored for f32 {
    const ONE: f64 = 1.0;
    const IS_BOUNDED: bool = false;
    #[inline(always)]
    fn nearest(value: f64) -> Self {
        value as Self
    }
    #[inline(always)]
    fn raw<F: Real>(self) -> F {
        F::from(self)
    }
}

impl Stored for i16 {
    const ONE: f64 = 32_767.0;
    const IS_BOUNDED: bool = true;
    #[inline(always)]
    fn nearest(value: f64) -> Self {
        // Doubles next to 1.5 · 2⁵² are integers: the sum rounds, and its lowest bits are the number.
        const INTEGERS: f64 = 6_755_399_441_055_744.0;
        (value.clamp(-1.0, 1.0) * Self::ONE + INTEGERS).to_bits() as Self
    }
    #[inline(always)]
    fn raw<F: Real>(self) -> F {
        F::from(self)
    }
}

/// What the numbers of a hierarchy are.
pub(super) trait Precision: Debug + Send + Sync {
    /// Of matrices and transfers.
    type Stored: Stored;
    /// Of vectors and sums.
    type Real: Real;
}

/// [`CyclePrecision::Double`].
#[derive(Debug)]
pub(super) struct Double;

impl Precision for Double {
    type Stored = f32;
    type Real = f64;
}

/// [`CyclePrecision::Single`].
#[derive(Debug)]
pub(super) struct Single;

impl Precision for Single {
    type Stored = i16;
    type Real = f32;
}

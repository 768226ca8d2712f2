//! Moduli of isotropic, transversely isotropic and user-defined linear elasticity, MPa, and their conversions.

use nalgebra::{Matrix6, SymmetricEigen};

use crate::error::{ErrorKind, Result};

/// Smallest permitted eigenvalue of a stiffness over its largest. Rounding errors of the constants are near
/// 1e-16; ν = 0.4999 with E_l/E_t = 1e3 is still at 1e-7.
pub const DEFINITE_RATIO: f64 = 1e-12;

/// Stiffness in Voigt order xx, yy, zz, yz, xz, xy with engineering shears, MPa, row by row.
pub type Voigt = [[f64; 6]; 6];

/// Rows and columns of strain components in Voigt order.
pub(crate) const PAIRS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)];

/// Lamé constants, MPa.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lame {
    /// First constant λ.
    pub lambda_: f64,
    /// Shear modulus μ.
    pub mu: f64,
}

/// Young's modulus (MPa) and Poisson's ratio of an isotropic tissue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Elastic {
    /// Young's modulus, MPa, positive.
    pub young: f64,
    /// Poisson's ratio, −1 < ν < 0.5.
    pub poisson: f64,
}

/// Moduli along and across the fibre (MPa) and the single Poisson ratio of the paper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FibreElastic {
    /// Young's modulus along the fibre, MPa, positive.
    pub young_along: f64,
    /// Young's modulus across the fibre, MPa, positive.
    pub young_across: f64,
    /// Poisson's ratio for loading along the stiffer direction, −1 < ν < 0.5.
    pub poisson: f64,
}

/// Constants of the transversely isotropic law of Spencer (1984), MPa, with fibre a and A = a⊗a:
/// σ = λ tr ε I + 2 μ_T ε + α [(a·εa) I + tr ε A] + 2 d [A ε + ε A] + β (a·εa) A, d = μ_L − μ_T.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spencer {
    /// λ.
    pub lambda_: f64,
    /// Shear modulus across the fibre, μ_T.
    pub mu_across: f64,
    /// Coupling α of fibre strain and volume.
    pub alpha: f64,
    /// Difference d = μ_L − μ_T of the shear moduli along and across.
    pub mu_difference: f64,
    /// Extra stiffness β along the fibre.
    pub beta: f64,
}

/// How two moduli and one Poisson ratio define a stiffness.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum FibreLaw {
    /// Spencer's form from the engineering compliance, completed by the major-Poisson and Saint-Venant rules.
    Spencer,
    /// C_iso(E_t) + (Δλ + 2Δμ) A⊗A of Picinbono, Delingette & Ayache (2003); indefinite for much softer fibres.
    Picinbono,
}

/// How fat and muscle are combined in a tet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Mixing {
    /// Young's moduli and Poisson's ratio are interpolated linearly with the muscle fraction (the paper,
    /// section 2.3).
    Moduli,
    /// The stiffness itself is interpolated linearly.
    Stiffness,
}

/// Constants of fat and muscle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Preset {
    /// Fat, isotropic.
    pub fat: Elastic,
    /// Muscle.
    pub muscle: FibreElastic,
}

impl FibreLaw {
    /// Every law, by its name.
    pub const ALL: [(&str, Self); 2] = [("spencer", Self::Spencer), ("picinbono", Self::Picinbono)];

    /// The law called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        ErrorKind::Material.named("law", name, Self::ALL)
    }
}

impl Mixing {
    /// The rule called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        let known = [("moduli", Self::Moduli), ("stiffness", Self::Stiffness)];
        ErrorKind::Material.named("mixing", name, known)
    }
}

impl Preset {
    /// Poisson's ratio of fat, and the moduli of muscle along and across, of every preset by its name.
    pub const ALL: [(&str, [f64; 3]); 3] = [
        ("passive", [0.40, 0.06, 0.03]),
        ("kim2010", [0.46, 0.5, 0.79]),
        ("kim2010-swapped", [0.46, 0.79, 0.5]),
    ];

    /// The preset called `name`: `passive` has the moduli of muscle at rest (0.03 MPa across, 0.06
    /// along, ν 0.43) and fat that can lose volume (0.003 MPa, ν 0.40; docs/moduli.md); `kim2010` is
    /// Table 1 of Kim et al. (2010) as printed (muscle 0.79 MPa across, 0.5 along, ν 0.43; fat 0.003,
    /// 0.46); `kim2010-swapped` exchanges its muscle's moduli.
    pub fn from_name(name: &str) -> Result<Self> {
        let [of_fat, young_along, young_across] =
            ErrorKind::Material.named("preset", name, Self::ALL)?;
        Ok(Self {
            fat: Elastic { young: 0.003, poisson: of_fat },
            muscle: FibreElastic { young_along, young_across, poisson: 0.43 },
        })
    }
}

impl From<Elastic> for Lame {
    /// λ = Eν / ((1+ν)(1−2ν)), μ = E / (2(1+ν)).
    fn from(e: Elastic) -> Self {
        Self {
            lambda_: e.young * e.poisson / ((1.0 + e.poisson) * (1.0 - 2.0 * e.poisson)),
            mu: e.young / (2.0 * (1.0 + e.poisson)),
        }
    }
}

impl From<Lame> for Spencer {
    fn from(l: Lame) -> Self {
        Self { lambda_: l.lambda_, mu_across: l.mu, alpha: 0.0, mu_difference: 0.0, beta: 0.0 }
    }
}

impl Spencer {
    /// Spencer's constants of `m` under `law`.
    ///
    /// `FibreLaw::Spencer`: ν is the ratio for loading along the stiffer direction (ν_lt = ν if
    /// E_l ≥ E_t, else ν_lt = ν E_l/E_t), ν_tt = ν, and 1/G_lt = 1/E_l + 1/E_t + 2 ν_lt/E_l
    /// (Saint-Venant). With Δ = 1 − ν_tt − 2 ν_lt ν_tl ≥ (1+ν)(1−2ν) > 0:
    /// C11 = E_l (1−ν_tt)/Δ, C12 = E_t ν_lt/Δ, C23 = E_t (ν_tt + ν_lt ν_tl)/((1+ν_tt) Δ),
    /// C44 = μ_T = E_t/(2(1+ν_tt)), C66 = μ_L = G_lt.
    pub fn from_moduli(m: FibreElastic, law: FibreLaw) -> Self {
        let FibreElastic { young_along: el, young_across: et, poisson: nu } = m;
        match law {
            FibreLaw::Spencer => {
                let nu_lt = if el >= et { nu } else { nu * el / et };
                let nu_tl = nu_lt * et / el;
                let delta = 1.0 - nu - 2.0 * nu_lt * nu_tl;
                let c11 = el * (1.0 - nu) / delta;
                let c12 = et * nu_lt / delta;
                let c23 = et * (nu + nu_lt * nu_tl) / ((1.0 + nu) * delta);
                let mu_across = et / (2.0 * (1.0 + nu));
                let mu_along = 1.0 / (1.0 / el + 1.0 / et + 2.0 * nu_lt / el);
                let (alpha, d) = (c12 - c23, mu_along - mu_across);
                let beta = c11 - c23 - 2.0 * mu_across - 2.0 * alpha - 4.0 * d;
                Self { lambda_: c23, mu_across, alpha, mu_difference: d, beta }
            }
            FibreLaw::Picinbono => {
                let across = Lame::from(Elastic { young: et, poisson: nu });
                let along = Lame::from(Elastic { young: el, poisson: nu });
                let beta = along.lambda_ - across.lambda_ + 2.0 * (along.mu - across.mu);
                Self { beta, ..Self::from(across) }
            }
        }
    }

    /// Whether the fibre has no effect, so that the isotropic tensor can be used.
    pub fn is_isotropic(&self) -> bool {
        self.alpha == 0.0 && self.mu_difference == 0.0 && self.beta == 0.0
    }

    /// Extreme eigenvalues of C in Mandel form, MPa.
    ///
    /// In the fibre frame C splits: 2μ_T and 2μ_L (double each), and the 2×2 block
    /// [C11, √2 C12; √2 C12, C22 + C23].
    pub fn eigenvalue_range(&self) -> (f64, f64) {
        let mu_l = self.mu_across + self.mu_difference;
        let c12 = self.lambda_ + self.alpha;
        let c11 = self.lambda_ + 2.0 * self.mu_across + 2.0 * self.alpha;
        let c11 = c11 + 4.0 * self.mu_difference + self.beta;
        let c22_23 = 2.0 * (self.lambda_ + self.mu_across);
        let (mean, half) = (0.5 * (c11 + c22_23), 0.5 * (c11 - c22_23));
        let large = mean + half.hypot(std::f64::consts::SQRT_2 * c12);
        // The smaller root from the product of the roots: the difference would suffer cancellation near ν =
        // 0.5.
        let small =
            if large > 0.0 { (c11 * c22_23 - 2.0 * c12 * c12) / large } else { 2.0 * mean - large };
        let shear = [2.0 * self.mu_across, 2.0 * mu_l];
        (small.min(shear[0]).min(shear[1]), large.max(shear[0]).max(shear[1]))
    }

    /// Linear combination `a·self + b·other`, constant by constant: the mixture of two stiffnesses that
    /// share a fibre.
    pub(crate) fn combined(self, a: f64, other: Self, b: f64) -> Self {
        Self {
            lambda_: a * self.lambda_ + b * other.lambda_,
            mu_across: a * self.mu_across + b * other.mu_across,
            alpha: a * self.alpha + b * other.alpha,
            mu_difference: a * self.mu_difference + b * other.mu_difference,
            beta: a * self.beta + b * other.beta,
        }
    }

    /// Stiffness in global axes for the unit fibre `a`.
    pub fn voigt(&self, a: [f64; 3]) -> Voigt {
        let delta = |i: usize, j: usize| f64::from(u8::from(i == j));
        let mut c = [[0.0; 6]; 6];
        for (row, &(i, j)) in PAIRS.iter().enumerate() {
            for (col, &(k, l)) in PAIRS.iter().enumerate() {
                c[row][col] = self.lambda_ * delta(i, j) * delta(k, l)
                    + self.mu_across * (delta(i, k) * delta(j, l) + delta(i, l) * delta(j, k))
                    + self.alpha * (a[i] * a[j] * delta(k, l) + delta(i, j) * a[k] * a[l])
                    + self.mu_difference
                        * (a[i] * a[k] * delta(j, l)
                            + a[i] * a[l] * delta(j, k)
                            + a[j] * a[k] * delta(i, l)
                            + a[j] * a[l] * delta(i, k))
                    + self.beta * a[i] * a[j] * a[k] * a[l];
            }
        }
        c
    }
}

/// The symmetric part of `c`.
pub(crate) fn voigt_matrix(c: &Voigt) -> Matrix6<f64> {
    Matrix6::from_fn(|i, j| 0.5 * (c[i][j] + c[j][i]))
}

/// Extreme eigenvalues of C in Mandel form, in which shears are multiplied by √2 and strain keeps its norm.
pub(crate) fn voigt_eigenvalues(c: &Voigt) -> (f64, f64) {
    let weight = |i: usize| if i < 3 { 1.0 } else { std::f64::consts::SQRT_2 };
    let mandel = Matrix6::from_fn(|i, j| 0.5 * (c[i][j] + c[j][i]) * weight(i) * weight(j));
    let values = SymmetricEigen::new(mandel).eigenvalues;
    (values.min(), values.max())
}

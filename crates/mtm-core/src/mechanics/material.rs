//! Tissue: isotropic, transversely isotropic and user-defined linear elasticity, each checked for positive
//! definiteness at construction; mixing of fat and muscle. Moduli in MPa.

use nalgebra::{Matrix6, SymmetricEigen};
use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result};
use crate::vector::{dot, norm};

/// Smallest permitted eigenvalue of a stiffness over its largest. Rounding errors of the constants are near
/// 1e-16; ν = 0.4999 with E_l/E_t = 1e3 is still at 1e-7.
pub const DEFINITE_RATIO: f64 = 1e-12;
/// Permitted deviation of a fibre direction from unit length; within it the direction is normalised.
pub const FIBRE_TOLERANCE: f64 = 1e-6;
/// Permitted asymmetry of a user-defined stiffness over its largest entry.
const SYMMETRY_TOLERANCE: f64 = 1e-9;
/// Smallest and largest modulus, MPa: far beyond any tissue (fat 0.003, enamel 1e5) in any unit, and far from
/// where products overflow or vanish.
const SOFTEST: f64 = 1e-15;
const STIFFEST: f64 = 1e12;

/// Stiffness in Voigt order xx, yy, zz, yz, xz, xy with engineering shears, MPa, row by row.
pub type Voigt = [[f64; 6]; 6];

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

/// Names of the built-in presets.
pub const PRESETS: &str = "kim2010, kim2010-swapped";
/// Names of the fibre laws.
pub const LAWS: &str = "spencer, picinbono";
/// Names of the mixing rules.
pub const MIXINGS: &str = "moduli, stiffness";

/// Constants of every tet, or of all of them; each distinct material is positive definite.
#[derive(Debug, Clone)]
pub struct Tissue {
    law: Law,
}

#[derive(Debug, Clone)]
enum Law {
    Isotropic(Vec<Lame>),
    Spencer {
        constants: Vec<Spencer>,
        fibre: Vec<[f64; 3]>,
    },
    General(Vec<Voigt>),
    /// A stiffness of `rows` for each tet, or `base` if its row is [`NO_ROW`].
    Composite {
        base: Lame,
        rows: Vec<Voigt>,
        row_of: Vec<u32>,
    },
}

/// Marks the base material of a composite tissue.
const NO_ROW: u32 = u32::MAX;

/// Constants of one tet, in the form used by the tensor formulas.
#[derive(Debug, Clone, Copy)]
pub enum TetMaterial<'a> {
    /// Isotropic.
    Isotropic(Lame),
    /// Spencer's law with its unit fibre.
    Spencer(Spencer, [f64; 3]),
    /// Any symmetric stiffness.
    General(&'a Voigt),
}

impl FibreLaw {
    /// The law called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "spencer" => Ok(Self::Spencer),
            "picinbono" => Ok(Self::Picinbono),
            _ => Err(unknown("law", name, LAWS)),
        }
    }
}

impl Mixing {
    /// The rule called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "moduli" => Ok(Self::Moduli),
            "stiffness" => Ok(Self::Stiffness),
            _ => Err(unknown("mixing", name, MIXINGS)),
        }
    }
}

impl Preset {
    /// The preset called `name`: `kim2010` is Table 1 of Kim et al. (2010) as printed (muscle 0.79 MPa
    /// across, 0.5 along, ν 0.43; fat 0.003, 0.46); `kim2010-swapped` exchanges the muscle's moduli, as
    /// the physiology of passive muscle suggests.
    pub fn from_name(name: &str) -> Result<Self> {
        let fat = Elastic { young: 0.003, poisson: 0.46 };
        let (young_along, young_across) = match name {
            "kim2010" => (0.5, 0.79),
            "kim2010-swapped" => (0.79, 0.5),
            _ => return Err(unknown("preset", name, PRESETS)),
        };
        Ok(Self { fat, muscle: FibreElastic { young_along, young_across, poisson: 0.43 } })
    }
}

fn unknown(what: &'static str, found: &str, known: &'static str) -> MtmError {
    MtmError::UnknownName { what, found: found.to_owned(), known, kind: ErrorKind::Material }
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
        let c11 = self.lambda_
            + 2.0 * self.mu_across
            + 2.0 * self.alpha
            + 4.0 * self.mu_difference
            + self.beta;
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
    fn combined(self, a: f64, other: Self, b: f64) -> Self {
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
        const PAIRS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)];
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

impl Tissue {
    /// Isotropic tissue with one row of constants, or one per tet.
    pub fn isotropic(rows: &[Elastic]) -> Result<Self> {
        check_rows(rows.len())?;
        for (tet, e) in rows.iter().enumerate() {
            check_young("young", tet, e.young)?;
            check_poisson(tet, e.poisson)?;
        }
        let constants: Vec<Lame> = rows.iter().map(|&e| e.into()).collect();
        for (tet, c) in constants.iter().enumerate() {
            let e = rows[tet];
            check_definite(tet, Spencer::from(*c).eigenvalue_range(), || {
                format!("young {} MPa, poisson {}", e.young, e.poisson)
            })?;
        }
        Ok(Self { law: Law::Isotropic(constants) })
    }

    /// Transversely isotropic tissue; `rows` and the unit `fibre` have one row each, or one per tet.
    pub fn transversely_isotropic(
        rows: &[FibreElastic],
        fibre: &[[f64; 3]],
        law: FibreLaw,
    ) -> Result<Self> {
        check_rows(rows.len())?;
        let fibre = unit_fibres(fibre, &vec![true; fibre.len()])?;
        check_matching(rows.len(), fibre.len())?;
        let mut constants = Vec::with_capacity(rows.len());
        for (tet, m) in rows.iter().enumerate() {
            check_young("young_along", tet, m.young_along)?;
            check_young("young_across", tet, m.young_across)?;
            check_poisson(tet, m.poisson)?;
            let c = Spencer::from_moduli(*m, law);
            check_definite(tet, c.eigenvalue_range(), || describe(m, law))?;
            constants.push(c);
        }
        Ok(Self { law: Law::Spencer { constants, fibre } })
    }

    /// Tissue of any symmetric positive definite stiffness, one row or one per tet.
    pub fn from_stiffness(rows: Vec<Voigt>) -> Result<Self> {
        check_rows(rows.len())?;
        let failure =
            rows.par_iter().enumerate().find_map_first(|(tet, c)| check_voigt(tet, c).err());
        match failure {
            Some(error) => Err(error),
            None => Ok(Self { law: Law::General(rows) }),
        }
    }

    /// Isotropic tissue of `n_tets` tets except for some: `rows[i]` is the stiffness of tet `tets[i]`.
    ///
    /// # Errors
    /// Those of [`Tissue::isotropic`] and [`Tissue::from_stiffness`], with the tet;
    /// [`MtmError::IndexOutOfRange`] for a tet that does not exist.
    pub fn composite(base: Elastic, n_tets: usize, tets: &[u32], rows: Vec<Voigt>) -> Result<Self> {
        Self::isotropic(&[base])?;
        check_rows(n_tets)?;
        let mut row_of = vec![NO_ROW; n_tets];
        for (row, &tet) in tets.iter().enumerate() {
            *row_of.get_mut(tet as usize).ok_or_else(|| MtmError::IndexOutOfRange {
                what: "tets".into(),
                row,
                item: "tet",
                index: tet as usize,
                count: n_tets,
                kind: ErrorKind::Material,
            })? = row as u32;
        }
        let failure = tets
            .par_iter()
            .zip(&rows)
            .find_map_first(|(&tet, c)| check_voigt(tet as usize, c).err());
        match failure {
            Some(error) => Err(error),
            None => Ok(Self { law: Law::Composite { base: base.into(), rows, row_of } }),
        }
    }

    /// Equivalent tissue of tets with muscle fraction `fraction` and unit `fibre` (ignored if the fraction is
    /// 0), from the constants of `preset` (Kim et al. 2010, section 2.3; Uesu et al. 2005).
    pub fn mixture(
        fraction: &[f64],
        fibre: &[[f64; 3]],
        preset: Preset,
        mixing: Mixing,
    ) -> Result<Self> {
        check_rows(fraction.len())?;
        for (index, &value) in fraction.iter().enumerate() {
            if !(0.0..=1.0).contains(&value) {
                return Err(MtmError::OutOfRange {
                    what: "fraction".into(),
                    index,
                    value,
                    allowed: "0 to 1",
                    kind: ErrorKind::Material,
                });
            }
        }
        check_matching(fraction.len(), fibre.len())?;
        let needed: Vec<bool> =
            (0..fibre.len()).map(|t| fraction[t % fraction.len()] > 0.0).collect();
        let fibre = unit_fibres(fibre, &needed)?;
        let (fat, muscle) = (preset.fat, preset.muscle);
        let mut constants = Vec::with_capacity(fraction.len());
        for (tet, &p) in fraction.iter().enumerate() {
            let mix = |f: f64, m: f64| f * (1.0 - p) + m * p;
            let moduli = FibreElastic {
                young_along: mix(fat.young, muscle.young_along),
                young_across: mix(fat.young, muscle.young_across),
                poisson: mix(fat.poisson, muscle.poisson),
            };
            let c = if p == 0.0 {
                Lame::from(fat).into()
            } else if mixing == Mixing::Moduli {
                Spencer::from_moduli(moduli, FibreLaw::Spencer)
            } else {
                Spencer::from_moduli(muscle, FibreLaw::Spencer).combined(
                    p,
                    Lame::from(fat).into(),
                    1.0 - p,
                )
            };
            check_definite(tet, c.eigenvalue_range(), || describe(&moduli, FibreLaw::Spencer))?;
            constants.push(c);
        }
        Ok(Self { law: Law::Spencer { constants, fibre } })
    }

    /// Number of rows of constants: 1 for a uniform tissue, else one per tet.
    pub fn n_rows(&self) -> usize {
        match &self.law {
            Law::Isotropic(c) => c.len(),
            Law::Spencer { constants, fibre } => constants.len().max(fibre.len()),
            Law::General(c) => c.len(),
            Law::Composite { row_of, .. } => row_of.len(),
        }
    }

    /// Largest λ/μ of any row, 2ν/(1−2ν) if it is isotropic: how nearly incompressible the tissue is.
    pub fn largest_lame_ratio(&self) -> f64 {
        let ratio = |t: usize| match self.of_tet(t) {
            TetMaterial::Isotropic(l) => l.lambda_ / l.mu,
            TetMaterial::Spencer(c, _) => {
                c.lambda_ / c.mu_across.min(c.mu_across + c.mu_difference)
            }
            TetMaterial::General(c) => {
                (c[0][1] + c[0][2] + c[1][2]) / (c[3][3] + c[4][4] + c[5][5])
            }
        };
        (0..self.n_rows()).map(ratio).fold(0.0, f64::max)
    }

    /// Stiffest over softest tet, by the mean shear stiffness; 1 for a uniform tissue.
    pub fn contrast(&self) -> f64 {
        let shear = |t: usize| match self.of_tet(t) {
            TetMaterial::Isotropic(l) => l.mu,
            // Two planes of shear contain the fibre, one is perpendicular to it.
            TetMaterial::Spencer(c, _) => c.mu_across + c.mu_difference * 2.0 / 3.0,
            TetMaterial::General(c) => (c[3][3] + c[4][4] + c[5][5]) / 3.0,
        };
        let (least, most) = (0..self.n_rows())
            .map(shear)
            .fold((f64::INFINITY, 0.0_f64), |(least, most), v| (least.min(v), most.max(v)));
        most / least
    }

    /// Constants of tet `t`.
    pub fn of_tet(&self, t: usize) -> TetMaterial<'_> {
        fn row<T>(rows: &[T], t: usize) -> &T {
            if rows.len() == 1 { &rows[0] } else { &rows[t] }
        }
        match &self.law {
            Law::Isotropic(c) => TetMaterial::Isotropic(*row(c, t)),
            Law::Spencer { constants, fibre } => {
                let c = *row(constants, t);
                if c.is_isotropic() {
                    TetMaterial::Isotropic(Lame { lambda_: c.lambda_, mu: c.mu_across })
                } else {
                    TetMaterial::Spencer(c, *row(fibre, t))
                }
            }
            Law::General(c) => TetMaterial::General(row(c, t)),
            Law::Composite { base, rows, row_of } => match row_of[t] {
                NO_ROW => TetMaterial::Isotropic(*base),
                row => TetMaterial::General(&rows[row as usize]),
            },
        }
    }

    /// Stiffness of each row, Voigt, global axes, MPa.
    pub fn stiffness(&self) -> Vec<Voigt> {
        (0..self.n_rows()).map(|t| self.of_tet(t).voigt()).collect()
    }

    /// Smallest eigenvalue of each row's stiffness in Mandel form, MPa.
    pub fn smallest_eigenvalues(&self) -> Vec<f64> {
        (0..self.n_rows())
            .map(|t| match self.of_tet(t) {
                TetMaterial::Isotropic(l) => Spencer::from(l).eigenvalue_range().0,
                TetMaterial::Spencer(c, _) => c.eigenvalue_range().0,
                TetMaterial::General(c) => voigt_eigenvalues(c).0,
            })
            .collect()
    }
}

impl TetMaterial<'_> {
    /// Stiffness in global axes, MPa.
    pub fn voigt(&self) -> Voigt {
        match self {
            Self::Isotropic(l) => Spencer::from(*l).voigt([1.0, 0.0, 0.0]),
            Self::Spencer(c, a) => c.voigt(*a),
            Self::General(c) => **c,
        }
    }
}

fn check_rows(len: usize) -> Result<()> {
    if len == 0 {
        return Err(MtmError::Empty { what: "tissue constants", kind: ErrorKind::Material });
    }
    Ok(())
}

fn check_matching(constants: usize, fibres: usize) -> Result<()> {
    if constants != fibres && constants != 1 && fibres != 1 {
        return Err(MtmError::Length {
            what: "fibre".into(),
            found: fibres,
            expected: constants,
            why: "one direction, or one per tet",
            kind: ErrorKind::Material,
        });
    }
    Ok(())
}

fn check_young(what: &'static str, index: usize, value: f64) -> Result<()> {
    if (SOFTEST..=STIFFEST).contains(&value) {
        return Ok(());
    }
    let kind = ErrorKind::Material;
    Err(MtmError::OutOfRange {
        what: what.into(),
        index,
        value,
        allowed: "positive, 1e-15 to 1e12 MPa; check the units",
        kind,
    })
}

fn check_poisson(index: usize, value: f64) -> Result<()> {
    if value > -1.0 && value < 0.5 {
        return Ok(());
    }
    let kind = ErrorKind::Material;
    Err(MtmError::OutOfRange {
        what: "poisson".into(),
        index,
        value,
        allowed: "above -1 and below 0.5; 0.4999 is the practical limit",
        kind,
    })
}

fn check_definite(
    tet: usize,
    (small, large): (f64, f64),
    constants: impl Fn() -> String,
) -> Result<()> {
    if small > DEFINITE_RATIO * large {
        return Ok(());
    }
    Err(MtmError::IndefiniteMaterial { tet, eigenvalue: small, constants: constants() })
}

fn describe(m: &FibreElastic, law: FibreLaw) -> String {
    format!(
        "young_along {} MPa, young_across {} MPa, poisson {}, law {}",
        m.young_along,
        m.young_across,
        m.poisson,
        if law == FibreLaw::Spencer { "spencer" } else { "picinbono" }
    )
}

/// `fibre` with every row that is needed scaled to exactly unit length.
fn unit_fibres(fibre: &[[f64; 3]], needed: &[bool]) -> Result<Vec<[f64; 3]>> {
    if fibre.is_empty() {
        return Err(MtmError::Empty { what: "fibre", kind: ErrorKind::Material });
    }
    let mut out = Vec::with_capacity(fibre.len());
    for (tet, a) in fibre.iter().enumerate() {
        if !needed[tet] {
            out.push([1.0, 0.0, 0.0]);
            continue;
        }
        let kind = ErrorKind::Material;
        if let Some(&value) = a.iter().find(|v| !v.is_finite()) {
            return Err(MtmError::NotFinite { what: "fibre".into(), index: tet, value, kind });
        }
        let length = norm(*a);
        if (length - 1.0).abs() > FIBRE_TOLERANCE {
            return Err(MtmError::FibreNotUnit { tet, length, tolerance: FIBRE_TOLERANCE });
        }
        debug_assert!(dot(*a, *a) > 0.0);
        out.push(a.map(|v| v / length));
    }
    Ok(out)
}

fn check_voigt(tet: usize, c: &Voigt) -> Result<()> {
    let kind = ErrorKind::Material;
    let largest = c.iter().flatten().fold(0.0_f64, |m, v| m.max(v.abs()));
    for row in 0..6 {
        for column in 0..6 {
            let value = c[row][column];
            if !value.is_finite() {
                return Err(MtmError::NotFinite {
                    what: "stiffness".into(),
                    index: tet,
                    value,
                    kind,
                });
            }
            if value.abs() > STIFFEST || (row == column && value > 0.0 && value < SOFTEST) {
                return Err(MtmError::OutOfRange {
                    what: "stiffness".into(),
                    index: tet,
                    value,
                    allowed: "1e-15 to 1e12 MPa on the diagonal, at most 1e12 MPa next to it",
                    kind,
                });
            }
            let lower = c[column][row];
            if (value - lower).abs() > SYMMETRY_TOLERANCE * largest {
                return Err(MtmError::AsymmetricStiffness {
                    tet,
                    row,
                    column,
                    upper: value,
                    lower,
                });
            }
        }
    }
    check_definite(tet, voigt_eigenvalues(c), || "a given stiffness".to_owned())
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

//! The tissue of a body: constants for every tet, each checked for range, fibres and positive definiteness at
//! construction; mixtures of fat and muscle.

use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result};
use crate::mechanics::material::{
    DEFINITE_RATIO, Elastic, FibreElastic, FibreLaw, Lame, Mixing, Preset, Spencer, Voigt,
    voigt_eigenvalues,
};
use crate::vector::{dot, norm};

/// Permitted deviation of a fibre direction from unit length; within it the direction is normalised.
const FIBRE_TOLERANCE: f64 = 1e-6;
/// Permitted asymmetry of a user-defined stiffness over its largest entry.
const SYMMETRY_TOLERANCE: f64 = 1e-9;
/// Smallest and largest modulus, MPa: far beyond any tissue (fat 0.003, enamel 1e5) in any unit, and far from
/// where products overflow or vanish.
const SOFTEST: f64 = 1e-15;
const STIFFEST: f64 = 1e12;

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
        let checks = rows.par_iter().enumerate();
        let failure = checks.find_map_first(|(tet, c)| check_voigt(tet, c).err());
        failure.map_or(Ok(Self { law: Law::General(rows) }), Err)
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
            *row_of
                .get_mut(tet as usize)
                .ok_or_else(|| ErrorKind::Material.no_such(("tets", row), "tet", tet, n_tets))? =
                row as u32;
        }
        let failure = tets
            .par_iter()
            .zip(&rows)
            .find_map_first(|(&tet, c)| check_voigt(tet as usize, c).err());
        let law = Law::Composite { base: base.into(), rows, row_of };
        failure.map_or(Ok(Self { law }), Err)
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
                return Err(ErrorKind::Material.out_of_range("fraction", index, value, "0 to 1"));
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
        let range = |(least, most): (f64, f64), v: f64| (least.min(v), most.max(v));
        let (least, most) = (0..self.n_rows()).map(shear).fold((f64::INFINITY, 0.0), range);
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
    ErrorKind::Material.require_entries("tissue constants", len)
}

fn check_matching(constants: usize, fibres: usize) -> Result<()> {
    if constants != fibres && constants != 1 && fibres != 1 {
        let why = "one direction, or one per tet";
        return Err(ErrorKind::Material.length("fibre", fibres, constants, why));
    }
    Ok(())
}

fn check_young(what: &'static str, index: usize, value: f64) -> Result<()> {
    if (SOFTEST..=STIFFEST).contains(&value) {
        return Ok(());
    }
    let allowed = "positive, 1e-15 to 1e12 MPa; check the units";
    Err(ErrorKind::Material.out_of_range(what, index, value, allowed))
}

fn check_poisson(index: usize, value: f64) -> Result<()> {
    if value > -1.0 && value < 0.5 {
        return Ok(());
    }
    let allowed = "above -1 and below 0.5; 0.4999 is the practical limit";
    Err(ErrorKind::Material.out_of_range("poisson", index, value, allowed))
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
    ErrorKind::Material.require_entries("fibre", fibre.len())?;
    let mut out = Vec::with_capacity(fibre.len());
    for (tet, a) in fibre.iter().enumerate() {
        if !needed[tet] {
            out.push([1.0, 0.0, 0.0]);
            continue;
        }
        let kind = ErrorKind::Material;
        if let Some(&value) = a.iter().find(|v| !v.is_finite()) {
            return Err(kind.not_finite("fibre", tet, value));
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
                return Err(kind.not_finite("stiffness", tet, value));
            }
            if value.abs() > STIFFEST || (row == column && value > 0.0 && value < SOFTEST) {
                let allowed = "1e-15 to 1e12 MPa on the diagonal, at most 1e12 MPa next to it";
                return Err(kind.out_of_range("stiffness", tet, value, allowed));
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

//! From the muscle fractions of the tets to their tissue.

use rayon::prelude::*;

use crate::error::Result;
use crate::mechanics::material::{FibreLaw, Lame, Mixing, Preset, Spencer, Voigt};
use crate::mechanics::tissue::Tissue;
use crate::muscles::equivalent::shares::{MuscleShares, TetShares};

impl MuscleShares {
    /// Tissue of every tet with the constants of `preset`.
    ///
    /// [`Mixing::Moduli`]: Young's moduli and Poisson's ratio are interpolated with the fraction of muscle,
    /// along the mean fibre (Kim et al. 2010, section 2.3). [`Mixing::Stiffness`]: C = Σ p_i C_muscle(a_i) + (1
    /// − Σ p_i) C_fat with fraction p_i and fibre a_i of each muscle (Voigt's bound).
    ///
    /// # Errors
    /// [`crate::MtmError::IndefiniteMaterial`] with the tet.
    pub fn tissue(&self, preset: Preset, mixing: Mixing) -> Result<Tissue> {
        match mixing {
            Mixing::Moduli => {
                let fibre: Vec<[f64; 3]> = self.fibre.iter().map(|f| f.direction).collect();
                Tissue::mixture(&self.fraction, &fibre, preset, mixing)
            }
            Mixing::Stiffness => {
                let fat = Spencer::from(Lame::from(preset.fat)).voigt([1.0, 0.0, 0.0]);
                let muscle = Spencer::from_moduli(preset.muscle, FibreLaw::Spencer);
                let mixed = |one: &TetShares| stiffness(one, &fat, &muscle);
                let rows: Vec<Voigt> = self.tets.par_iter().map(mixed).collect();
                let tets: Vec<u32> = self.tets.iter().map(|one| one.tet).collect();
                Tissue::composite(preset.fat, self.fraction.len(), &tets, rows)
            }
        }
    }
}

/// Σ p_i C(a_i) + (1 − Σ p_i) C_fat of one tet.
fn stiffness(tet: &TetShares, fat: &Voigt, muscle: &Spencer) -> Voigt {
    let rest = 1.0 - tet.shares.iter().map(|share| share.fraction).sum::<f64>();
    // Shares that fill the tet may exceed 1 by rounding.
    let mut sum = fat.map(|row| row.map(|c| c * rest.max(0.0)));
    for share in &tet.shares {
        let one = muscle.voigt(share.fibre.direction);
        for (row, add) in sum.iter_mut().flatten().zip(one.iter().flatten()) {
            *row += add * share.fraction;
        }
    }
    sum
}
